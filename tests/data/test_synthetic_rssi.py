"""Signal strength in the built-in room: free space, shadows, noise, what is not heard, and who is held out."""

import inspect
import math

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from scipy.constants import speed_of_light

from gaigs.configuration import conf_dir
from gaigs.data.synthetic import ROOM
from gaigs.data.synthetic.image_source import is_free, respond_isotropic, rss_dbm
from gaigs.data.synthetic_rssi import BANDWIDTH, FREQUENCY, GATEWAYS, furnished_room_rssi
from gaigs.model.knn import KNearestNeighbours
from gaigs.model.mean import Mean
from gaigs.model.path_loss import PathLoss
from gaigs.registry import registry

OFFICIAL = {"protocol": "official", "validation": 0}
CLEAR = {"noise": 0.0, "sensitivity": -300.0}
"""Options by which every place is heard, as strong as it is."""


@pytest.fixture(scope="module")
def links():
    return furnished_room_rssi({"protocol": "official", "validation": 0.1})


@pytest.fixture(scope="module")
def clear():
    return furnished_room_rssi(OFFICIAL, transmitters=200, **CLEAR)


def friis(links):
    """Band's mean power in free space at 0 dBm [dBm], from the frequencies of a fine comb."""
    frequencies = np.linspace(FREQUENCY - BANDWIDTH / 2, FREQUENCY + BANDWIDTH / 2, 101)
    gateways = np.array([*GATEWAYS.values()])[links.receiver_index.numpy()]
    distances = np.linalg.norm(links.transmitters.double().numpy() - gateways, axis=1)
    power = (speed_of_light / (4 * math.pi * distances[:, None] * frequencies)) ** 2
    return 10 * np.log10(power.mean(1))


def behind_partition(links):
    """Whether the straight line to the gateway passes the partition, by samples a few millimetres apart."""
    (box,) = [box for box in ROOM.furniture if box.name == "partition"]
    gateways = np.array([*GATEWAYS.values()])[links.receiver_index.numpy()]
    steps = np.linspace(0, 1, 1500)[:, None, None]
    points = gateways + steps * (links.transmitters.double().numpy() - gateways)
    return ((points > box.lower) & (points < box.upper)).all(-1).any(0)


def test_one_antenna_in_free_space_follows_friis_in_all_directions():
    hall = ROOM.__class__((400.0, 400.0, 400.0), ROOM.walls)
    centre = torch.full((3,), 200.0, dtype=torch.float64)
    ways = torch.tensor([[0, 0, 1], [0, 0, -1], [-1, 0, 0], [0.6, -0.8, 0]], dtype=torch.float64)
    offsets = torch.tensor([-BANDWIDTH / 2, 0, BANDWIDTH / 2], dtype=torch.float64)
    for distance in (0.5, 7.0):
        response = respond_isotropic(hall, centre + distance * ways, centre, FREQUENCY, offsets, 0)
        wavelengths = speed_of_light / (FREQUENCY + offsets)
        expected = wavelengths / (4 * math.pi * distance) * torch.exp(-2j * math.pi * distance / wavelengths)
        torch.testing.assert_close(response, expected.expand(4, 1, 3), rtol=1e-9, atol=0)
        losses_db = 20 * torch.log10(4 * math.pi * distance / wavelengths)
        assert rss_dbm(response).tolist() == pytest.approx([-losses_db.mean().item()] * 4, abs=1e-2)


def test_without_reflections_labels_are_free_space_less_what_stands_between():
    links = furnished_room_rssi(OFFICIAL, order=0, **CLEAR)
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
    south = clear.receiver_index.numpy() == [*GATEWAYS].index("south")
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


def test_labels_are_readings_in_dbm(links):
    assert links.labels.dtype == torch.float32
    assert links.labels.shape == (len(links.transmitters),)
    assert links.grid is None
    assert links.normalisation == "dBm"
    assert -95 <= links.labels.min() < -75
    assert -45 < links.labels.max() < 0


def test_the_noise_is_as_strong_as_told_and_knows_nothing_of_the_place():
    clear = furnished_room_rssi(OFFICIAL, order=0, **CLEAR)
    loud = furnished_room_rssi(OFFICIAL, order=0, **CLEAR | {"noise": 3.0})
    errors = (loud.labels - clear.labels).double().numpy().reshape(600, 4)
    assert np.abs(errors.mean(0)).max() < 0.45
    assert errors.std(0) == pytest.approx([3.0] * 4, rel=0.1)
    assert (np.abs(errors) < 3.0).mean() == pytest.approx(0.683, abs=0.03)
    places = clear.transmitters[:: len(GATEWAYS)].double().numpy()
    correlations = np.corrcoef(np.hstack((errors, places)).T)[:4]
    assert np.abs(correlations - np.eye(4, 7)).max() < 0.15


