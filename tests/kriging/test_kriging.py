"""Kriging of trained models against its formulas in numpy, and against labels whose makings are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist
from torch import nn

from gaigs.data import Split
from gaigs.kriging import fit
from gaigs.kriging.links import at_directions
from gaigs.model import Model, Prediction, kriging
from gaigs.model.gaussian_process import GaussianProcess
from gaigs.model.kriging import Kriging, known, predicted, principal, thinned
from gaigs.query import Batch, Query
from gaigs.registry import registry
from gaigs.testing import check_model, example_links

TASKS = pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
BOX = torch.tensor([6.0, 4.0, 2.0])


class Trained(Model):
    """A pattern times a wave over the x coordinate; ``weights`` stand for what was learnt."""

    def __init__(self, scene):
        super().__init__(scene)
        generator = torch.Generator().manual_seed(5)
        task = scene.task
        self.weights = nn.Parameter(torch.randn(1, *task.shape, dtype=task.dtype, generator=generator))

    def forward(self, batch):
        waves = (3 * batch.query.transmitters[:, 0]).sin().reshape(-1, *[1] * self.weights[0].ndim)
        return Prediction(at_directions(self.weights * waves, batch, self.scene), {})


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setitem(registry("model")._registered, "trained", Trained)
    monkeypatch.setattr(fit, "AROUND", 16)


def make(task="rssi", count=None, carriers=(), smooth=0.0, trained=0.0, noise=0.0):
    """Labels are a draw of a smooth process over places, what the trained model says, and noise, times so much each.

    Both receivers hear in turn; a fifth tests, a fifth validates.
    """
    links = example_links(task)
    count = count or (400 if task == "rssi" else 100)  # one number a link tells little
    generator = torch.Generator().manual_seed(0)
    places = BOX * torch.rand(count, 3, generator=generator)
    frequencies = torch.tensor(carriers)[torch.arange(count) % len(carriers)] if carriers else None
    shape, dtype = links.task.shape, links.task.dtype
    draw = lambda: torch.randn(count, *shape, dtype=dtype, generator=generator)
    covariances = torch.from_numpy(np.exp(-cdist(places.double(), places.double()) / 4))
    factor = torch.linalg.cholesky(covariances + 1e-9 * torch.eye(count)).to(dtype)
    order = torch.randperm(count, generator=generator)
    parts = (part.sort().values for part in order.split([3 * count // 5, count // 5, count - 4 * (count // 5)]))
    links = replace(
        links,
        query=Query(places, torch.arange(count) % 2, frequencies),
        labels=smooth * torch.tensordot(factor, draw(), 1) + noise * draw(),
        rows=None,
        split=Split("made up", *parts),
    )
    links.labels.add_(trained * Trained(links.scene).predict(links.query))
    return links


def kriged(links, **options):
    model = Kriging(links.scene, Trained(links.scene), **options)
    model.fit(links)
    return model


def mixed(model, query):
    """What is left far from all known links."""
    share = model.share.item()
    return share * model.trend.predict(query) + (1 - share) * model.fallback.predict(query)


def formula(model, links, query, index):
    """share * trend + (1 - share) * fallback + k' (K + noise)^-1 residuals in numpy, for one receiver."""
    residuals = (links.labels[index] - mixed(model, links.query[index])).numpy()

    def stretched(of):
        columns = [of.transmitters.double().numpy()]
        if of.frequencies is not None:
            columns.append(model.process.scale * of.frequencies.double().log().numpy()[:, None])
        return np.hstack(columns)

    places, asked = stretched(links.query[index]), stretched(query)
    covariances = np.exp(-cdist(places, places) / model.process.length) + model.process.noise * np.eye(len(index))
    weights = np.exp(-cdist(asked, places) / model.process.length) @ np.linalg.inv(covariances)
    return mixed(model, query).numpy() + np.tensordot(weights, residuals, 1)


def own(links, index, receiver):
    return index[links.query.receivers[index] == receiver]


# --- predictions ---


