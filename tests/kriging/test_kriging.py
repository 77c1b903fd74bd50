"""Kriging of trained models against its formulas in numpy, and against labels of known composition."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist
from torch import nn

from gaigs.commands.survey.processes import posterior
from gaigs.core.query import Batch, Query
from gaigs.data import Split
from gaigs.kriging import field, fit
from gaigs.kriging.field import FieldPosterior, principal_components
from gaigs.kriging.fit import Hyperparameters
from gaigs.kriging.likelihood import Choice
from gaigs.kriging.links import at_directions, coordinates, limit_known
from gaigs.kriging.scalar import ScalarProcess
from gaigs.kriging.scalar_fit import ScalarOptions
from gaigs.model import Model, Prediction, answers, kriging
from gaigs.model.gaussian_process import GaussianProcess
from gaigs.model.kriging import Kriging
from gaigs.registry import registry
from gaigs.testing import check_model, example_links

TASKS = pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
BOX = torch.tensor([6.0, 4.0, 2.0])
PROCESS = Hyperparameters(2.0, 0.1, 3.0)


class Trained(Model):
    """A pattern times a wave over the x coordinate; ``weights`` are the trained parameters."""

    def __init__(self, scene):
        super().__init__(scene)
        task = scene.task
        weights = torch.randn(
            1, *task.shape, dtype=task.dtype, generator=torch.Generator().manual_seed(5)
        )
        self.weights = nn.Parameter(weights)

    def forward(self, batch):
        waves = (3 * batch.query.transmitters[:, 0]).sin().reshape(-1, *[1] * self.weights[0].ndim)
        return Prediction(at_directions(self.weights * waves, batch, self.scene), {})


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setitem(registry("model")._registered, "trained", Trained)
    monkeypatch.setattr(ScalarProcess, "options", ScalarOptions(neighbours=8))


def make(task="rssi", count=100, carriers=(), smooth=0.0, trained=0.0, noise=0.0):
    """Labels are a weighted sum of a smooth process over places, the trained model's values, and
    noise.

    Both receivers hear in turn; a fifth tests, a fifth validates.
    """
    links = example_links(task)
    generator = torch.Generator().manual_seed(0)
    places = BOX * torch.rand(count, 3, generator=generator)
    frequencies = torch.tensor(carriers)[torch.arange(count) % len(carriers)] if carriers else None
    shape, dtype = links.task.shape, links.task.dtype

    def draw():
        return torch.randn(count, *shape, dtype=dtype, generator=generator)

    covariances = torch.from_numpy(np.exp(-cdist(places.double(), places.double()) / 4))
    factor = torch.linalg.cholesky(covariances + 1e-9 * torch.eye(count)).to(dtype)
    order = torch.randperm(count, generator=generator)
    parts = (
        part.sort().values
        for part in order.split([3 * count // 5, count // 5, count - 4 * (count // 5)])
    )
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
    """A model with kriging, whatever weight scored best."""
    model = Kriging(links.scene, Trained(links.scene), **options)
    validation_model = model.krige(links)
    model.weight.fill_(1)
    validation_model.weight.fill_(1)
    return model, validation_model


@pytest.fixture
def half(monkeypatch):
    """Fixes the hyperparameters, and the trend weight to 0.5, for tests of what follows from them."""

    def fixed(scene, links, residuals, most=300, features=None, length=None):
        residuals(links.split.known)
        if length is not None:  # features do not help
            return PROCESS, 0.0
        assert (most == 1000) == (len(costs) % 6 == 5), "the last fit looks at more links"
        costs.append(
            float(abs(len(costs) % 6 - 2))
        )  # of five candidates the third is best, and is fitted again
        return PROCESS if scene.has_band else PROCESS._replace(scale=np.nan), costs[-1]

    def fixed_scalar(self, *readings):
        self.logarithms.copy_(torch.tensor([PROCESS.length, 0.7, 0.7 * PROCESS.nugget**0.5]).log())
        self.choice.copy_(
            torch.tensor(Choice(0.5, np.inf, PROCESS.scale if self.scene.has_band else np.nan))
        )
        return 0.0  # as likely as any other

    costs = []
    monkeypatch.setattr(field, "fit_hyperparameters", fixed)
    monkeypatch.setattr(kriging, "is_surely_better", lambda *_, **__: False)
    monkeypatch.setattr(ScalarProcess, "fit", fixed_scalar)
    monkeypatch.setattr(ScalarProcess, "refit", fixed_scalar)


def mixed(model, query):
    """Values far from all known links, where the trend weight is 0.5."""
    return (model.trend.predict(query) + model.fallback.predict(query)) / 2


def formula(model, links, query, index):
    """(trend + fallback) / 2 + k' (K + nugget)^-1 residuals in numpy, for one receiver."""
    residuals = (links.labels[index] - mixed(model, links.query[index])).numpy()

    def stretched(of):
        columns = [of.transmitters.double().numpy()]
        if of.frequencies is not None:
            columns.append(PROCESS.scale * of.frequencies.double().log().numpy()[:, None])
        return np.hstack(columns)

    places, asked = stretched(links.query[index]), stretched(query)
    covariances = np.exp(-cdist(places, places) / PROCESS.length) + PROCESS.nugget * np.eye(
        len(index)
    )
    weights = np.exp(-cdist(asked, places) / PROCESS.length) @ np.linalg.inv(covariances)
    return mixed(model, query).numpy() + np.tensordot(weights, residuals, 1)


