"""Signal strength in the built-in room: free space, shadows, noise, unheard readings and the split."""

import math

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light

from gaigs.data import load
from gaigs.data.synthetic import GATEWAYS, ROOM

OFFICIAL = {"name": "official", "validation": 0}
BANDWIDTH, FREQUENCY = 78e6, 2.441e9
CLEAR = {"noise": 0.0, "sensitivity": -300.0}
"""Options by which every place is heard, as strong as it is."""


def furnished_room_rssi(split=OFFICIAL, **options):
    return load({"name": "synthetic_rssi", **options}, split)


@pytest.fixture(scope="module")
def clear():
    return furnished_room_rssi(transmitters=200, **CLEAR)


def friis(links):
    """Band's mean power in free space at 0 dBm [dBm], from the frequencies of a fine comb."""
    frequencies = np.linspace(FREQUENCY - BANDWIDTH / 2, FREQUENCY + BANDWIDTH / 2, 101)
    gateways = np.array([*GATEWAYS.values()])[links.query.receivers.numpy()]
    distances = np.linalg.norm(links.query.transmitters.double().numpy() - gateways, axis=1)
    power = (speed_of_light / (4 * math.pi * distances[:, None] * frequencies)) ** 2
    return 10 * np.log10(power.mean(1))


def test_without_reflections_labels_are_free_space_less_furniture():
    links = furnished_room_rssi(order=0, **CLEAR)
    lost = friis(links) - links.labels.double().numpy()
    sums = np.array([0.0])
    for box in ROOM.furniture:
        sums = np.concatenate((sums, sums + box.loss_db))
    assert np.abs(lost[:, None] - sums).min(1).max() < 1e-2
    assert 0.2 < (lost < 1e-2).mean() < 0.9


def test_the_noise_has_its_deviation_and_is_independent_of_the_place():
    clear = furnished_room_rssi(order=0, **CLEAR)
    loud = furnished_room_rssi(order=0, **CLEAR | {"noise": 3.0})
    errors = (loud.labels - clear.labels).double().numpy().reshape(600, 4)
    assert np.abs(errors.mean(0)).max() < 0.45
    assert errors.std(0) == pytest.approx([3.0] * 4, rel=0.1)
    assert (np.abs(errors) < 3.0).mean() == pytest.approx(0.683, abs=0.03)
    places = clear.query.transmitters[:: len(GATEWAYS)].double().numpy()
    correlations = np.corrcoef(np.hstack((errors, places)).T)[:4]
    assert np.abs(correlations - np.eye(4, 7)).max() < 0.15


def test_weak_readings_are_left_out_and_counted(clear):
    links = furnished_room_rssi(transmitters=200, noise=0.0, sensitivity=-60.0)
    heard = clear.labels >= -60
    assert 0.2 < heard.double().mean() < 0.8
    assert torch.equal(links.labels, clear.labels[heard])
    assert torch.equal(links.query.transmitters, clear.query.transmitters[heard])
    assert torch.equal(links.query.receivers, clear.query.receivers[heard])
    assert links.remarks == (
        f"{int(heard.sum())} readings of 200 places at 4 gateways; {int((~heard).sum())} below -60 "
        "dBm were not heard "
        "and are left out"
    )


def test_the_last_fifth_of_the_places_tests(clear):
    links = furnished_room_rssi(transmitters=200, sensitivity=-60.0)
    last = {tuple(place) for place in clear.query.transmitters[4 * 160 :].tolist()}
    assert len(last) == 40
    tests = [tuple(place) in last for place in links.query.transmitters.tolist()]
    assert torch.equal(links.split.test, torch.tensor(tests).nonzero().flatten())
    assert torch.equal(links.split.train, (~torch.tensor(tests)).nonzero().flatten())
