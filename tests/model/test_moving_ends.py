"""Pairs at arbitrary places: receivers that are many places of one radio, with few links each."""

import time
from dataclasses import replace

import numpy as np
import pytest
import torch

import gaigs
from gaigs.data.rssi_csv import COLUMNS

PLACES = 300


def pairs(places=PLACES, links=5, seed=0):
    """Levels over 10 m x 10 m x 2 m: a law of distance and a smooth field over both ends, each
    receiver at a place of its own.
    """
    rng = np.random.default_rng(seed)
    receivers = rng.uniform(0, (10, 10, 2), (places, 3)).repeat(links, 0)
    transmitters = rng.uniform(0, (10, 10, 2), (places * links, 3))
    apart = np.linalg.norm(transmitters - receivers, axis=1).clip(0.1)
    field = 6 * np.sin(transmitters[:, 0] / 2) * np.cos(receivers[:, 1] / 2)
    levels = -40 - 25 * np.log10(apart) + field + rng.standard_normal(len(apart))
    return np.column_stack((transmitters, receivers, levels))


def as_frame(table):
    return dict(zip(COLUMNS, table.T, strict=True))


@pytest.fixture(scope="module")
def links():
    return gaigs.links(as_frame(pairs(60)), frequency=2.4e9)


def mae(model, links):
    test = links.split.test
    return (model.predict(links.query[test]) - links.labels[test]).abs().mean().item()


@pytest.mark.parametrize("split", ["random", "receivers"])
def test_models_of_pairs_train_in_seconds(split):
    links = gaigs.links(as_frame(pairs()), frequency=2.4e9, split=split)
    assert links.one_radio
    assert len(links.receivers) == PLACES
    errors = {}
    for name in ("mean", "path_loss", "knn", "gaussian_process"):
        began = time.process_time()
        model = gaigs.train(name, links)
        errors[name] = mae(model, links)
        assert time.process_time() - began < 30
        new = model.predict([[1.0, 2.0, 1.0], [5.0, 2.0, 1.0]], receiver=[3.0, 2.0, 1.0])
        assert new.shape == (2,)
        low, high = model.predict([1.0, 2.0, 1.0], receiver=[3.0, 2.0, 1.0], interval=0.9)[2:4]
        assert low < high
    # Both ends tell the field; the distance alone does not.
    assert errors["gaussian_process"] < errors["path_loss"] - 0.5
    assert errors["knn"] < errors["mean"]
    assert errors["path_loss"] < errors["mean"] - 1


def test_places_of_one_radio_share_what_a_receiver_has_of_its_own(links):
    model = gaigs.train("path_loss", links)
    assert model.levels.shape == model.exponents.shape == (1,)
    process = gaigs.train("gaussian_process", links).scalar
    assert process.logarithms.shape == (1, 3)
    assert process.places.shape == (len(links.split.known), 6)
    mirrored = gaigs.registry.registry("model").build("mirrored", scene=links.scene)
    assert mirrored.placement.receiver_gains.shape == (1,)


@pytest.mark.parametrize("name", ["knn", "gaussian_process", "path_loss"])
def test_a_new_receiver_at_a_known_place_is_the_known_one(links, name, tmp_path):
    model = gaigs.train(name, links)
    places = links.query.transmitters[:4]
    receiver = replace(links.receivers[7], name="here")
    there = model.predict(places, receiver=receiver)
    torch.testing.assert_close(there, model.predict(places, receiver=7))
    moved = model.at_receivers([receiver])
    moved.save(tmp_path / "here.ckpt")
    loaded = gaigs.load(tmp_path / "here.ckpt")
    torch.testing.assert_close(loaded.predict(places)[:, 0], there)


def test_each_link_may_have_a_receiver_of_its_own():
    links = gaigs.links(as_frame(pairs(200, 1)))
    model = gaigs.train("gaussian_process", links)
    assert len(links.receivers) == 200
    assert mae(model, links) < 5
    assert model.predict([1.0, 2.0, 1.0], receiver=[3.0, 2.0, 1.0], interval=0.9)[1] > 0


def test_mirrored_gaussians_learn_pairs():
    links = gaigs.links(as_frame(pairs(30)), frequency=2.4e9)
    options = {"trainer.max_steps": 10, "kriging": False}
    model = gaigs.train("mirrored", links, progress=False, **options)
    assert mae(model, links) < mae(gaigs.train("mean", links), links)
    assert model.predict([1.0, 2.0, 1.0], receiver=[3.0, 2.0, 1.0], interval=0.5)[1] > 0


def test_channels_of_an_array_that_moves_have_one_gain():
    """21 places of an array that hears 4 beacons each."""
    room = gaigs.links("synthetic_csi", transmitters=4, receivers=21, order=0)
    links = replace(room, one_radio=True)
    split = {"name": "random", "test": 0.25, "validation": 0.25, "seed": 0}
    links = gaigs.data.divide(links, split)
    model = gaigs.train("friis", links)
    assert model.gains.shape == (1,)
    test = links.split.test
    error = (model.predict(links.query[test]) - links.labels[test]).abs().square().sum()
    assert error < 0.5 * links.labels[test].abs().square().sum()  # furniture blocks some


def test_readers_tell_moving_ends_from_fixed_ones(tmp_path):
    table = pairs(21, 4)
    np.savetxt(tmp_path / "a.csv", table, "%.4f", ",", header=",".join(COLUMNS), comments="")
    read = {"file": str(tmp_path / "a.csv"), "split": "random"}
    links = gaigs.links("rssi_csv", **read)
    assert links.one_radio
    assert "of a moving receiver" in links.remarks
    assert not gaigs.links("rssi_csv", one_radio=False, **read).one_radio
    assert not gaigs.links(as_frame(pairs(4, 30))).one_radio  # four gateways
    few = gaigs.links(as_frame(table))
    assert few.one_radio
    assert len(few.receivers) == 21
    named = {"a": table[:, 0], "b": table[:, 1], "c": table[:, 2], "dbm": table[:, 6]}
    named |= dict(zip("uvw", table[:, 3:6].T, strict=True))
    other = gaigs.links(named, x="a", y="b", z="c", receiver=["u", "v", "w"], level="dbm")
    assert torch.equal(other.labels, few.labels)


@pytest.mark.parametrize(
    ("stations", "places", "links"), [(12, 8, 96), (30, 20, 600), (50, 1500, 1500)]
)
def test_fixed_stations_of_a_survey_do_not_move(stations, places, links):
    """A walk among all stations, few places of many stations, and a drive that logs one cell."""
    rng = np.random.default_rng(0)
    at = np.arange(links)
    arrays = {
        "transmitters": rng.uniform(0, 9, (places, 3))[at % places],
        "receivers": rng.uniform(0, 9, (stations, 3))[at * stations // links],
        "labels": rng.uniform(-90, -40, links),
    }
    links = gaigs.links(task="rssi", **arrays)
    assert not links.one_radio
    assert len(links.receivers) == stations


def test_adapt_says_that_one_radio_is_known(links):
    model = gaigs.train("path_loss", links)
    with pytest.raises(ValueError, match="one radio"):
        model.adapt(links)
