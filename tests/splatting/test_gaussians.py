"""Gaussians: initial lattice, activations, checkpoints and .ply files."""

import math
from dataclasses import replace

import pytest
import torch
from plyfile import PlyData
from scipy.spatial import cKDTree
from torch import nn

from gaigs.core.geometry import to_spherical
from gaigs.splatting.gaussians import Gaussians, fibonacci_lattice
from gaigs.testing import example_links

ZONE = (0.07, 1.55)
OPTIONS = {"zone": ZONE, "channels": 2, "count": 41, "near": 2.0, "far": 5.0, "spread": 0.5}


@pytest.fixture
def scene():
    return example_links().scene


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


def gaussians_of(scene, **options):
    return Gaussians(scene, **(OPTIONS | options))


@pytest.mark.parametrize(
    ("low", "high"), [(-math.pi / 2, math.pi / 2), (0.0, math.pi / 2), (0.2, 0.6)]
)
def test_the_lattice_is_even(low, high):
    count = 2000
    points = fibonacci_lattice(count, low, high)
    azimuths, elevations, distances = to_spherical(points)
    torch.testing.assert_close(distances, torch.ones(count))
    assert elevations.min() > low
    assert elevations.max() < high
    # Patches of the zone of equal solid angle hold equal numbers.
    heights = (points[:, 2] - math.sin(low)) / (math.sin(high) - math.sin(low))
    patches = (heights * 10).long() * 8 + ((azimuths / math.tau + 0.5) * 8).long().clamp(0, 7)
    assert (patches.bincount(minlength=80) - count / 80).abs().max() <= 5
    pitch = math.sqrt(math.tau * (math.sin(high) - math.sin(low)) / count)
    nearest = cKDTree(points.numpy()).query(points.numpy(), 2)[0][:, 1]
    assert nearest.min() > 0.7 * pitch
    assert nearest.max() < 1.3 * pitch


def test_each_receiver_gets_an_equal_number_within_the_zone(scene):
    gaussians = gaussians_of(scene)
    assert len(gaussians) == 41
    shares = gaussians.means.split((21, 20))
    for receiver, means in zip(scene.receivers, shares, strict=True):
        azimuths, elevations, distances = to_spherical(receiver.pose.local(means))
        assert elevations.min() >= ZONE[0] - 1e-5
        assert elevations.max() <= ZONE[1] + 1e-5
        assert distances.min() >= 2 - 1e-5
        assert distances.max() <= 5 + 1e-5
        assert azimuths.max() - azimuths.min() > 5


def test_initial_widths_reach_the_neighbours(scene):
    scene = replace(scene, receivers=scene.receivers[:1])
    gaussians = gaussians_of(scene, count=500)
    points = scene.receivers[0].pose.local(gaussians.means.detach())
    distances = points.norm(dim=-1)
    directions = (points / distances[:, None]).numpy()
    angles = cKDTree(directions).query(directions, 2)[0][:, 1].mean()
    torch.testing.assert_close(
        gaussians.scales.detach(), (gaussians.scales[:, :1]).expand(-1, 3).detach()
    )
    assert (gaussians.scales[:, 0] / distances).mean().item() == pytest.approx(
        0.5 * angles, rel=0.1
    )


def test_activations(scene):
    gaussians = gaussians_of(scene)
    torch.testing.assert_close(gaussians.opacities, torch.full((41,), 0.1))
    torch.testing.assert_close(gaussians.unit_quats.norm(dim=-1), torch.ones(41))
    torch.testing.assert_close(
        torch.linalg.eigvalsh(gaussians.covariances).sqrt(),
        gaussians.scales.sort(-1).values,
        rtol=1e-3,
        atol=1e-5,
    )
    assert gaussians.signal.shape == (41, 2, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"count": 0}, "count must be at least 1, got 0"),
        ({"near": 0.0}, "0 < near <= far < 100000 m, got 0.0 and 5.0"),
        ({"near": 6.0}, "0 < near <= far"),
        ({"far": math.inf}, "0 < near <= far < 100000 m, got 2.0 and inf"),
        ({"spread": 0.0}, "spread=0.0"),
        ({"spread": math.nan}, "spread=nan"),
        ({"signal": -1.0}, "signal=-1.0"),
        ({"degree": -1}, "degree=-1"),
        ({"opacity": 1.0}, "opacity=1.0"),
        ({"opacity": 0.0}, "opacity=0.0"),
    ],
)
def test_impossible_options_are_refused(scene, options, message):
    with pytest.raises(ValueError, match=message):
        gaussians_of(scene, **options)


def test_a_state_dict_may_have_another_number_of_gaussians(scene):
    trained, fresh = gaussians_of(scene, count=70), gaussians_of(scene)
    fresh.means.requires_grad_(False)
    holder = nn.ModuleDict({"gaussians": fresh})
    holder.load_state_dict(
        {f"gaussians.{name}": value for name, value in trained.state_dict().items()}
    )
    assert len(fresh) == 70
    for name in Gaussians.PARAMETERS:
        assert torch.equal(getattr(fresh, name), getattr(trained, name))
        assert getattr(fresh, name).requires_grad == (name != "means")


@pytest.mark.parametrize("channels", [1, 2, 3, 5])
@pytest.mark.parametrize("degree", [0, 2])
def test_a_ply_has_the_columns_that_splatting_viewers_read(scene, tmp_path, channels, degree):
    gaussians = gaussians_of(scene, channels=channels, degree=degree)
    torch.nn.init.normal_(gaussians.signal)
    gaussians.save_ply(tmp_path / "room.ply")
    ply = PlyData.read(tmp_path / "room.ply")
    assert not ply.text
    assert ply.byte_order == "<"
    vertices = ply["vertex"]
    signal = torch.zeros(max(3, channels), (degree + 1) ** 2)
    signal[:channels] = gaussians.signal[4]
    rest = [*signal[:3, 1:].flatten().tolist(), *signal[3:].flatten().tolist()]
    columns = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    columns += [f"f_rest_{i}" for i in range(len(rest))]
    columns += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert [(p.name, p.val_dtype) for p in vertices.properties] == [
        (column, "f4") for column in columns
    ]
    expected = [*gaussians.means[4].tolist(), 0, 0, 0, *signal[:3, 0].tolist(), *rest]
    expected += [
        gaussians.opacity_logits[4].item(),
        *gaussians.log_scales[4].tolist(),
        *gaussians.quats[4].tolist(),
    ]
    assert [float(vertices[name][4]) for name in columns] == expected