def own(links, index, receiver):
    return index[links.query.receivers[index] == receiver]


# --- predictions ---


@TASKS
def test_the_model_contract_holds(task, half):
    check_model(lambda scene: Kriging(scene, Trained(scene)), make(task, trained=1.0, noise=0.3))


@pytest.mark.parametrize("task", ["spectrum", "rssi"])
def test_a_trend_in_double_precision_is_kriged_too(task):
    links = make(task, smooth=1.0, trained=1.0)
    models = [
        Kriging(links.scene, trend)
        for trend in (Trained(links.scene), Trained(links.scene).double())
    ]
    for model in models:
        model.fit(links)
    single, double = (model.predict(links.query[links.split.test]) for model in models)
    torch.testing.assert_close(double.float(), single, rtol=1e-3, atol=1e-3)


@TASKS
@pytest.mark.parametrize("carriers", [(), (1e9, 1.7e9, 2.9e9)])
def test_predictions_are_the_formula(task, carriers, half, monkeypatch):
    links = make(task, carriers=carriers, smooth=1.0, trained=0.5, noise=0.1)
    frequencies = torch.tensor([1e9, 1.3e9, 2e9, 4e9]) if carriers else None
    query = Query(BOX * torch.rand(4, 3), torch.ones(4, dtype=torch.long), frequencies)
    coarse, _ = kriged(links)
    monkeypatch.setattr(FieldPosterior, "share", 0.0)
    model, validation_model = kriged(links)
    expected = formula(model, links, query, own(links, links.split.known, 1))
    np.testing.assert_allclose(
        model.predict(query), expected, rtol=0, atol=1e-4 if task == "rssi" else 5e-3
    )
    added = expected - mixed(model, query).numpy()
    errors = coarse.predict(query).numpy() - expected
    assert (np.abs(errors) ** 2).sum() <= 3 * 5e-4 * (np.abs(added) ** 2).sum(), (
        "few components keep nearly all"
    )
    expected = formula(validation_model, links, query, own(links, links.split.train, 1))
    np.testing.assert_allclose(
        validation_model.predict(query), expected, rtol=0, atol=1e-4 if task == "rssi" else 5e-3
    )
    for stored in (coarse, model):
        fresh = registry("model").build(
            {"name": "kriging", "trend": {"name": "trained"}}, scene=links.scene
        )
        fresh.load_state_dict(stored.state_dict())
        assert torch.equal(fresh.predict(query), stored.predict(query))
        assert fresh.facts() == stored.facts()
        assert all(buffer.is_contiguous() for buffer in stored.buffers()), (
            "else loaded ones round products differently"
        )
    model.weight.fill_(0.25)
    parts = 0.25 * fresh.predict(query) + 0.75 * model.trend.predict(query)
    torch.testing.assert_close(model.predict(query), parts)


@TASKS
def test_a_state_with_the_names_of_before_loads(task, half):
    links = make(task, smooth=1.0)
    model, _ = kriged(links)
    state = {name.removeprefix("posterior."): part for name, part in model.state_dict().items()}
    if task == "rssi":
        state["hyperparameters"] = torch.full((3,), np.nan)
    fresh = Kriging(links.scene, Trained(links.scene))
    fresh.load_state_dict(state)
    assert torch.equal(fresh.predict(links.query), model.predict(links.query))


def test_facts_of_trend_and_kriging_are_reported(half):
    links = make("spectrum", smooth=1.0)
    model, _ = kriged(links)
    components = max(len(field.components) for field in model.posterior.fields)
    facts = {
        "weight": 1.0,
        "trend_weight": 0.5,
        "length_m": 2.0,
        "nugget": 0.1,
        "links": 80,
        "components": components,
    }
    assert model.facts() == {"kriging": facts}
    assert model.primitives is None
    assert model.rendering(links.batch(links.split.test)) is None


