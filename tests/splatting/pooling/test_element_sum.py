"""Channels at the elements against spherical waves from far away, and against free space."""

import cmath
import math
from dataclasses import replace

import pytest
import torch
from scipy.constants import speed_of_light

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.propagation import free_space
from gaigs.core.query import Query
from gaigs.core.scene import direct_waves
from gaigs.core.task.csi import Csi
from gaigs.data import Links, Split
from gaigs.splatting.pooling.element_sum import ElementSum
from gaigs.splatting.pooling.path_csi import PathCsi
from gaigs.testing import example_links

FREQUENCIES = torch.tensor([2.40e9, 2.44e9, 2.48e9], dtype=torch.float64)
POSES = (
    Pose.from_xyzw((0.2, 0.2, 2.5), (-0.6, 0, 0, 0.8)),
    Pose.from_xyzw((5.0, 4.0, 1.0), (0, 0.6, 0.8, 0)),
)
ROWS, COLUMNS = 6, 12


def make(pattern="isotropic", conjugated=False, gain=1.0, random_phases=False):
    """Direct waves to two turned receivers; an array whose elements are in no plane."""
    elements = torch.tensor([[0.05, 0, 0], [0, 0.07, 0], [0, 0, 0.03], [-0.04, 0.02, 0.01]])
    places = torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [6.0, 4.0, 2.0]
    )
    links = Links(
        query=Query(places, torch.arange(60) % 2),
        receivers=tuple(
            Receiver(f"gateway{i}", pose, Array(elements, pattern)) for i, pose in enumerate(POSES)
        ),
        labels=torch.zeros(60, 4, 3, dtype=torch.complex64),
        task=Csi(4, FREQUENCIES),
        split=Split("all but the last", torch.arange(50), torch.arange(0), torch.arange(50, 60)),
    )
    waves = gain * direct_waves(links.scene, links.query, FREQUENCIES, 1 if conjugated else -1)
    if random_phases:
        phases = (
            2
            * math.pi
            * torch.rand(60, 1, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        )
        waves = waves * torch.polar(torch.ones_like(phases), phases)
    return replace(links, labels=waves.to(torch.complex64))


def fitted(links, of_paths=False):
    pooling = PathCsi(links.scene) if of_paths else ElementSum(links.scene, [ROWS, COLUMNS])
    pooling.fit(links)
    return pooling


def bright(pooling, row, column, amplitudes):
    """A map with one bright direction and a complex amplitude for each subcarrier."""
    image = torch.zeros(1, pooling.channels, *pooling.grid.shape)
    for s, amplitude in enumerate(amplitudes):
        image[0, s, row, column], image[0, len(amplitudes) + s, row, column] = (
            amplitude.real,
            amplitude.imag,
        )
    return image


@pytest.mark.parametrize("pattern", ["isotropic", "cosine"])
@pytest.mark.parametrize("conjugated", [False, True])
@pytest.mark.parametrize("receiver", [0, 1])
@pytest.mark.parametrize(("row", "column"), [(4, 0), (3, 7), (5, 10), (1, 5)])
def test_a_bright_direction_is_a_plane_wave_from_there(pattern, conjugated, receiver, row, column):
    links = make(pattern, conjugated, gain=7.0)
    pooling, sign = fitted(links), 1 if conjugated else -1
    amplitudes = [0.8 * cmath.exp(0.3j), 1.1 * cmath.exp(-2j), 0.5 + 0j]
    query = Query(torch.tensor([[1.0, 2.0, 0.5]]), torch.tensor([receiver]))
    (found,) = pooling(bright(pooling, row, column, amplitudes), query)

    # The wave of a far source in that direction, over the wave at the array's middle.
    pose, array = POSES[receiver], links.receivers[receiver].array
    ray = pooling.grid.vectors()[row, column].double()
    places = array.elements.double() @ pose.rotation.double().T
    source = 1e6 * pose.rotation.double() @ ray

    def at(distances):
        return free_space(distances[:, None], FREQUENCIES, sign)

    arriving = at((source - places).norm(dim=1)) / at(source.norm()[None])
    middle = at((query.transmitters[0].double() - pose.position.double()).norm()[None])
    share = 1 / (ROWS * COLUMNS)  # of the sphere
    element = max(0.0, ray[2].item()) if pattern == "cosine" else 1.0
    unit = 7.0 * middle * share
    expected = unit * element * torch.tensor(amplitudes) * arriving
    torch.testing.assert_close(
        found, expected.to(found.dtype), rtol=0, atol=1e-4 * unit.abs().max().item()
    )
    if element:
        assert (arriving[0] - arriving[1]).abs().min() > 0.1


@pytest.mark.parametrize("conjugated", [False, True])
@pytest.mark.parametrize("receiver", [0, 1])
def test_the_direct_path_is_one_map_from_everywhere(conjugated, receiver):
    links = make(conjugated=conjugated)
    pooling, pose = fitted(links), POSES[receiver]
    ray = pooling.grid.vectors()[4, 3]
    places = torch.stack([pose.world(distance * ray) for distance in (40.0, 90.0, 333.0)])
    query = Query(places, torch.full((3,), receiver))
    found = pooling(bright(pooling, 4, 3, [ROWS * COLUMNS + 0j] * 3).expand(3, -1, -1, -1), query)
    true = direct_waves(links.scene, query, FREQUENCIES, 1 if conjugated else -1)
    assert ((found - true).abs() / true.abs()).max() < 0.01


@pytest.mark.parametrize("gain", [1e-3, 1.0, 40.0])
def test_the_strength_is_that_of_the_channels_over_free_space(gain):
    pooling = fitted(make(gain=gain))
    assert pooling.strength.item() == pytest.approx(gain, rel=1e-4)


@pytest.mark.parametrize("conjugated", [False, True])
def test_without_a_common_clock_the_amplitude_is_left_and_the_arrays_sign(conjugated):
    pooling = fitted(make(conjugated=conjugated, random_phases=True))
    assert pooling.sign == 0
    assert pooling.array_sign == (1 if conjugated else -1)
    clocked = fitted(make(conjugated=conjugated))
    image = torch.randn(1, 6, ROWS, COLUMNS, generator=torch.Generator().manual_seed(0))
    query = Query(torch.tensor([[1.0, 2.0, 0.5]]), torch.tensor([0]))
    distance = (query.transmitters[0] - POSES[0].position).double().norm()
    turned = torch.polar(
        torch.ones(3, dtype=torch.float64), 2 * math.pi / speed_of_light * FREQUENCIES * distance
    )
    turned = turned.conj() if conjugated else turned
    expected = clocked(image, query) * turned.to(torch.complex64)
    scale = expected.abs().max().item()
    torch.testing.assert_close(pooling(image, query), expected, rtol=0, atol=1e-4 * scale)


def test_the_fit_reads_no_test_label():
    links = make()
    labels = links.labels.clone()
    labels[links.split.test] = torch.nan
    assert fitted(replace(links, labels=labels)).strength == fitted(links).strength


def test_other_labels_and_arrays_are_refused():
    links = make()
    receivers = links.receivers[0], replace(links.receivers[1], array=Array.planar(3, 3, 0.06))
    cases = [
        (example_links("rssi").scene, [4, 8], "pooling 'element_sum' gives complex channels"),
        (replace(links, receivers=receivers).scene, [4, 8], "gateway1"),
        (links.scene, [4], r"pooling\.grid must be \[rows, columns\], got \[4\]"),
    ]
    for scene, grid, message in cases:
        with pytest.raises(ValueError, match=message):
            ElementSum(scene, grid)
    assert ElementSum(make("cosine").scene, [4, 8]).zone == (0, math.pi / 2)


def direct_fields(links, index):
    """Fields of the direct path at planar elements, over 1 / distance, as plane waves of each
    subcarrier.
    """
    query, array = links.query[index], links.receivers[0].array
    pose = links.receivers[0].pose
    local = (query.transmitters.double() - pose.position.double()) @ pose.rotation.double()
    lengths = local.norm(dim=1)
    ways = lengths[:, None] - local / lengths[:, None] @ array.elements.double().T
    phases = -2 * math.pi / speed_of_light * ways[..., None] * FREQUENCIES
    return torch.polar(1 / lengths[:, None, None].expand_as(phases), phases)


@pytest.mark.parametrize("conjugated", [False, True])
@pytest.mark.parametrize("random_phases", [False, True])
@pytest.mark.parametrize("gain", [1.0, 3e4])
def test_a_single_path_is_heard_as_free_space(conjugated, random_phases, gain):
    """On links of some hundred metres, where waves are plane."""
    links = make(conjugated=conjugated, gain=gain, random_phases=random_phases)
    pooling = fitted(links, of_paths=True)
    far = replace(
        links, query=replace(links.query, transmitters=100 * links.query.transmitters + 100)
    )
    index = (links.query.receivers == 0).nonzero()[:, 0]
    heard = pooling.read(direct_fields(far, index), far.query[index])
    sign = 1 if conjugated else -1
    expected = gain * direct_waves(far.scene, far.query[index], FREQUENCIES, sign)
    if random_phases:
        expected = (
            expected
            / direct_waves(far.scene, far.query[index], FREQUENCIES, sign, at_elements=False).sgn()
        )
    scale = expected.abs().amax((1, 2), keepdim=True)
    assert ((heard - expected).abs() / scale).max() < 2e-3
