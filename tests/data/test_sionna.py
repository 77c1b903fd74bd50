"""Labels of the ray tracer's rooms: where lobes point, the direct wave's phase, levels near free space."""

import math

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light
from scipy.spatial import cKDTree

from gaigs.data import load
from gaigs.data.nerf2_spectrum import NORMALISATION
from gaigs.data.simulation import patch_array
from gaigs.data.sionna import HEIGHTS, place
from gaigs.data.sionna.meshes import FURNITURE_MARGIN, edges
from gaigs.data.sionna.rooms import ROOMS
from gaigs.geometry import Grid, from_spherical
from gaigs.propagation import bartlett, min_max
from gaigs.testing import check_data

CARRIER, BANDWIDTH = 6.4896e9, 499.2e6
CLEAR = {"noise": 0.0, "sensitivity": -300.0}

every_room = pytest.mark.parametrize("name", ROOMS)


def simulate(data="sionna", **options):
    options = {"room": "slanted", "transmitters": 10, **options}
    return load({"name": data, **options}, {"name": "official", "validation": 0})


@pytest.fixture(scope="module")
def links(tracer):
    return simulate()


@pytest.fixture(scope="module")
def channels(tracer):
    return simulate("sionna_csi")


@pytest.fixture(scope="module")
def clear(tracer):
    return simulate("sionna_rssi", **CLEAR)


# --- places and array ---


@every_room
def test_transmitters_stand_free_and_everywhere(name):
    room = ROOMS[name]
    places = place(room, 400, 0)
    assert room.is_free(places).all()
    assert len(torch.unique(places, dim=0)) == 400
    low, high = HEIGHTS
    assert low <= places[:, 2].min() < low + 0.05
    assert high - 0.05 < places[:, 2].max() <= high
    level = (torch.tensor(room.floor) + torch.tensor(room.ceiling)) / 2
    assert (places[:, :2].amax(0) - places[:, :2].amin(0) > level.amax(0) - level.amin(0) - 1.2).all()
    assert not any(cuboid.contains(places, FURNITURE_MARGIN).any() for cuboid in room.furniture)
    assert torch.equal(places, place(room, 400, 0))
    assert not torch.equal(places, place(room, 400, 1))
    assert (room.pose().local(places)[:, 2] > 0).all(), "in front of the array"


def test_transmitters_are_uniform_over_free_space():
    """As many in the long arm of the L as it has of the free volume, by a fine lattice."""
    room = ROOMS["l_shape"]
    axes = [torch.arange(0.05, 8, 0.1), torch.arange(0.05, 6.6, 0.1), torch.arange(0.35, 2.0, 0.1)]
    lattice = torch.cartesian_prod(*axes)
    lattice = lattice[room.is_free(lattice)]
    places = place(room, 3000, 0)
    long_arm = lambda points: (points[:, 0] > 3.8).double().mean().item()
    assert long_arm(places) == pytest.approx(long_arm(lattice), abs=3 * 0.5 / 3000**0.5)


def test_the_array_is_square_and_half_a_wavelength_apart():
    array = patch_array(ROOMS["slanted"].pose(), 6e9).array
    assert (len(array), array.pattern) == (16, "cosine")
    distances, _ = cKDTree(array.elements.numpy()).query(array.elements.numpy(), k=2)
    np.testing.assert_allclose(distances[:, 1], speed_of_light / 6e9 / 2, rtol=1e-6)


# --- spectra ---


def test_spectra_keep_the_contract(links):
    check_data(links)
    assert links.labels.shape == (10, 90, 360)
    assert links.labels.amin((1, 2)).tolist() == [0] * 10
    assert links.labels.amax((1, 2)).tolist() == [1] * 10
    assert links.task.normalisation == NORMALISATION
    assert links.query.frequencies.tolist() == [CARRIER] * 10
    assert links.split.test.tolist() == [8, 9]
    assert links.bandwidth == BANDWIDTH
    assert torch.equal(links.edges, edges(ROOMS["slanted"].meshes()))


def test_lobes_point_at_transmitters_in_line_of_sight(links):
    """The highest pixel against the direction of each transmitter that nothing hides."""
    (receiver,) = links.receivers
    places = links.query.transmitters
    steps = torch.linspace(0.02, 0.98, 400)[:, None, None]
    between = (receiver.pose.position + steps * (places - receiver.pose.position)).flatten(0, 1)
    blocked = [c.contains(between, 0.0).unflatten(0, (400, -1)).any(0) for c in ROOMS["slanted"].furniture]
    clear = ~torch.stack(blocked).any(0)
    assert clear.sum() >= 7
    rows, columns = links.labels.flatten(1).argmax(1) // 360, links.labels.flatten(1).argmax(1) % 360
    peaks = from_spherical(torch.deg2rad(columns.float()), torch.deg2rad(rows + 1.0))
    local = receiver.pose.local(places)
    angles = torch.rad2deg(torch.acos((peaks * local / local.norm(dim=1, keepdim=True)).sum(1).clamp(-1, 1)))
    assert angles[clear].median() < 2
    assert (angles[clear] < 8).double().mean() > 0.8