def test_many_links_are_thinned_evenly(half):
    links = make("rssi", smooth=1.0)
    few = limit_known(links, 20)
    assert [len(few.known(receiver)) for receiver in (0, 1)] == [20, 20]
    for part, whole in zip(few.split.parts().values(), links.split.parts().values(), strict=True):
        assert {*part.tolist()} <= {*whole.tolist()}
    assert torch.equal(few.split.test, links.split.test)
    model = Kriging(links.scene, Trained(links.scene))
    model.krige(links, most=20)
    query = links.query[own(links, links.split.test, 0)]
    expected = formula(model, links, query, few.known(0))
    np.testing.assert_allclose(model.predict(query), expected, rtol=0, atol=1e-4)


def test_without_validation_links_kriging_counts_fully(half):
    links = make("rssi", smooth=1.0)
    split = replace(links.split, validation=links.split.validation[:0])
    model = Kriging(links.scene, Trained(links.scene))
    model.fit(replace(links, split=split))
    assert model.weight == 1
    assert model.facts()["kriging"]["links"] == 60


# --- weights and hyperparameters ---


@TASKS
def test_a_trend_without_information_leaves_the_plain_process(task, monkeypatch):
    monkeypatch.setattr(FieldPosterior, "share", 0.0)
    links = make(
        task, 400 if task == "rssi" else 100, smooth=1.0, noise=0.1
    )  # one number says little
    if task == "csi":
        links.labels[links.split.train[:2]] *= 1e3  # far too loud, and limited by both
    fallback = {"spectrum": None, "rssi": {"name": "path_loss"}, "csi": {"name": "friis"}}[task]
    model, plain = (
        Kriging(links.scene, Trained(links.scene), fallback),
        GaussianProcess(links.scene, trend=fallback),
    )
    model.fit(links)
    plain.fit(links)
    assert model.weight == 1
    assert model.trend_weight <= (
        0.1 if task == "rssi" else 0
    )  # of RSSI a mean over what is likely
    if task != "rssi":
        assert model.posterior.hyperparameters.tolist() == pytest.approx(
            [*plain.process], nan_ok=True
        )
    query = links.query[links.split.test]
    error = 0.1 if task == "rssi" else 0.02
    torch.testing.assert_close(model.predict(query), plain.predict(query), rtol=0, atol=error)
    without = replace(links, labels=links.labels.index_fill(0, links.split.test, torch.nan))
    blind = Kriging(links.scene, Trained(links.scene), fallback)
    blind.fit(without)
    assert torch.equal(model.predict(query), blind.predict(query)), "test labels count"


@pytest.mark.parametrize(("places", "least", "most"), [(20, 0.2, 0.5), (400, 0.0, 0.1)])
def test_few_validation_places_shrink_the_trend_weight_to_a_half(places, least, most):
    links = make("rssi", places, smooth=1.0, noise=0.1)
    model = Kriging(links.scene, Trained(links.scene), {"name": "path_loss"})
    model.krige(links)
    assert least <= model.trend_weight < most


@TASKS
@pytest.mark.parametrize("trained", [0.0, 1.0])
def test_a_trend_that_scores_worse_than_its_fallback_is_reported(task, trained, caplog):
    links = make(task, smooth=1.0 - trained, trained=trained, noise=0.1)
    Kriging(links.scene, Trained(links.scene)).fit(links)
    said = [record.getMessage() for record in caplog.records if record.levelname == "WARNING"]
    assert [message.split(":")[0] for message in said] == (
        [] if trained else ["the room was not learnt"]
    )
    assert trained or "falls back on kriging of mean" in said[0]


@pytest.mark.parametrize("trained", [0.0, 1.0])
def test_a_room_that_levels_do_not_show_is_no_part_of_the_model(trained, tmp_path, monkeypatch):
    links = make("rssi", 400, smooth=1.0 - trained, trained=trained, noise=0.1)
    model = Kriging(links.scene, Trained(links.scene), {"name": "path_loss"})
    model.fit(links)
    monkeypatch.setattr(Trained, "learnt_room", lambda *_: "a room")
    monkeypatch.setattr(Trained, "learnt_paths", lambda *_: ["a path"])
    monkeypatch.setattr(Trained, "export", lambda _, folder: (folder / "planes.obj").touch())
    model.export(tmp_path)
    assert model.has_room == trained
    assert (model.trend_weight > 0) == trained
    assert model.learnt_room(links) == ("a room" if trained else None)
    assert model.learnt_paths(links.query) == (["a path"] if trained else [])
    assert [*tmp_path.iterdir()] == ([tmp_path / "planes.obj"] if trained else [])