def test_the_scene_repeats_with_its_seed_alone():
    first, again, other = (furnished_room_rssi(OFFICIAL, transmitters=10, seed=seed) for seed in (5, 5, 6))
    assert torch.equal(first.transmitters, again.transmitters)
    assert torch.equal(first.labels, again.labels)
    assert not torch.equal(first.transmitters, other.transmitters)
    quiet = furnished_room_rssi(OFFICIAL, transmitters=10, seed=5, **CLEAR)
    assert torch.equal(first.transmitters, quiet.transmitters)
    assert not torch.equal(first.labels, quiet.labels)


def test_what_is_too_weak_is_left_out_and_counted(clear):
    links = furnished_room_rssi(OFFICIAL, transmitters=200, noise=0.0, sensitivity=-60.0)
    heard = clear.labels >= -60
    assert 0.2 < heard.double().mean() < 0.8
    assert torch.equal(links.labels, clear.labels[heard])
    assert torch.equal(links.transmitters, clear.transmitters[heard])
    assert torch.equal(links.receiver_index, clear.receiver_index[heard])
    assert links.remarks == (
        f"{int(heard.sum())} readings of 200 places at 4 gateways; {int((~heard).sum())} below -60 dBm were not heard "
        "and are left out"
    )


def test_the_last_fifth_of_the_places_tests(clear):
    links = furnished_room_rssi(OFFICIAL, transmitters=200, sensitivity=-60.0)
    last = {tuple(place) for place in clear.transmitters[4 * 160 :].tolist()}
    assert len(last) == 40
    tests = [tuple(place) in last for place in links.transmitters.tolist()]
    assert torch.equal(links.split.test, torch.tensor(tests).nonzero().flatten())
    assert torch.equal(links.split.train, (~torch.tensor(tests)).nonzero().flatten())


@pytest.mark.parametrize(
    "options",
    [
        {"protocol": "official"},
        {"protocol": "random"},
        {"protocol": "sparse", "train": 60},
        {"protocol": "runs", "length": 7},
        {"protocol": "blocks", "edge": 1.0},
    ],
    ids=lambda options: options["protocol"],
)
def test_links_of_one_place_stay_together(options):
    links = furnished_room_rssi({"validation": 0.2, **options}, transmitters=100, sensitivity=-65.0)
    places = [{tuple(p) for p in links.transmitters[part].tolist()} for part in links.split.parts().values()]
    assert all(places)
    assert len(set.union(*places)) == sum(map(len, places))


def test_distance_explains_some_of_it_and_neighbours_more(links):
    errors = {}
    for build in (Mean, PathLoss, lambda scene: KNearestNeighbours(scene, 20, 1.0)):
        model = build(links.scene)
        model.fit(links)
        test, found = links.split.test, []
        for receiver in range(len(links.receivers)):
            index = test[links.receiver_index[test] == receiver]
            found.append((model.predict(links.transmitters[index], receiver) - links.labels[index]).abs())
        errors[type(model).__name__] = torch.cat(found).mean().item()
    assert errors == pytest.approx({"Mean": 9.06, "PathLoss": 5.90, "KNearestNeighbours": 3.44}, abs=0.05)
    assert min(errors.values()) > 2 * math.sqrt(2 / math.pi)  # what the noise alone leaves


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"transmitters": 1}, "transmitters must be at least 2"),
        ({"noise": -1.0}, r"noise must be a standard deviation, 0 or more \[dB\], got -1"),
        ({"noise": math.nan}, "noise must be a standard deviation"),
        ({"noise": math.inf}, "noise must be a standard deviation"),
        ({"order": -1}, "order must be the largest number of reflections"),
        ({"sensitivity": 0.0}, r"sensitivity must let each .* 'west' hears none of 4 at 0 dBm; lower it"),
        ({"sensitivity": math.nan}, "sensitivity must let each gateway hear"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        furnished_room_rssi(OFFICIAL, **{"transmitters": 4, **options})


def test_the_configuration_names_every_option_with_its_default():
    config = OmegaConf.to_container(OmegaConf.load(conf_dir() / "data" / "synthetic_rssi.yaml"))
    assert registry("data").get(config.pop("name")) is furnished_room_rssi
    parameters = inspect.signature(furnished_room_rssi).parameters
    assert config.keys() == parameters.keys()
    defaults = {key: p.default for key, p in parameters.items() if p.default is not p.empty}
    assert {key: (config[key], type(config[key])) for key in defaults} == {
        key: (value, type(value)) for key, value in defaults.items()
    }
    links = furnished_room_rssi(config["split"], transmitters=50)
    assert links.split.name == "official, validation 0.1, seed 0"
