"""Labels of the ray tracer's rooms: where lobes point, the direct wave's phase, levels near free
space.
"""

import math

import numpy as np
import pytest
import torch
from gaigs_sionna.meshes import FURNITURE_MARGIN
from gaigs_sionna.rooms import ROOMS
from gaigs_sionna.simulation import HEIGHTS, place
from scipy.constants import speed_of_light

from gaigs.core.geometry import from_spherical
from gaigs.data import load

CARRIER, BANDWIDTH = 6.4896e9, 499.2e6
CLEAR = {"noise": 0.0, "sensitivity": -300.0}

every_room = pytest.mark.parametrize("name", ROOMS)


def simulate(data="sionna", **options):
    options = {"room": "slanted", "transmitters": 10, **options}
    return load({"name": data, **options}, {"name": "official", "validation": 0})


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
    assert (
        places[:, :2].amax(0) - places[:, :2].amin(0) > level.amax(0) - level.amin(0) - 1.2
    ).all()
    assert not any(cuboid.contains(places, FURNITURE_MARGIN).any() for cuboid in room.furniture)
    assert torch.equal(places, place(room, 400, 0))
    assert not torch.equal(places, place(room, 400, 1))
    assert (room.pose().local(places)[:, 2] > 0).all(), "in front of the array"


# --- spectra ---


def test_lobes_point_at_transmitters_in_line_of_sight(tracer):
    """The highest pixel against the direction of each transmitter that nothing hides."""
    links = simulate()
    (receiver,) = links.receivers
    places = links.query.transmitters
    steps = torch.linspace(0.02, 0.98, 400)[:, None, None]
    between = (receiver.pose.position + steps * (places - receiver.pose.position)).flatten(0, 1)
    blocked = [
        c.contains(between, 0.0).unflatten(0, (400, -1)).any(0) for c in ROOMS["slanted"].furniture
    ]
    clear = ~torch.stack(blocked).any(0)
    assert clear.sum() >= 7
    rows, columns = (
        links.labels.flatten(1).argmax(1) // 360,
        links.labels.flatten(1).argmax(1) % 360,
    )
    peaks = from_spherical(torch.deg2rad(columns.float()), torch.deg2rad(rows + 1.0))
    local = receiver.pose.local(places)
    angles = torch.rad2deg(
        torch.acos((peaks * local / local.norm(dim=1, keepdim=True)).sum(1).clamp(-1, 1))
    )
    assert angles[clear].median() < 2
    assert (angles[clear] < 8).double().mean() > 0.8


# --- channels ---


def test_the_direct_wave_dominates_with_its_phase(tracer):
    """Averaged over elements and subcarriers, channels are free-space waves, time dependence exp(+j
    omega t).
    """
    channels = simulate("sionna_csi")
    (receiver,) = channels.receivers
    turned = receiver.array.elements.double() @ receiver.pose.rotation.double().T
    elements = (receiver.pose.position.double() + turned).numpy()
    distances = np.linalg.norm(
        channels.query.transmitters.double().numpy()[:, None] - elements, axis=-1
    )
    frequencies = channels.task.frequencies.numpy()
    waves = np.exp(-2j * np.pi * frequencies * distances[..., None] / speed_of_light)
    wavelengths = speed_of_light / frequencies / (4 * np.pi * distances[..., None])
    rays = channels.query.transmitters - receiver.pose.position
    cosines = (rays @ receiver.pose.rotation[:, 2] / rays.norm(dim=1)).numpy()
    shares = (channels.labels.numpy() / (waves * wavelengths * cosines[:, None, None])).mean((1, 2))
    assert np.median(np.abs(shares - 1)) < 0.1


# --- readings ---


def test_readings_fall_with_distance_as_in_a_room(tracer):
    """Reflections raise the median above free space, blockers lower single readings; far readings
    are weaker.
    """
    clear = simulate("sionna_rssi", **CLEAR)
    positions = torch.stack([receiver.pose.position for receiver in clear.receivers])
    distances = (
        (clear.query.transmitters - positions[clear.query.receivers]).norm(dim=1).double().numpy()
    )
    friis = 20 * np.log10(speed_of_light / 2.441e9 / (4 * math.pi * distances))
    excess = clear.labels.double().numpy() - friis
    assert 0 < np.median(excess) < 4
    assert np.abs(excess).max() < 25
    slope, _ = np.polyfit(np.log10(distances), clear.labels.double().numpy(), 1)
    assert -30 < slope < -8