@TASKS
def test_it_keeps_the_contract_of_models(task):
    check_model(lambda scene: Kriging(scene, Trained(scene)), make(task, trained=1.0, noise=0.3))


@TASKS
@pytest.mark.parametrize("carriers", [(), (1e9, 1.7e9, 2.9e9)])
def test_predictions_are_the_formula(task, carriers, monkeypatch):
    monkeypatch.setattr(kriging, "LEFT", 0.0)
    links = make(task, carriers=carriers, smooth=1.0, trained=0.5, noise=0.1)
    model = kriged(links)
    assert 0 < model.share < 1
    frequencies = torch.tensor([1e9, 1.3e9, 2e9, 4e9]) if carriers else None
    query = Query(BOX * torch.rand(4, 3), torch.ones(4, dtype=torch.long), frequencies)
    expected = formula(model, links, query, own(links, known(links), 1))
    np.testing.assert_allclose(model.predict(query), expected, rtol=0, atol=1e-4 if task == "rssi" else 5e-3)


@TASKS
def test_components_keep_what_matters(task):
    links = make(task, smooth=1.0, trained=0.5, noise=0.01)
    model, query = kriged(links), Query(BOX * torch.rand(20, 3), torch.zeros(20, dtype=torch.long))
    expected = formula(model, links, query, own(links, known(links), 0))
    added = expected - mixed(model, query).numpy()
    errors = model.predict(query).numpy() - expected
    assert (np.abs(errors) ** 2).sum() <= 2 * kriging.LEFT * (np.abs(added) ** 2).sum()


@TASKS
def test_far_away_trend_and_fallback_are_left(task):
    model = kriged(make(task, smooth=1.0, trained=0.5))
    assert 0 < model.share < 1
    far = Query(torch.full((2, 3), 9e4), torch.tensor([0, 1]))
    torch.testing.assert_close(model.predict(far), mixed(model, far), rtol=0, atol=1e-6)


@TASKS
def test_at_a_known_link_it_is_nearly_the_label(task, monkeypatch):
    monkeypatch.setattr(kriging, "LEFT", 1e-6)
    links = make(task, smooth=1.0, trained=1.0)
    model = kriged(links)
    model.noise.fill_(1e-4)
    index = known(links)
    model.solve(links, predicted(model.trend, links, index))
    left = lambda values: (values - links.labels[index]).abs().square().mean().sqrt()
    assert left(model.predict(links.query[index])) < 0.03 * left(model.trend.predict(links.query[index]))


def test_directions_are_those_asked_for():
    links = make("spectrum", smooth=1.0, trained=1.0)
    model, query = kriged(links), links.query[links.split.test[:4]]
    whole, rays = model.predict(query), links.task.directions.flatten()[5::13]
    torch.testing.assert_close(model.predict(query, directions=rays), whole.flatten(1)[:, 5::13], rtol=0, atol=1e-5)
    thin = links.task.directions.thin(slice(1, None, 3), slice(0, None, 4))
    found = model.evaluate(Batch(query, thin))
    torch.testing.assert_close(found, whole[:, 1::3, ::4], rtol=0, atol=1e-5)


# --- shares and hyperparameters ---


@TASKS
def test_a_trend_that_tells_nothing_leaves_the_plain_process(task):
    links = make(task, smooth=1.0, noise=0.1)
    fallback = {"spectrum": None, "rssi": {"name": "path_loss"}, "csi": {"name": "friis"}}[task]
    model, plain = kriged(links, fallback=fallback), GaussianProcess(links.scene, trend=fallback)
    plain.fit(links)
    assert model.share == 0
    assert model.process == plain.process
    query = links.query[links.split.test]
    torch.testing.assert_close(model.predict(query), plain.predict(query), rtol=0, atol=0.05)
    # Components leave out some of what spectra are, and nothing of what is one number.
    if task == "rssi":
        torch.testing.assert_close(model.predict(query), plain.predict(query), rtol=0, atol=1e-4)