def test_a_trend_that_was_not_learnt_is_left_out_where_scores_are_higher_without_it(monkeypatch):
    links, numbers = make("spectrum", smooth=1.0, noise=0.1), itertools.count()

    def likely(*parts, **options):
        return (
            fit.fit_hyperparameters(*parts, **options)[0],
            next(numbers),
        )

    monkeypatch.setattr(field, "fit_hyperparameters", likely)
    model = Kriging(links.scene, Trained(links.scene))
    model.fit(links)
    assert model.trend_weight == 0


@pytest.mark.parametrize(("task", "weight"), [("spectrum", 0.25), ("csi", 0.75)])
def test_the_trend_weight_is_that_of_the_labels(task, weight):
    assert kriged(make(task, smooth=0.3, trained=weight, noise=0.05))[0].trend_weight == weight


def test_links_that_the_trend_overfits_do_not_choose_the_trend_weight(monkeypatch):
    links = make("spectrum", smooth=1.0, noise=0.1)

    class Overfitted(Trained):
        def forward(self, batch):
            values = torch.zeros(len(batch), *self.scene.task.shape)
            same = (
                batch.query.transmitters[:, None] == links.query.transmitters[links.split.train]
            ).all(-1)
            link, which = same.nonzero().T
            values[link] = links.labels[links.split.train[which]]
            return Prediction(at_directions(values, batch, self.scene), {})

    model = Kriging(links.scene, Overfitted(links.scene))
    model.fit(links)
    assert model.trend_weight == 0


def test_where_kriging_does_harm_its_weight_is_zero(half):
    links = make("spectrum", smooth=3.0, trained=1.0)
    train = links.split.train
    links.labels[train] += 100 * torch.randn(
        links.labels[train].shape, generator=torch.Generator().manual_seed(3)
    )
    model = Kriging(links.scene, Trained(links.scene))
    validation_model = model.krige(links)
    assert model.weight == validation_model.weight == 0
    assert torch.equal(model.predict(links.query), model.trend.predict(links.query))


@pytest.mark.parametrize("carriers", [(), (2.4e9, 5e9)])
@pytest.mark.parametrize("kind", [GaussianProcess, Kriging])
def test_surveys_see_the_process_of_the_predictions(kind, carriers):
    links = make("spectrum", carriers=carriers, smooth=1.0)
    model = (
        GaussianProcess(links.scene)
        if kind is GaussianProcess
        else Kriging(links.scene, Trained(links.scene))
    )
    model.fit(links)
    query = links.query[links.split.test]
    query = query[query.receivers == 0]
    batch = Batch(query, links.task.directions)
    process = model.process_at(0)
    variances = posterior(process, coordinates(links.scene, query, 1.0)).diagonal() + process.noise
    with torch.device("meta"):  # all that is made must stand where the places are, as on a GPU
        expected = model.deviations(batch).square()
    torch.testing.assert_close(variances, expected.to(variances), rtol=1e-5, atol=0)


# --- features ---


class Shadowed(Trained):
    """Knows on which side of a shadow's edge a place is, and little else."""

    def forward(self, batch):
        sides = (batch.query.transmitters[:, 0] > BOX[0] / 2).float()[:, None, None]
        return Prediction(at_directions((0.2 * self.weights * sides), batch, self.scene), {})


def test_places_correlate_by_the_spectra_of_the_trend_too(monkeypatch):
    """Labels of both sides of an edge are unlike, however near the places are."""
    monkeypatch.setitem(registry("model")._registered, "trained", Shadowed)
    links = make("spectrum", 200, smooth=0.7, noise=0.02)
    is_beyond = links.query.transmitters[:, 0] > BOX[0] / 2
    links.labels[is_beyond] += torch.randn(
        links.task.shape, generator=torch.Generator().manual_seed(1)
    )
    model = Kriging(links.scene, Shadowed(links.scene))
    model.fit(links)
    assert model.posterior.has_features
    assert model.facts()["kriging"]["spectrum_scale_m"] > 0
    assert model.has_room
    query = links.query[links.split.test]
    values = model.predict(query)
    thin = Batch(query, links.task.directions.thin(slice(1, None, 2), slice(None, None, 3)))
    torch.testing.assert_close(model(thin).value, values[:, 1::2, ::3])
    loaded = Kriging(links.scene, {"name": "trained"})
    loaded.load_state_dict(model.state_dict())
    assert torch.equal(loaded.predict(query), values)

    monkeypatch.setattr(Kriging, "_features", lambda *_: ())
    plain = Kriging(links.scene, Shadowed(links.scene))
    plain.fit(links)
    assert not plain.posterior.has_features
    labels = links.labels[links.split.test]
    assert (values - labels).square().mean() < 0.8 * (plain.predict(query) - labels).square().mean()