def test_band_and_carrier_differ_and_a_narrow_band_is_the_carrier(links):
    carrier, narrow = simulate(spectrum="carrier"), simulate(bandwidth=1e3)
    assert carrier.bandwidth == 0
    assert torch.equal(carrier.query.transmitters, links.query.transmitters)
    assert (carrier.labels - links.labels).abs().max() > 0.05
    torch.testing.assert_close(narrow.labels, carrier.labels, rtol=0, atol=1e-3)


def test_each_place_sends_at_each_carrier(links):
    carriers = [5e9, CARRIER]
    both = simulate(frequency=carriers)
    assert both.query.frequencies.tolist() == pytest.approx(carriers * 10)
    assert both.rows.tolist() == [k // 2 for k in range(20)]
    assert torch.equal(both.query.transmitters[::2], links.query.transmitters)
    assert torch.equal(both.labels[1::2], links.labels), "the array is that of the highest carrier"
    check_data(both)


# --- channels ---


def test_channels_keep_the_contract(channels):
    check_data(channels)
    assert channels.labels.dtype == torch.complex64
    assert channels.labels.shape == (10, 16, 26)
    expected = np.linspace(CARRIER - BANDWIDTH / 2, CARRIER + BANDWIDTH / 2, 26)
    np.testing.assert_allclose(channels.task.frequencies, expected, rtol=1e-12)


def test_the_direct_wave_dominates_with_its_phase(channels):
    """Averaged over elements and subcarriers, channels are free-space waves, time dependence exp(+j omega t)."""
    (receiver,) = channels.receivers
    turned = receiver.array.elements.double() @ receiver.pose.rotation.double().T
    elements = (receiver.pose.position.double() + turned).numpy()
    distances = np.linalg.norm(channels.query.transmitters.double().numpy()[:, None] - elements, axis=-1)
    frequencies = channels.task.frequencies.numpy()
    waves = np.exp(-2j * np.pi * frequencies * distances[..., None] / speed_of_light)
    wavelengths = speed_of_light / frequencies / (4 * np.pi * distances[..., None])
    rays = channels.query.transmitters - receiver.pose.position
    cosines = (rays @ receiver.pose.rotation[:, 2] / rays.norm(dim=1)).numpy()
    shares = (channels.labels.numpy() / (waves * wavelengths * cosines[:, None, None])).mean((1, 2))
    assert np.median(np.abs(shares - 1)) < 0.1


def test_steered_channels_of_the_carrier_are_its_spectra(links):
    alone, three = simulate("sionna_csi", subcarriers=1), simulate("sionna_csi", subcarriers=3)
    assert alone.task.frequencies.tolist() == [CARRIER]
    torch.testing.assert_close(alone.labels[..., 0], three.labels[..., 1])
    steered = bartlett(alone.labels.to(torch.complex128), Grid.degrees(), alone.receivers[0].array, CARRIER)
    assert (min_max(steered) - simulate(spectrum="carrier").labels).abs().max() < 1e-4
    assert torch.equal(alone.query.transmitters, links.query.transmitters)


# --- readings ---


def test_readings_keep_the_contract(clear):
    check_data(clear)
    assert clear.labels.shape == (40,)
    assert clear.query.frequencies.tolist() == pytest.approx([2.441e9] * 40, rel=1e-6)
    assert clear.bandwidth == 78e6
    assert [receiver.name for receiver in clear.receivers] == [name for name, _ in ROOMS["slanted"].gateways]
    assert clear.split.test.tolist() == list(range(32, 40))
    assert clear.remarks.startswith("40 readings of 10 places at 4 gateways; 0 below -300 dBm")


def test_readings_fall_with_distance_as_in_a_room(clear):
    """Reflections raise the median above free space, blockers lower single readings; far readings are weaker."""
    positions = torch.stack([receiver.pose.position for receiver in clear.receivers])
    distances = (clear.query.transmitters - positions[clear.query.receivers]).norm(dim=1).double().numpy()
    friis = 20 * np.log10(speed_of_light / 2.441e9 / (4 * math.pi * distances))
    excess = clear.labels.double().numpy() - friis
    assert 0 < np.median(excess) < 4
    assert np.abs(excess).max() < 25
    slope, _ = np.polyfit(np.log10(distances), clear.labels.double().numpy(), 1)
    assert -30 < slope < -8
