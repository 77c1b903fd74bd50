"""Signal strength in the ray tracer's rooms: near free space, noise, what is not heard, and who is held out."""

import math

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light

from gaigs.data import load
from gaigs.data.sionna.rooms import ROOMS
from gaigs.testing import check_data

OFFICIAL = {"name": "official", "validation": 0}
CLEAR = {"noise": 0.0, "sensitivity": -300.0}


def readings(**options):
    return load({"name": "sionna_rssi", "room": "slanted", "transmitters": 10, **options}, OFFICIAL)


@pytest.fixture(scope="module")
def clear(tracer):
    return readings(**CLEAR)


def test_readings_keep_the_contract(clear):
    check_data(clear)
    assert clear.labels.shape == (40,)
    assert clear.query.frequencies.tolist() == pytest.approx([2.441e9] * 40, rel=1e-6)
    assert clear.bandwidth == 78e6
    assert [receiver.name for receiver in clear.receivers] == [name for name, _ in ROOMS["slanted"].gateways]
    assert clear.split.test.tolist() == list(range(32, 40))
    assert clear.remarks.startswith("40 readings of 10 places at 4 gateways; 0 below -300 dBm")


def test_readings_fall_with_distance_as_in_a_room(clear):
    """Above free space by what walls send back, more where something stands between; weaker the farther."""
    positions = torch.stack([receiver.pose.position for receiver in clear.receivers])
    distances = (clear.query.transmitters - positions[clear.query.receivers]).norm(dim=1).double().numpy()
    friis = 20 * np.log10(speed_of_light / 2.441e9 / (4 * math.pi * distances))
    excess = clear.labels.double().numpy() - friis
    assert 0 < np.median(excess) < 4
    assert np.abs(excess).max() < 25
    slope, _ = np.polyfit(np.log10(distances), clear.labels.double().numpy(), 1)
    assert -30 < slope < -8


def test_noise_is_added_and_weak_readings_are_left_out(clear):
    loud = readings(**CLEAR | {"noise": 3.0})
    errors = (loud.labels - clear.labels).double()
    assert errors.std().item() == pytest.approx(3, rel=0.4)
    assert torch.equal(readings(**CLEAR | {"noise": 3.0}).labels, loud.labels)
    level = clear.labels.double().sort().values[19:21].mean().item()  # between two of them
    heard = readings(noise=0.0, sensitivity=level)
    assert torch.equal(heard.labels, clear.labels[clear.labels >= level])
    assert f"{int((clear.labels < level).sum())} below" in heard.remarks


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"room": "round"}, "room must be one of"),
        ({"transmitters": 1}, "transmitters must be at least 2"),
        ({"noise": -1.0}, r"noise must be a standard deviation, 0 or more \[dB\], got -1"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        readings(**options)


def test_a_gateway_that_hears_nothing_is_named(tracer):
    with pytest.raises(ValueError, match=r"sensitivity must let each .* 'west' hears none of 10 at 0 dBm; lower it"):
        readings(sensitivity=0.0)
