"""The process of labels of one number against numpy and scipy, and against draws of processes that
are known.
"""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.integrate import quad
from scipy.optimize import approx_fprime
from scipy.spatial.distance import cdist

import gaigs
from gaigs.core.query import Batch, Query
from gaigs.data import Split
from gaigs.kriging.likelihood import Choice, log_density
from gaigs.kriging.links import coordinates, folds_of
from gaigs.kriging.neighbours import Readings
from gaigs.kriging.scalar import ScalarProcess
from gaigs.kriging.scalar_fit import HeldOutCost, ScalarOptions
from gaigs.kriging.tiles import Tiles
from gaigs.model.gaussian_process import GaussianProcess
from gaigs.runs import evaluation
from gaigs.testing import example_links

BOX = torch.tensor([6.0, 4.0, 2.0])
MATERN = {
    0.5: lambda x: np.exp(-x),
    1.5: lambda x: (1 + math.sqrt(3) * x) * np.exp(-math.sqrt(3) * x),
}


@pytest.fixture(autouse=True)
def few_neighbours(monkeypatch):
    monkeypatch.setattr(ScalarProcess, "options", ScalarOptions(neighbours=16))


def drawn(
    lengths=(1.0, 1.0),
    smoothness=0.5,
    signal=4.0,
    noise=1.0,
    degrees=math.inf,
    count=300,
    height=2.0,
    carriers=(),
):
    """Levels of ``count`` places at each of two receivers; three tenths test."""
    links, rng = example_links("rssi"), np.random.default_rng(0)
    places = torch.from_numpy(rng.uniform(size=(count, 3)) * (6, 4, height)).float()
    apart, labels = cdist(places, places), []
    for length in lengths:
        factor = np.linalg.cholesky(MATERN[smoothness](apart / length) + 1e-9 * np.eye(count))
        scatter = (
            rng.standard_normal(count) if math.isinf(degrees) else rng.standard_t(degrees, count)
        )
        labels.append(-60 + signal * factor @ rng.standard_normal(count) + noise * scatter)
    frequencies = (
        torch.tensor(carriers)[torch.arange(2 * count) % len(carriers)] if carriers else None
    )
    query = Query(places.repeat(2, 1), torch.arange(2).repeat_interleave(count), frequencies)
    parts = [
        part.repeat(2)
        for part in torch.arange(count).split((7 * count // 10, 0, count - 7 * count // 10))
    ]
    parts = [torch.cat((part[: len(part) // 2], part[len(part) // 2 :] + count)) for part in parts]
    values = torch.from_numpy(np.concatenate(labels)).float()
    return replace(links, query=query, labels=values, rows=None, split=Split("drawn", *parts))


def fitted(links, **options):
    model = GaussianProcess(links.scene, **options)
    model.fit(links)
    return model


def known(links):
    index = links.split.train
    query = links.query[index]
    return coordinates(links.scene, query, 1.0), query.receivers, links.labels[index].double()


def first(readings, count):
    """The readings around the first ones, each without itself."""
    rows = torch.arange(count)
    places, receivers = readings.places[rows], readings.receivers[rows]
    every = torch.arange(len(readings.places))
    return readings.around(places, receivers, readings.nearest(places, receivers, rows, every))


@pytest.mark.parametrize("degrees", [math.inf, 4.0])
@pytest.mark.parametrize(("variance", "noise"), [(4.0, 0.5), (0.2, 3.0), (1.0, 1.0)])
def test_the_density_is_that_of_a_normal_variable_plus_noise(degrees, variance, noise):
    errors = np.array([0.0, 0.7, 5.0, 12.0 if math.isinf(degrees) else 40.0])
    scatter = stats.norm if math.isinf(degrees) else stats.t(degrees)

    def both(u, e):
        return stats.norm.pdf(u) * scatter.pdf((e - u * variance**0.5) / noise) / noise

    expected = [
        np.log(quad(both, -20, 20, args=(e,), points=[0, e / variance**0.5], limit=400)[0])
        for e in errors
    ]
    size = torch.ones(4, dtype=torch.float64)
    found = log_density(torch.from_numpy(errors), variance * size, noise**2 * size, degrees)
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-3)


@pytest.mark.parametrize("smoothness", [0.5, 1.5])
@pytest.mark.parametrize("carriers", [(), (1e9, 1.7e9, 2.9e9)])
def test_means_and_deviations_are_the_formula(smoothness, carriers):
    links = drawn(count=60, carriers=carriers)
    places, receivers, values = known(links)
    process = ScalarProcess(links.scene)
    process.logarithms.copy_(torch.tensor([[1.5, 4.0, 1.0], [0.7, 3.0, 2.0]]).log())
    process.choice.copy_(torch.tensor(Choice(smoothness, 4.0, 3.0 if carriers else math.nan)))
    process.solve(places, receivers, values)
    query = replace(links.query[links.split.test], receivers=torch.ones(36, dtype=torch.long))
    asked, own = coordinates(links.scene, query, 1.0), receivers == 1

    def stretch(points):
        return np.hstack((points[:, :3], 3.0 * points[:, 3:]))

    def kernel(a, b):
        return 9 * MATERN[smoothness](cdist(stretch(a.numpy()), stretch(b.numpy())) / 0.7)

    noises = process.variances[own].numpy()
    solve = np.linalg.inv(kernel(places[own], places[own]) + np.diag(noises))
    towards = kernel(asked, places[own])
    np.testing.assert_allclose(
        process(asked, query.receivers), towards @ solve @ values[own].numpy(), atol=1e-8
    )
    # Student's t of four degrees of freedom has twice its squared scale as variance.
    expected = np.sqrt(9 - np.einsum("ij,jk,ik->i", towards, solve, towards) + 2 * 4)
    np.testing.assert_allclose(process.deviations(asked, query.receivers), expected, rtol=1e-6)
    process.options = ScalarOptions(neighbours=16, many=0)  # of 42 readings 16
    np.testing.assert_allclose(process.deviations(asked, query.receivers), expected, rtol=0.03)
    process.options = ScalarProcess.options
    fresh = ScalarProcess(links.scene)
    fresh.load_state_dict(process.state_dict())
    assert torch.equal(fresh(asked, query.receivers), process(asked, query.receivers))
    assert torch.equal(
        fresh.deviations(asked, query.receivers), process.deviations(asked, query.receivers)
    )


@pytest.mark.parametrize("smoothness", [0.5, 1.5])
@pytest.mark.parametrize("degrees", [math.inf, 4.0])
@pytest.mark.parametrize("carriers", [(), (1e9, 2e9)])
def test_gradients_are_those_of_finite_differences(smoothness, degrees, carriers):
    links = drawn(count=40, carriers=carriers)
    links.query.transmitters[1::2] = links.query.transmitters[::2]  # places coincide
    places, receivers, values = known(links)
    readings = Readings(links.scene, places, receivers, 16)
    held = readings.held_out(torch.arange(len(places)), folds_of(links, links.split.train), 20)
    choice = Choice(smoothness, degrees, 1.0 if carriers else math.nan)
    prior = torch.zeros(3, dtype=torch.float64)
    cost = HeldOutCost(links.scene, values, held, choice, True, prior, ScalarOptions())
    point = cost.start(torch.zeros(2, 3, dtype=torch.float64))
    point = point + 0.2 * np.random.default_rng(0).standard_normal(len(point))
    _, gradient = cost(point)
    assert np.isfinite(gradient).all()
    found = approx_fprime(point, lambda one: cost(one)[0], 1e-6)
    np.testing.assert_allclose(gradient, found, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("smoothness", [0.5, 1.5])
def test_tiles_are_nearly_the_dense_solve(smoothness, monkeypatch):
    links = drawn((1.5, 0.8), smoothness, noise=2.0, count=900)
    model = fitted(links)
    process = model.scalar
    places, receivers, values = process.places, process.receivers, process.values
    asked = coordinates(links.scene, links.query[links.split.test], 1.0)
    of = links.query.receivers[links.split.test]
    dense = process(asked, of)
    assert not len(process.tiles)
    process.options = replace(process.options, together=100)
    process.solve(places, receivers, values)
    assert len(process.tiles) > 8
    tiled = process(asked, of)
    assert (tiled - dense).square().mean().sqrt() < 0.02 * dense.std()
    # A place's mean does not depend on those that are asked with it, nor on a checkpoint.
    fresh = ScalarProcess(links.scene)
    fresh.load_state_dict(process.state_dict())
    assert torch.equal(fresh(asked[:5], of[:5]), process(asked[:5], of[:5]))
    # A checkpoint of before has no tiles.
    process.options = replace(process.options, together=10**6)
    process.solve(places, receivers, values)
    state = process.state_dict()
    old = {name: value for name, value in state.items() if not name.startswith("tiles")}
    fresh = ScalarProcess(links.scene)
    fresh.load_state_dict(old)
    assert torch.equal(fresh(asked, of), dense)


def test_models_with_tiles_are_saved_and_loaded(tmp_path, monkeypatch):
    monkeypatch.setattr(Tiles, "core", 16)
    monkeypatch.setattr(Tiles, "size", 64)
    monkeypatch.setattr(ScalarProcess, "options", ScalarOptions(neighbours=16, together=100))
    links = drawn(count=150)
    model = gaigs.train("gaussian_process", links)
    places = links.query.transmitters[:40].numpy()
    model.save(tmp_path / "fresh.ckpt")
    before = model.predict(places)  # solves some of the tiles
    assert len(model.scalar.tiles) > 4
    model.save(tmp_path / "used.ckpt")
    for name in ("fresh", "used"):
        assert torch.equal(gaigs.load(tmp_path / f"{name}.ckpt").predict(places), before)


def test_a_lazy_solve_of_fewer_readings_is_saved_whole(monkeypatch):
    """Tiles and weights of the readings before are not stored beside the new ones."""
    options = replace(ScalarOptions(), together=60, iterations=4)
    monkeypatch.setattr(ScalarProcess, "options", options)
    monkeypatch.setattr(Tiles, "core", 16)
    monkeypatch.setattr(Tiles, "size", 32)
    links = drawn((1.5, 0.8), noise=1.0, count=400)
    process = fitted(links).scalar
    few = slice(0, 2 * len(process.places) // 3)
    known = process.places[few], process.receivers[few], process.values[few]
    loaded = ScalarProcess(links.scene)
    process.solve(*known, is_lazy=True)
    loaded.load_state_dict(process.state_dict())
    process.solve(*known)
    assert len(process.tiles)
    asked = known[0][:9], known[1][:9]
    torch.testing.assert_close(loaded(*asked), process(*asked))


@pytest.mark.parametrize("degrees", [math.inf, 4.0])
def test_few_places_of_a_lazy_solve_have_the_readings_around_them(degrees):
    links = drawn((1.5, 0.8), noise=2.0, degrees=degrees, count=500)
    process = fitted(links).scalar
    asked = coordinates(links.scene, links.query[links.split.test], 1.0)
    of = links.query.receivers[links.split.test]
    solved = process(asked, of), process.deviations(asked, of)
    process.solve(process.places, process.receivers, process.values, is_lazy=True)
    few = len(asked) // 20
    near = process(asked[:few], of[:few]), process.deviations(asked[:few], of[:few])
    assert not process.is_solved
    for one, other in zip(near, solved, strict=True):
        assert (one - other[:few]).square().mean().sqrt() < 0.05 * solved[0].std()
    # Many are worth the whole solution, which is then that of all.
    assert torch.equal(process(asked, of), solved[0])
    assert process.is_solved
    assert torch.equal(process.deviations(asked, of), solved[1])


def test_folds_of_many_readings_are_predicted_as_well(monkeypatch):
    """Errors at held-out places, with and without a fit and a solution of each fold."""
    links = drawn((1.5, 0.8), noise=2.0, degrees=4.0, count=600)
    model = fitted(links)
    errors = []
    for large in (10**6, 100):
        options = ScalarOptions(neighbours=16, few=4, large=large)
        monkeypatch.setattr(ScalarProcess, "options", options)
        for one in model.unseen(links):
            asked = one.asked[::2]
            values = one.model(Batch(links.query[asked])).value
            errors.append((values - links.labels[asked]).abs().mean())
            assert one.model.scalar.is_solved == (large > 100)
    whole, quick = torch.stack(errors).reshape(2, -1).mean(1)
    assert abs(quick / whole - 1) < 0.02


def test_many_links_keep_the_choices_of_the_fit_for_the_validation(monkeypatch):
    """The validation's fit has chosen kernel, noise and trend: a second choice takes time alone."""
    monkeypatch.setattr(ScalarProcess, "options", ScalarOptions(neighbours=16, large=100))
    links = drawn((1.5, 0.8), noise=2.0)
    train = links.split.train
    some = replace(links, split=replace(links.split, train=train[torch.arange(len(train)) % 7 > 0]))
    model, errors = None, []
    for part in (some, links):
        look_up = GaussianProcess(links.scene)
        model = evaluation.fitted(look_up, part, model, many=100)
        values = model(Batch(links.query[links.split.test])).value
        errors.append((values - links.labels[links.split.test]).abs().mean())
        assert look_up.links is None
        monkeypatch.setattr(ScalarProcess, "fit", None)
    assert len(model.scalar.places) == len(train)
    assert errors[1] < errors[0]


@pytest.mark.parametrize("together", [150, 60])
def test_readings_of_one_place_are_merged(together, monkeypatch):
    monkeypatch.setattr(Tiles, "core", 16)
    monkeypatch.setattr(Tiles, "size", 60)
    rng = np.random.default_rng(0)
    places = torch.from_numpy(rng.uniform(size=(100, 3)) * 20).repeat(5, 1)
    asked = torch.from_numpy(rng.uniform(size=(50, 3)) * 20)
    values = torch.from_numpy(rng.standard_normal(500)) + 4 * places[:, 0].sin()
    process = ScalarProcess(example_links("rssi").scene)
    process.logarithms[:] = torch.tensor([6.0, 5.0, 3.0]).log()
    process.choice[1] = 4.0  # variances differ
    means = []
    for most in (10**6, together):
        process.options = replace(process.options, together=most)
        process.solve(places, torch.ones(500, dtype=torch.long), values)
        means.append(process(asked, torch.ones(50, dtype=torch.long)))
    dense, found = means
    assert len(process.tiles) == (0 if together == 150 else 8)
    if together == 150:
        torch.testing.assert_close(found, dense)
    else:  # 60 of 100 places
        assert (found - dense).square().mean().sqrt() < 0.05 * dense.std()


def test_sparse_readings_beside_many_are_in_tiles(monkeypatch):
    """A road out of a town, and one place far off: nearest to the centre of no tile."""
    monkeypatch.setattr(Tiles, "core", 32)
    monkeypatch.setattr(Tiles, "size", 128)
    rng = np.random.default_rng(0)
    town = np.c_[rng.uniform(size=(1000, 2)) * 20, np.ones(1000)]
    road = np.c_[np.linspace(25, 300, 50), np.full(50, 10.0), np.ones(50)]
    outlier = np.array([[1e4, 0, 1]])
    places = torch.from_numpy(np.r_[town, road, outlier])
    asked = torch.from_numpy(np.r_[road, outlier, outlier + 1])
    process = ScalarProcess(example_links("rssi").scene)
    process.logarithms[:] = torch.tensor([20.0, 6.0, 2.0]).log()
    apart = torch.cdist(places, places)
    factor = torch.linalg.cholesky((-apart / 20).exp() + 1e-8 * torch.eye(len(places)))
    values = 6 * factor @ torch.from_numpy(rng.standard_normal(len(places)))
    values += 2 * torch.from_numpy(rng.standard_normal(len(places)))
    means = []
    for together in (10**6, 500):
        process.options = replace(process.options, together=together)
        process.solve(places, torch.zeros(len(places), dtype=torch.long), values)
        means.append(process(asked, torch.zeros(len(asked), dtype=torch.long)))
    dense, tiled = means
    assert len(process.tiles) > 8
    assert dense.std() > 3
    assert (tiled - dense).square().mean().sqrt() < 0.1


def test_readings_of_the_own_fold_do_not_predict():
    links = drawn(count=60)
    links.query.transmitters[20:40] = links.query.transmitters[:20]
    places, receivers, _ = known(links)
    folds = folds_of(links, links.split.train)
    readings = Readings(links.scene, places, receivers, 16)
    rows, exists = readings.nearest(places, receivers, folds, folds)
    assert exists.any(1).all()
    assert (folds[rows] != folds[:, None])[exists].all()
    same = (places[rows] == places[:, None]).all(-1)
    assert not (same & exists).any(), "readings at one place are one fold"


# --- choices ---


@pytest.mark.parametrize(("smoothness", "degrees"), [(0.5, 3.0), (1.5, math.inf)])
def test_kernel_tails_and_hyperparameters_are_those_of_the_draw(smoothness, degrees):
    length = 2.0 if smoothness == 0.5 else 0.7
    links = drawn((length, length), smoothness, 5.0, 0.7, degrees, 600, 0.0)
    model = fitted(links, trend={"name": "mean"})
    facts = model.facts()
    assert facts["smoothness"] == smoothness
    assert facts["degrees_of_freedom"] == (0 if math.isinf(degrees) else 4)
    length, signal, noise = model.scalar.logarithms.exp().unbind(1)

    # Within a box of few lengths, length and variance are hardly known apart, but well as this
    # power of both.
    def slope(length, signal):
        return signal**2 / length ** (2 * smoothness)

    np.testing.assert_allclose(
        slope(length, signal), slope(2.0 if smoothness == 0.5 else 0.7, 5.0), rtol=0.6
    )
    np.testing.assert_allclose(noise, 0.7, rtol=0.6)


def test_each_receiver_has_a_length_of_its_own():
    process = fitted(drawn((0.7, 4.0), noise=0.3, count=500), trend={"name": "mean"}).scalar
    short, long = process.logarithms[:, 0].exp()
    assert long > 1.5 * short


def test_each_receiver_has_a_noise_of_its_own():
    links = drawn(signal=1.0, noise=0.5, count=60)
    links.labels[60:] += 8 * torch.randn(60, generator=torch.Generator().manual_seed(0))
    process = fitted(links).scalar
    quiet, noisy = process.deviations(process.places[:1].expand(2, -1), torch.arange(2))
    assert quiet < 2
    assert noisy > 5


@pytest.mark.parametrize("law", [False, True])
def test_the_trend_is_that_of_the_labels(law):
    links = drawn(signal=2.0)
    if law:
        apart = (
            links.query.transmitters - links.scene.positions(links.labels)[links.query.receivers]
        ).norm(dim=1)
        links.labels.add_(-40 * apart.clamp_min(0.1).log10())
    assert fitted(links).facts()["trend"] == ("shaped_path_loss" if law else "mean")


def test_a_few_readings_that_are_far_out_hardly_count():
    links = drawn((2.0, 2.0), 1.5, 4.0, 0.5)
    spoilt = replace(links, labels=links.labels.clone())
    rows = links.split.train[::15]
    spoilt.labels[rows] += 40.0
    query, labels = links.query[links.split.test], links.labels[links.split.test]
    plain, robust = fitted(links), fitted(spoilt)
    assert robust.facts()["degrees_of_freedom"] == 4
    errors = [(model.predict(query) - labels).abs().mean() for model in (plain, robust)]
    assert errors[1] < 1.3 * errors[0]
    factors = (
        robust.scalar.variances / (2 * robust.scalar.logarithms[robust.scalar.receivers, 2]).exp()
    )
    is_spoilt = torch.isin(torch.cat(robust.known), rows)
    assert factors[is_spoilt].min() > 10 * factors[~is_spoilt].median()


def test_intervals_of_the_process_hold_their_share():
    links = drawn((1.0, 2.0), 0.5, 5.0, 1.0, 4.0, 800)
    model, test = fitted(links), links.split.test
    query = links.query[test]
    deviations = model.scalar.deviations(coordinates(links.scene, query, 1.0), query.receivers)
    within = (
        ((model.predict(query) - links.labels[test]).abs() <= 1.645 * deviations).double().mean()
    )
    assert within == pytest.approx(0.9, abs=0.04)


# --- hard cases ---


@pytest.mark.parametrize("level", [0.0, -60.0])
def test_labels_that_the_trend_explains_are_predicted_by_it(level):
    links = drawn()
    links.labels.fill_(level)
    torch.testing.assert_close(
        fitted(links).predict(BOX * torch.rand(4, 3), 0), torch.full((4,), level)
    )


def test_places_measured_often_are_predicted_by_the_mean_of_their_readings():
    links = drawn(noise=0.01)
    links.query.transmitters[:200] = links.query.transmitters[:4].repeat(50, 1)
    links.labels[:200] = links.labels[:4].repeat(50) + 0.5 * torch.randn(
        200, generator=torch.Generator().manual_seed(0)
    )
    found = fitted(links).predict(links.query.transmitters[:4], 0)
    torch.testing.assert_close(found, links.labels[:200].reshape(50, 4).mean(0), rtol=0, atol=0.3)


def test_a_receiver_with_hardly_a_reading_is_predicted():
    links = drawn(count=40)
    few = torch.cat((torch.arange(28), torch.tensor([40])))
    links = replace(links, split=replace(links.split, train=few))
    found = fitted(links).predict(links.query.transmitters[:3], 1)
    torch.testing.assert_close(found, links.labels[40].expand(3), rtol=0, atol=1e-3)


def test_levels_beside_a_dense_track_stay_those_of_a_receiver():
    """A robot's two lanes, rows a centimetre apart: a smooth pattern along them shows no deviation
    of the field.
    """
    along = torch.linspace(0, 4, 200).double()
    places = torch.stack(
        (along.repeat(2), torch.tensor([0.0, 2.0]).repeat_interleave(200), 0 * along.repeat(2)), 1
    )
    waves = (10 * places[:, :1] + places[:, 1:2]).sin() - (7 * places[:, :1]).cos()
    levels = -60 + 6 * waves + torch.randn(400, 1, generator=torch.Generator().manual_seed(0))
    links = gaigs.links(
        task="rssi", transmitters=places, receivers=[[9.0, 5.0, 2.0]], labels=levels, test=0.0
    )
    process = fitted(links).scalar
    size = process.values.square().mean().sqrt()
    assert process.logarithms[0, 1].exp() < 2.5 * size
    away = torch.tensor([[2.0, 9.0, 0.0]]).double()
    assert process.deviations(away, torch.zeros(1, dtype=torch.long)) < 3 * size