@TASKS
@pytest.mark.parametrize("share", [0.25, 0.75])
def test_the_share_is_what_the_labels_hold_of_the_trend(task, share):
    assert kriged(make(task, smooth=0.3, trained=share, noise=0.05)).share == share


def test_far_fewer_validation_links_than_training_links_choose():
    """Training links that were learnt by heart leave nothing over, and do not say how good the trend is."""
    links = make("spectrum", smooth=1.0, noise=0.1)

    class ByHeart(Model):
        def __init__(self, scene):
            super().__init__(scene)
            self.weights = nn.Parameter(torch.zeros(1))

        def forward(self, batch):
            values = torch.zeros(len(batch), *self.scene.task.shape)
            same = (batch.query.transmitters[:, None] == links.query.transmitters[links.split.train]).all(-1)
            link, which = same.nonzero().T
            values[link] = links.labels[links.split.train[which]]
            return Prediction(at_directions(values, batch, self.scene), {})

    model = Kriging(links.scene, ByHeart(links.scene))
    values = predicted(model.trend, links, known(links))
    assert model.choose(links, values) == 0
    honest = torch.zeros_like(values)  # what it says where it has not been trained
    assert model.choose(links, honest) == pytest.approx(1, abs=0.2)
    plain = GaussianProcess(links.scene)
    plain.fit(links)
    model.solve(links, honest)
    query = links.query[links.split.test]
    left = lambda found: (found.predict(query) - links.labels[links.split.test]).square().mean().sqrt()
    assert left(model) == pytest.approx(left(plain).item(), rel=0.02)


def test_without_validation_their_labels_are_not_looked_at():
    links = make("rssi", smooth=1.0, trained=0.5, noise=0.1)
    model, values = kriged(links), predicted(Trained(links.scene), links, known(links))
    labels = links.labels.index_fill(0, links.split.validation, torch.nan)
    blind = model.without_validation(replace(links, labels=labels), values)
    assert (blind.share, blind.process) == (model.share, model.process)
    query = links.query[own(links, links.split.validation, 0)]
    expected = formula(blind, links, query, own(links, links.split.train, 0))
    np.testing.assert_allclose(blind.predict(query), expected, rtol=0, atol=1e-4)


def test_no_test_label_is_looked_at():
    links = make("spectrum", smooth=1.0, trained=0.5)
    without = replace(links, labels=links.labels.index_fill(0, links.split.test, torch.nan))
    query = links.query[links.split.test]
    assert torch.equal(kriged(links).predict(query), kriged(without).predict(query))


def test_of_many_links_an_even_part_is_looked_at(monkeypatch):
    monkeypatch.setattr(kriging, "LIMIT", 20)
    links = make("rssi", smooth=1.0)
    few = thinned(links)
    assert [len(few.known(receiver)) for receiver in (0, 1)] == [20, 20]
    for part, whole in zip(few.split.parts().values(), links.split.parts().values(), strict=True):
        assert {*part.tolist()} <= {*whole.tolist()}
    assert torch.equal(few.split.test, links.split.test)
    model = kriged(links)
    assert model.facts()["kriging"]["links"] == 40
    query = links.query[own(links, links.split.test, 0)]
    expected = formula(model, links, query, few.known(0))
    np.testing.assert_allclose(model.predict(query), expected, rtol=0, atol=1e-4)


# --- components, and what is stored ---


@pytest.mark.parametrize("dtype", [torch.float32, torch.complex64])
@pytest.mark.parametrize("exact", [True, False])
def test_components_are_as_few_as_leave_little_out(dtype, exact, monkeypatch):
    monkeypatch.setattr(kriging, "LEFT", 0.02)
    monkeypatch.setattr(kriging, "EXACT", 512 if exact else 10)
    generator = torch.Generator().manual_seed(0)
    draw = lambda *shape: torch.randn(*shape, dtype=dtype, generator=generator)
    residuals = draw(300, 60) @ (2.0 ** -torch.arange(60))[:, None].to(dtype).mul(draw(60, 400))
    state = torch.random.get_rng_state()
    components = principal(residuals)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert components.abs().amax(1) == pytest.approx(1)
    values = np.linalg.svd(residuals.numpy(), compute_uv=False).astype(float)
    left = lambda count: (values[count:] ** 2).sum() / (values**2).sum()
    assert left(len(components)) <= 0.02 < left(len(components) - 1)
    basis, _ = np.linalg.qr(components.numpy().T.astype(complex).conj())
    over = residuals.numpy() - residuals.numpy() @ basis @ basis.conj().T
    assert np.linalg.norm(over) ** 2 / np.linalg.norm(residuals) ** 2 == pytest.approx(left(len(components)), rel=0.02)