# --- components ---


@pytest.mark.parametrize("dtype", [torch.float32, torch.complex64])
@pytest.mark.parametrize("exact", [True, False])
def test_components_are_the_fewest_that_leave_little_out(dtype, exact):
    options = {"share": 0.02, "most": 100, "exact": 512 if exact else 10}
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randn(*shape, dtype=dtype, generator=generator)

    residuals = draw(150, 60) @ (2.0 ** -torch.arange(60))[:, None].to(dtype).mul(draw(60, 200))
    state = torch.random.get_rng_state()
    components = principal_components(residuals, **options)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert components.abs().amax(1) == pytest.approx(1)
    values = np.linalg.svd(residuals.numpy(), compute_uv=False).astype(float)

    def left(count):
        return (values[count:] ** 2).sum() / (values**2).sum()

    assert left(len(components)) <= 0.02 < left(len(components) - 1)
    basis, _ = np.linalg.qr(components.numpy().T.astype(complex).conj())
    over = residuals.numpy() - residuals.numpy() @ basis @ basis.conj().T
    assert np.linalg.norm(over) ** 2 / np.linalg.norm(residuals) ** 2 == pytest.approx(
        left(len(components)), rel=0.02
    )
    assert len(principal_components(residuals, **options | {"share": 0.0, "most": 3})) == 3


def test_components_of_millions_of_numbers_leave_as_little_out():
    """A single sum in single precision would be wrong by more than ``LEFT``."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return torch.randn(*shape, generator=generator)

    residuals = draw(500, 150) * torch.logspace(0, -2.5, 150) @ draw(150, 32400)
    basis, _ = torch.linalg.qr(principal_components(residuals).T)
    over = residuals - residuals @ basis @ basis.T
    assert (
        over.double().square().sum()
        < 1.01 * FieldPosterior.share * residuals.double().square().sum()
    )


def test_residuals_of_zero_are_kriged_to_zero():
    """As where a receiver's only known link is its mean."""
    scene = example_links("spectrum").scene
    own, places = field.Field(scene), torch.rand(1, 3, dtype=torch.float64)
    own.solve(places, torch.zeros(1, *scene.task.shape), PROCESS)
    batch = example_links("spectrum").batch(torch.arange(2))
    assert not own(batch.query.transmitters.double(), 2.0, batch).any()
    assert own.size(PROCESS) == 0


# --- faults ---


@pytest.mark.parametrize(
    ("trend", "fallback", "message"),
    [
        ({"name": "mean"}, None, "kriging needs a trained model, got mean"),
        ({"name": "trained"}, {"name": "knn"}, "kriging_fallback cannot be knn; take mean"),
        ({"name": "trained"}, {"name": "trained"}, "kriging_fallback cannot be trained"),
    ],
)
def test_untrained_trends_and_unsuitable_fallbacks_are_refused(trend, fallback, message):
    with pytest.raises(ValueError, match=message):
        Kriging(example_links("rssi").scene, trend, fallback)


def test_a_law_ahead_of_the_room_is_fitted_once_and_nothing_is_predicted_for_the_known(monkeypatch):
    links = make(smooth=3.0, noise=0.1, count=400)
    model = Kriging(links.scene, Trained(links.scene))
    held = links.split.validation[::2]
    scores = model.law_scores(links, held)
    law, _ = model.laws
    alone = registry("model").build(links.task.trends[-1], scene=links.scene)
    alone.fit(replace(links, split=links.split.validating()))
    errors = (alone.predict(links.query[held]) - links.labels[held]).abs()
    torch.testing.assert_close(scores, -errors.double())
    asked = []

    def predicted(one, links, index):
        asked.append((one, len(index)))
        return answers.predicted(one, links, index)

    monkeypatch.setattr(kriging, "predicted", predicted)
    model.krige(links)
    assert model.laws[0] is law
    assert model.trend_weight == 0
    assert [count for one, count in asked if one is model.trend] == [len(links.split.validation)]
