"""Signal strength in the built-in room: free space, shadows, noise, what is not heard, and who is held out."""

import math

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light

from gaigs.data import load
from gaigs.data.nerf2_rssi import gateway
from gaigs.data.synthetic import ROOM
from gaigs.data.synthetic.image_source import is_free, respond, rss_dbm
from gaigs.data.synthetic_rssi import BANDWIDTH, FREQUENCY, GATEWAYS
from gaigs.model.knn import KNearestNeighbours
from gaigs.model.mean import Mean
from gaigs.model.path_loss import PathLoss
from gaigs.testing import check_data

OFFICIAL = {"name": "official", "validation": 0}
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


def test_one_antenna_in_free_space_follows_friis_in_all_directions():
    hall = ROOM.__class__((400.0, 400.0, 400.0), ROOM.walls)
    centre, receiver = torch.full((3,), 200.0, dtype=torch.float64), gateway("hall", (200.0, 200.0, 200.0))
    ways = torch.tensor([[0, 0, 1], [0, 0, -1], [-1, 0, 0], [0.6, -0.8, 0]], dtype=torch.float64)
    offsets = torch.tensor([-BANDWIDTH / 2, 0, BANDWIDTH / 2], dtype=torch.float64)
    for distance in (0.5, 7.0):
        response = respond(hall, centre + distance * ways, receiver, FREQUENCY, offsets, 0)
        wavelengths = speed_of_light / (FREQUENCY + offsets)
        expected = wavelengths / (4 * math.pi * distance) * torch.exp(-2j * math.pi * distance / wavelengths)
        torch.testing.assert_close(response, expected.expand(4, 1, 3), rtol=1e-9, atol=0)
        losses_db = 20 * torch.log10(4 * math.pi * distance / wavelengths)
        assert rss_dbm(response).tolist() == pytest.approx([-losses_db.mean().item()] * 4, abs=1e-2)


def test_without_reflections_labels_are_free_space_less_what_stands_between():
    links = furnished_room_rssi(order=0, **CLEAR)
    lost = friis(links) - links.labels.double().numpy()
    sums = np.array([0.0])
    for box in ROOM.furniture:
        sums = np.concatenate((sums, sums + box.loss_db))
    assert np.abs(lost[:, None] - sums).min(1).max() < 1e-2
    assert 0.2 < (lost < 1e-2).mean() < 0.9
    assert lost[behind_partition(links)].min() > 20 - 1e-2


def test_the_partition_shadows(clear):
    below = friis(clear) - clear.labels.double().numpy()
    shadowed = behind_partition(clear)
    south = clear.query.receivers.numpy() == [*GATEWAYS].index("south")
    assert 0.4 < shadowed[south].mean() < 0.9
    assert below[south & shadowed].mean() > 8 + below[~shadowed].mean()
    assert below[south & shadowed].mean() < 20 + below[~shadowed].mean()  # reflections reach behind it


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


def test_the_scene_repeats_with_its_seed_alone():
    first, again, other = (furnished_room_rssi(transmitters=10, seed=seed) for seed in (5, 5, 6))
    assert torch.equal(first.query.transmitters, again.query.transmitters)
    assert torch.equal(first.labels, again.labels)
    assert not torch.equal(first.query.transmitters, other.query.transmitters)
    quiet = furnished_room_rssi(transmitters=10, seed=5, **CLEAR)
    assert torch.equal(first.query.transmitters, quiet.query.transmitters)
    assert not torch.equal(first.labels, quiet.labels)


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


@pytest.mark.parametrize(
    "options",
    [
        {"name": "official"},
        {"name": "random"},
        {"name": "sparse", "train": 60},
        {"name": "runs", "length": 7},
        {"name": "blocks", "edge": 1.0},
    ],
    ids=lambda options: options["name"],
)
def test_links_of_one_place_stay_together(options):
    links = furnished_room_rssi({"validation": 0.2, **options}, transmitters=100, sensitivity=-65.0)
    places = [{tuple(p) for p in links.query.transmitters[part].tolist()} for part in links.split.parts().values()]
    assert all(places)
    assert len(set.union(*places)) == sum(map(len, places))


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


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"transmitters": 1}, "transmitters must be at least 2"),
        ({"noise": -1.0}, r"noise must be a standard deviation, 0 or more \[dB\], got -1"),
        ({"order": -1}, "order must be the largest number of reflections"),
        ({"sensitivity": 0.0}, r"sensitivity must let each .* 'west' hears none of 4 at 0 dBm; lower it"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        furnished_room_rssi(**{"transmitters": 4, **options})
