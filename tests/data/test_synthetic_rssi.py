"""Signal strength in the built-in room: free space, shadows, noise, what is not heard, and who is held out."""

import math

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light

from gaigs.data import load
from gaigs.data.synthetic import GATEWAYS, ROOM
from gaigs.data.synthetic.image_source import is_free
from gaigs.model.knn import KNearestNeighbours
from gaigs.model.mean import Mean
from gaigs.model.path_loss import PathLoss
from gaigs.testing import check_data

OFFICIAL = {"name": "official", "validation": 0}
BANDWIDTH, FREQUENCY = 78e6, 2.441e9
CLEAR = {"noise": 0.0, "sensitivity": -300.0}
"""Options by which every place is heard, as strong as it is."""


def furnished_room_rssi(split=OFFICIAL, **options):
    return load({"name": "synthetic_rssi", **options}, split)


@pytest.fixture(scope="module")
def links():
    return furnished_room_rssi({"name": "official", "validation": 0.1})


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


def behind_partition(links):
    """Whether the straight line to the gateway passes the partition, by samples a few millimetres apart."""
    (box,) = [box for box in ROOM.furniture if box.name == "partition"]
    gateways = np.array([*GATEWAYS.values()])[links.query.receivers.numpy()]
    steps = np.linspace(0, 1, 1500)[:, None, None]
    points = gateways + steps * (links.query.transmitters.double().numpy() - gateways)
    return ((points > box.lower) & (points < box.upper)).all(-1).any(0)


def test_without_reflections_labels_are_free_space_less_what_stands_between():
    links = furnished_room_rssi(order=0, **CLEAR)
    lost = friis(links) - links.labels.double().numpy()
    sums = np.array([0.0])
    for box in ROOM.furniture:
        sums = np.concatenate((sums, sums + box.loss_db))
    assert np.abs(lost[:, None] - sums).min(1).max() < 1e-2
    assert 0.2 < (lost < 1e-2).mean() < 0.9
    assert lost[behind_partition(links)].min() > 20 - 1e-2


def test_gateways_hang_free_on_four_walls_and_hear_all_around(links):
    positions = torch.tensor([*GATEWAYS.values()])
    assert is_free(ROOM, positions).all()
    size = torch.tensor(ROOM.size)
    gaps = torch.stack((positions, size - positions), -1)[:, :2].flatten(1)  # to the four walls
    assert gaps.amin(1).tolist() == pytest.approx([0.1] * 4)
    assert len(gaps.argmin(1).unique()) == 4
    assert len(positions[:, 2].unique()) == 4
    for receiver, (name, position) in zip(links.receivers, GATEWAYS.items(), strict=True):
        assert receiver.name == name
        assert receiver.pose.position.tolist() == pytest.approx(position)
        assert torch.equal(receiver.pose.rotation, torch.eye(3))
        assert torch.equal(receiver.array.elements, torch.zeros(1, 3))


def test_labels_are_readings_in_dbm(links):
    assert links.labels.dtype == torch.float32
    assert links.labels.shape == (len(links),)
    assert (links.task.name, links.task.unit) == ("rssi", "dBm")
    assert links.query.frequencies.tolist() == pytest.approx([FREQUENCY] * len(links), rel=1e-7)
    check_data(links)
    assert -95 <= links.labels.min() < -75
    assert -45 < links.labels.max() < 0


def test_the_noise_is_as_strong_as_told_and_knows_nothing_of_the_place():
    clear = furnished_room_rssi(order=0, **CLEAR)
    loud = furnished_room_rssi(order=0, **CLEAR | {"noise": 3.0})
    errors = (loud.labels - clear.labels).double().numpy().reshape(600, 4)
    assert np.abs(errors.mean(0)).max() < 0.45
    assert errors.std(0) == pytest.approx([3.0] * 4, rel=0.1)
    assert (np.abs(errors) < 3.0).mean() == pytest.approx(0.683, abs=0.03)
    places = clear.query.transmitters[:: len(GATEWAYS)].double().numpy()
    correlations = np.corrcoef(np.hstack((errors, places)).T)[:4]
    assert np.abs(correlations - np.eye(4, 7)).max() < 0.15


def test_what_is_too_weak_is_left_out_and_counted(clear):
    links = furnished_room_rssi(transmitters=200, noise=0.0, sensitivity=-60.0)
    heard = clear.labels >= -60
    assert 0.2 < heard.double().mean() < 0.8
    assert torch.equal(links.labels, clear.labels[heard])
    assert torch.equal(links.query.transmitters, clear.query.transmitters[heard])
    assert torch.equal(links.query.receivers, clear.query.receivers[heard])
    assert links.remarks == (
        f"{int(heard.sum())} readings of 200 places at 4 gateways; {int((~heard).sum())} below -60 dBm were not heard "
        "and are left out"
    )


def test_the_last_fifth_of_the_places_tests(clear):
    links = furnished_room_rssi(transmitters=200, sensitivity=-60.0)
    last = {tuple(place) for place in clear.query.transmitters[4 * 160 :].tolist()}
    assert len(last) == 40
    tests = [tuple(place) in last for place in links.query.transmitters.tolist()]
    assert torch.equal(links.split.test, torch.tensor(tests).nonzero().flatten())
    assert torch.equal(links.split.train, (~torch.tensor(tests)).nonzero().flatten())


def test_distance_explains_some_of_it_and_neighbours_more(links):
    errors = {}
    for build in (Mean, PathLoss, lambda scene: KNearestNeighbours(scene, 20, 1.0)):
        model = build(links.scene)
        model.fit(links)
        test, found = links.split.test, []
        for receiver in range(len(links.receivers)):
            index = test[links.query.receivers[test] == receiver]
            found.append((model.predict(links.query[index]) - links.labels[index]).abs())
        errors[type(model).__name__] = torch.cat(found).mean().item()
    assert errors == pytest.approx({"Mean": 9.06, "PathLoss": 5.90, "KNearestNeighbours": 3.44}, abs=0.05)
    assert min(errors.values()) > 2 * math.sqrt(2 / math.pi)  # what the noise alone leaves