def test_components_are_no_more_than_the_most(monkeypatch):
    monkeypatch.setattr(kriging, "MOST", 7)
    assert len(principal(torch.randn(60, 90))) == 7


@TASKS
def test_a_state_is_taken_over_with_its_sizes(task):
    links = make(task, smooth=1.0, trained=0.5)
    model = kriged(links)
    fresh = registry("model").build({"name": "kriging", "trend": {"name": "trained"}}, scene=links.scene)
    fresh.load_state_dict(model.state_dict())
    query = links.query[links.split.test]
    assert torch.equal(fresh.predict(query), model.predict(query))
    assert fresh.facts() == model.facts()
    stored = {name: tensor.dtype for name, tensor in model.state_dict().items() if name.startswith("fields.0.")}
    kept = {"places": torch.float64, "weights": links.task.dtype, "components": torch.float16}
    assert stored == {f"fields.0.{name}": dtype for name, dtype in kept.items()}


def test_what_is_reported_is_the_trends_and_the_krigings():
    links = make("spectrum", smooth=1.0, trained=0.5)
    model = kriged(links)
    facts = model.facts()["kriging"]
    assert facts == {
        "weight": 1.0,
        "share": model.share.item(),
        "length_m": model.process.length,
        "noise_to_signal": model.process.noise,
        "links": 80,
        "components": max(len(field.components) for field in model.fields),
    }
    assert model.primitives is None
    assert model.rendering(links.batch(links.split.test)) is None


# --- the weight ---


@pytest.mark.parametrize(("known_noise", "weight"), [(0.0, 1.0), (30.0, 0.0)])
def test_the_weight_is_that_with_which_validation_links_score_best(known_noise, weight):
    # Where the training labels are broken, what is kriged from them does harm.
    links = make("rssi", smooth=3.0, trained=1.0)
    values = predicted(Trained(links.scene), links, known(links))
    model = Kriging(links.scene, Trained(links.scene))
    model.choose(links, values)
    generator = torch.Generator().manual_seed(3)
    train = links.split.train
    links.labels[train] += known_noise * torch.randn(len(train), generator=generator)
    model.solve(links, values)
    blind = model.without_validation(links, values)
    model.weigh(links, values, blind)
    assert model.weight == blind.weight == weight
    if weight == 0:
        assert torch.equal(model.predict(links.query), model.trend.predict(links.query))


def test_the_weight_mixes_the_kriged_value_with_the_trends():
    links = make("rssi", smooth=1.0, trained=1.0)
    model = kriged(links)
    whole, trend = (part.predict(links.query) for part in (model, model.trend))
    model.weight.fill_(0.25)
    torch.testing.assert_close(model.predict(links.query), 0.25 * whole + 0.75 * trend)


# --- what is refused ---


def test_it_does_not_stand_alone():
    with pytest.raises(ValueError, match="choose that model, and set kriging=true"):
        registry("model").build({"name": "kriging", "trend": None}, scene=example_links().scene)


@pytest.mark.parametrize("fallback", [{"name": "knn", "k": 3, "power": 2.0}, {"name": "trained"}])
def test_a_fallback_that_is_no_trend_is_refused(fallback):
    links = example_links("rssi")
    message = f"must be fitted at once and stored in a checkpoint, and {fallback['name']} is not"
    with pytest.raises(ValueError, match=message):
        Kriging(links.scene, Trained(links.scene), fallback)
