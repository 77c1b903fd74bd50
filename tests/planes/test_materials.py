"""Materials of planes whose reflections are known."""

import math

import pytest
import torch

import gaigs
from gaigs.data.synthetic.image_source import permittivity
from gaigs.planes.materials import materials
from gaigs.planes.room_paths import spread_links
from gaigs.splatting.placement.mirrored.paths import Mirrored

FREQUENCY = 6.4896e9


@pytest.fixture
def placement():
    torch.manual_seed(0)
    scene = gaigs.links("synthetic_csi", transmitters=10, order=0).scene
    placement = Mirrored(scene, 2, obstacles=0)
    with torch.no_grad():
        placement.log_extents.fill_(
            10.0
        )  # planes without edges, near which they would reflect less
    return placement


def paint(placement, plane, value, thickness=1.0):
    with torch.no_grad():
        placement.log_permittivities[plane] = math.log(value.real - 1)
        placement.log_conductivities[plane] = math.log(-value.imag)
        placement.log_thicknesses[plane] = math.log(thickness)


def test_a_plane_has_the_material_it_is_made_of(placement):
    names = ["concrete", "brick", "wood", "glass", "plasterboard", "ceiling_board"]
    for plane, name in enumerate(names):
        paint(placement, plane, permittivity(name, FREQUENCY))
    paint(placement, 4, permittivity("plasterboard", FREQUENCY), 0.0125)
    found = materials(placement, spread_links(placement.scene), FREQUENCY)
    assert [found[plane].name for plane in range(6)] == names
    assert [found[plane].thickness for plane in (0, 1, 4)] == pytest.approx([1.0, 1.0, 0.0125])


def test_gains_of_planes_and_paths_count_as_material(placement):
    """Glass as a weaker dielectric with gains: a learnt permittivity alone would be called
    plasterboard.
    """
    paint(placement, 0, complex(2.73, -0.1))

    def reflected(value):
        return abs((1 - value**0.5) / (1 + value**0.5))

    gain = math.log(reflected(permittivity("glass", FREQUENCY)) / reflected(complex(2.73, -0.1)))
    alone = (placement.sequences == 0).any(1) & ((placement.sequences >= 0).sum(1) == 1)
    placement.kept.copy_((placement.sequences < 0).all(1) | alone)
    with torch.no_grad():
        placement.plane_gains[0] = gain / 2
        placement.path_gains += 0.3  # of all paths: the level of the labels
        placement.path_gains[alone] += gain / 2
    found = materials(placement, spread_links(placement.scene), FREQUENCY)
    assert found.keys() == {0}
    assert found[0].name in ("glass", "marble")
