"""Mixtures of processes around a place against the formulas, and on levels that vary by place."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.spatial.distance import cdist

from gaigs.core.query import Query
from gaigs.data import Split
from gaigs.kriging.likelihood import Choice
from gaigs.kriging.local_mixture import LocalMixture, LocalMixtures, MixtureOptions
from gaigs.kriging.neighbours import Readings
from gaigs.kriging.scalar import ScalarProcess
from gaigs.model.gaussian_process import GaussianProcess
from gaigs.testing import example_links


def mixtures(options, count=40, receivers=2):
    """Mixtures of readings at the same places to several receivers."""
    rng = np.random.default_rng(0)
    places = torch.from_numpy(rng.uniform(size=(count, 3)) * 6).repeat(receivers, 1)
    numbers = torch.arange(receivers).repeat_interleave(count)
    readings = Readings(example_links("rssi").scene, places, numbers, 8)
    values = torch.from_numpy(rng.standard_normal(len(places)))
    logarithms = torch.tensor([[1.5, 2.0, 1.0], [1.5, 1.0, 0.5]]).double().log()
    return LocalMixtures(readings, values, logarithms, Choice(0.5), options)


def asked(count=7):
    return torch.from_numpy(np.random.default_rng(1).uniform(size=(count, 3)) * 6)


@pytest.mark.parametrize("neighbours", [10, 60])
def test_one_candidate_is_the_process_of_the_readings_around(neighbours):
    """With a fixed variance; 60 readings around are more than a receiver has."""
    options = MixtureOptions(neighbours, lengths=(0.0,), ratios=(0.0,), degrees=1e12)
    all_of = mixtures(options)
    places, which = asked(), torch.tensor([0, 1, 0, 1, 0, 1, 0])
    found = all_of.at(places, which)
    known, values = all_of.readings.places.numpy(), all_of.values.numpy()
    for row, receiver in enumerate(which.tolist()):
        length, signal, noise = all_of.logarithms[receiver].exp().tolist()
        own = np.flatnonzero(all_of.readings.receivers == receiver)
        apart = np.linalg.norm(known[own] - places[row].numpy(), axis=1)
        near = own[np.argsort(apart)[:neighbours]]
        noisy = signal**2 * np.exp(-cdist(known[near], known[near]) / length)
        noisy += noise**2 * np.eye(len(near))
        towards = signal**2 * np.exp(-cdist(known[near], places[row : row + 1].numpy()) / length)
        weights = np.linalg.solve(noisy, towards[:, 0])
        assert found.mean[row] == pytest.approx(weights @ values[near])
        variance = signal**2 + noise**2 - weights @ towards[:, 0]
        assert found.variance[row] == pytest.approx(variance)


def test_the_likelier_length_has_the_weight():
    options = MixtureOptions(24, lengths=(-2.0, 1.0), ratios=(0.0,), scatter=100.0)
    all_of = mixtures(options, 400)
    places = all_of.readings.places
    apart = cdist(places[:400], places[:400])
    draw = np.random.default_rng(2).standard_normal((2, 400))
    middle = math.exp(all_of.logarithms[:, 0].mean())
    smooth = np.linalg.cholesky(np.exp(-apart / middle / math.exp(1.0)) + 0.1 * np.eye(400))
    values = torch.from_numpy(np.concatenate((smooth @ draw[0], 1.5 * draw[1])))
    found = all_of._replace(values=values).at(asked(40), torch.arange(40) % 2)
    shares = found.logarithms.exp()[:, 1]  # of the long length
    assert shares[::2].mean() > 0.9 > 0.3 > shares[1::2].mean()


def test_candidates_near_a_receivers_own_noise_weigh_more():
    all_of = mixtures(MixtureOptions(8, lengths=(0.0,), ratios=(-1.0, 1.0)))
    logarithms = torch.tensor([[1.5, 2.0, 0.5], [1.5, 2.0, 2.0]]).double().log()
    alike = all_of._replace(values=all_of.values[:40].repeat(2), logarithms=logarithms)
    found = alike.at(asked().repeat(2, 1), torch.arange(2).repeat_interleave(7))
    quiet, noisy = found.logarithms[:, 1].split(7)
    assert (noisy > quiet).all()


def test_readings_that_do_not_exist_have_no_say():
    """40 readings of each receiver are all of them, with or without room for 20 more."""
    places, which = asked(), torch.arange(7) % 2
    exact, more = (mixtures(MixtureOptions(count)).at(places, which) for count in (40, 60))
    for one, other in zip(exact, more, strict=True):
        torch.testing.assert_close(one, other)


def test_no_places_have_no_mixtures():
    none = mixtures(MixtureOptions(12)).at(torch.zeros(0, 3).double(), torch.zeros(0).long())
    assert none.mean.shape == none.variance.shape == (0,)


def test_receivers_share_matrices_without_a_difference():
    all_of = mixtures(MixtureOptions(12))
    # Both receivers at four places, and one alone at three.
    places, which = asked().repeat(2, 1)[:11], torch.arange(2).repeat_interleave(7)[:11]
    together = all_of.at(places, which)
    for receiver in range(2):
        alone = all_of.at(places[which == receiver], which[which == receiver])
        for one, other in zip(alone, together, strict=True):
            torch.testing.assert_close(one, other[which == receiver])


def test_a_reading_at_the_origin_is_of_its_receiver_alone():
    rng = np.random.default_rng(0)
    places = torch.from_numpy(6 * rng.uniform(size=(10, 3)))
    places = torch.cat((places, torch.zeros(1, 3), places))
    readings = Readings(example_links("rssi").scene, places, torch.arange(21) // 11, 8)
    logarithms = torch.tensor([[1.5, 2.0, 1.0], [1.5, 1.0, 0.5]]).double().log()
    values = torch.from_numpy(rng.standard_normal(21))
    all_of = LocalMixtures(readings, values, logarithms, Choice(0.5))
    origin, which = torch.zeros(2, 3).double(), torch.tensor([0, 1])
    together = all_of.at(origin, which).mean
    alone = [all_of.at(origin[:1], which[row : row + 1]).mean for row in range(2)]
    torch.testing.assert_close(together, torch.cat(alone))


def test_the_density_is_that_of_a_mixture_of_students_t():
    weights, means, squares = [0.3, 0.7], [-1.0, 2.0], [0.5, 4.0]
    fields = (torch.tensor([field]).double() for field in (weights, means, squares))
    logarithms, *rest = fields
    mixture = LocalMixture(logarithms.log(), *rest, torch.tensor([[7.0]]).double())
    parts = [
        weight * stats.t(7, mean, square**0.5).pdf(0.4)
        for weight, mean, square in zip(weights, means, squares, strict=True)
    ]
    assert mixture.log_density(torch.tensor([0.4]).double()).exp() == pytest.approx(sum(parts))


def drawn(roughness, count=700, noise=0.5):
    """Levels whose length falls by ``roughness`` in half of the box; places hear either receiver."""
    links, rng = example_links("rssi"), np.random.default_rng(0)
    places = rng.uniform(size=(count, 3)) * (60, 40, 0)
    apart = cdist(places, places)
    levels = np.empty(count)
    is_left = places[:, 0] < 30
    for half, length in ((is_left, 40.0), (~is_left, 40.0 / roughness)):
        factor = np.linalg.cholesky(np.exp(-apart / length) + 1e-9 * np.eye(count))
        levels[half] = (4 * factor @ rng.standard_normal(count))[half]
    levels += noise * rng.standard_normal(count) - 60
    query = Query(torch.from_numpy(places).float(), torch.arange(count) % 2)
    split = Split("drawn", *torch.arange(count).split((count // 2, 0, count - count // 2)))
    labels = torch.from_numpy(levels).float()
    return replace(links, query=query, labels=labels, rows=None, split=split)


def errors(links, is_local=None):
    model = GaussianProcess(links.scene)
    process = model.scalar
    model.fit(links)
    if is_local is not None:
        process.choice[3] = is_local
        process.solve(process.places, process.receivers, process.values)
    test = links.split.test
    return (model.predict(links.query[test]) - links.labels[test]).abs().mean(), model


def test_lengths_that_differ_by_place_are_found():
    links = drawn(20.0)
    error, model = errors(links)
    assert model.facts()["local_mixtures"] == 1.0
    assert error < errors(links, False)[0]
    copy = GaussianProcess(links.scene)
    copy.load_state_dict(model.state_dict())
    query = links.query[links.split.test]
    torch.testing.assert_close(copy.predict(query), model.predict(query))


def test_deviations_take_the_mixtures_of_the_means_until_hyperparameters_change(monkeypatch):
    links = drawn(20.0)
    process = errors(links)[1].scalar
    places, which = links.query.transmitters[:9].double(), links.query.receivers[:9]
    asked_for, at = [], LocalMixtures.at
    monkeypatch.setattr(LocalMixtures, "at", lambda *args: asked_for.append(1) or at(*args))
    process(places, which)
    before = process.deviations(places, which)
    assert len(asked_for) == 1
    process(places, which)
    assert len(asked_for) == 2, "a second prediction takes the time of the first"
    other = ScalarProcess(links.scene)
    other.logarithms, other.choice = process.logarithms + 1, process.choice
    process.take(other)
    assert not torch.isclose(process.deviations(places, which), before).any()


def test_one_length_everywhere_costs_little():
    links = drawn(1.0)
    assert errors(links, True)[0] < 1.02 * errors(links, False)[0]


def test_checkpoints_of_before_have_one_process_everywhere():
    process = ScalarProcess(example_links("rssi").scene)
    state = process.state_dict()
    state["choice"] = torch.tensor([1.5, 4.0, math.nan]).double()
    process.load_state_dict(state)
    assert process.facts()["smoothness"] == 1.5
    assert "local_mixtures" not in process.facts()
