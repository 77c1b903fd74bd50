"""The Gaussian process against numpy, and against draws of processes with known hyperparameters.

tests/model/test_baselines_by_hand.py checks its predictions and the likelihood of its
hyperparameters, and test_scalar_process.py the process of labels of one number.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist

from gaigs.core.query import Query
from gaigs.core.task.csi import Csi
from gaigs.data import Split
from gaigs.kriging.fit import HeldOut, hold_out, negative_log_likelihood
from gaigs.kriging.kernel import kriging_weights
from gaigs.model import Model
from gaigs.model.gaussian_process import GaussianProcess
from gaigs.registry import registry
from gaigs.testing import example_links

TASKS = pytest.mark.parametrize("task", ["spectrum", "csi", "one channel"])
BOX = torch.tensor([6.0, 4.0, 2.0])


def make(task="rssi", count=60, carriers=()):
    """Random labels of random places, which both receivers hear in turn; 0.7 train, 0.1 validate,
    0.2 test.
    """
    links = example_links("csi" if task == "one channel" else task)
    generator = torch.Generator().manual_seed(0)
    places = BOX * torch.rand(count, 3, generator=generator)
    made = Csi(1, torch.tensor([2.4e9])) if task == "one channel" else links.task
    frequencies = torch.tensor(carriers)[torch.arange(count) % len(carriers)] if carriers else None
    parts = torch.arange(count).split((7 * count // 10, count // 10, count - 8 * count // 10))
    return replace(
        links,
        query=Query(places, torch.arange(count) // 2 % 2, frequencies),
        labels=torch.randn(count, *made.shape, dtype=made.dtype, generator=generator),
        task=made,
        rows=None,
        split=Split("made up", *parts),
    )


def fitted(links, **options):
    """About the mean, unless options say otherwise: channels are about ``friis`` by default."""
    model = GaussianProcess(
        links.scene,
        **({"trend": {"name": "mean"}} if links.task.dtype.is_complex else {}) | options,
    )
    model.fit(links)
    return model


def drawn(length, nugget, scale=0.0, validation=0):
    """Spectra whose 648 pixels are draws of the process, all at one receiver; 40 of 240 links test."""
    links = make("spectrum", 240, carriers=(1e9, 1.7e9, 2.9e9, 5e9) if scale else ())
    places = links.query.transmitters.double()
    if scale:
        places = torch.cat((places, scale * links.query.frequencies.double().log()[:, None]), 1)
    covariances = np.exp(-cdist(places, places) / length) + nugget * np.eye(240)
    labels = (
        0.3 * np.linalg.cholesky(covariances) @ np.random.default_rng(0).standard_normal((240, 648))
    )
    return replace(
        links,
        query=replace(links.query, receivers=torch.zeros(240, dtype=torch.long)),
        receivers=links.receivers[:1],
        labels=torch.from_numpy(labels).float().unflatten(1, (18, 36)),
        split=Split("drawn", *torch.arange(240).split((200 - validation, validation, 40))),
    )


def kriged(model, links, receiver, asked, nearest=None):
    """mean + k' (K + nugget)^-1 residuals in numpy, from all known links or the nearest ones."""
    index = links.known(receiver)
    positions, labels = (
        links.query.transmitters[index].double().numpy(),
        links.labels[index].numpy(),
    )
    mean = labels.astype(np.complex128 if np.iscomplexobj(labels) else np.float64).mean(0)
    values = []
    for place in asked.double().numpy():
        chosen = np.argsort(np.linalg.norm(positions - place, axis=1))[:nearest]
        covariances = np.exp(-cdist(positions[chosen], positions[chosen]) / model.process.length)
        towards = np.exp(-np.linalg.norm(positions[chosen] - place, axis=1) / model.process.length)
        weights = np.linalg.solve(covariances + model.process.nugget * np.eye(len(chosen)), towards)
        values.append(mean + np.tensordot(weights, labels[chosen] - mean, 1))
    return np.stack(values)


# --- predictions ---


def test_the_variance_is_the_conditional_one():
    asked, around = BOX * torch.rand(3, 3), BOX * torch.rand(3, 5, 3)
    _, variances = kriging_weights(asked.double(), around.double(), 1.3, 0.2)
    for place, others, variance in zip(asked, around, variances, strict=True):
        places = torch.cat((place[None], others)).double()
        joint = np.exp(-cdist(places, places) / 1.3) + 0.2 * np.eye(6)
        assert variance.item() == pytest.approx(1 / np.linalg.inv(joint)[0, 0])


@TASKS
def test_many_links_are_predicted_from_the_nearest(task, monkeypatch):
    links = make(task)
    monkeypatch.setattr(GaussianProcess, "limit", 20)
    monkeypatch.setattr(GaussianProcess, "neighbours", 7)
    model, asked = fitted(links), BOX * torch.rand(5, 3)
    found, expected = model.predict(asked, 1), kriged(model, links, 1, asked, nearest=7)
    assert found.dtype == links.task.dtype
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-5)
    assert abs(expected - kriged(model, links, 1, asked)).max() > 1e-4


@pytest.mark.filterwarnings("ignore::gaigs.core.geometry.ExtrapolationWarning")
@pytest.mark.parametrize(
    ("task", "trend"), [("spectrum", "mean"), ("rssi", "path_loss"), ("csi", "friis")]
)
def test_far_from_all_links_only_the_trend_is_predicted(task, trend):
    links = example_links(task)
    options = {"trend": None if task == "csi" else {"name": trend}}
    model, plain = (
        fitted(links, **options),
        registry("model").build({"name": trend}, scene=links.scene),
    )
    plain.fit(links)
    far = torch.full((1, 3), 1e4)
    torch.testing.assert_close(model.predict(far), plain.predict(far), rtol=1e-5, atol=1e-5)


@TASKS
def test_places_measured_twice_do_not_break_the_matrices(task):
    links = make(task)
    positions = links.query.transmitters
    positions[4:40] = positions[:4].repeat(9, 1)
    model = fitted(links)
    model.process = model.process._replace(nugget=1e-4)
    model.solved = [model._solve(index, model._factor(index)) for index in model.known]
    found, expected = model.predict(positions[:2], 0), kriged(model, links, 0, positions[:2])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)
    copies = links.labels[:40].unflatten(0, (10, 4))[:, :2].mean(0)
    torch.testing.assert_close(found, copies, rtol=0, atol=1e-3)


# --- hyperparameters ---


@pytest.mark.parametrize(
    ("length", "nugget", "scale", "validation"),
    [(0.5, 0.01, 0, 0), (1.0, 1.0, 0, 40), (2.0, 0.05, 3, 0)],
)
def test_hyperparameters_are_those_of_the_process(length, nugget, scale, validation):
    process = fitted(drawn(length, nugget, scale, validation)).process
    assert process.length == pytest.approx(length, rel=0.3)
    assert process.nugget == pytest.approx(nugget, rel=0.3, abs=0.02)
    assert process.scale == pytest.approx(scale or np.nan, rel=0.2, nan_ok=True)


def test_without_a_validation_no_copy_of_a_link_predicts_it():
    """Copies share their noise, which would pass for signal."""
    links = make("rssi", 40)
    links.query.transmitters[20:] = links.query.transmitters[:20].clone()
    held = hold_out(
        links.scene, links, links.known(0), np.nan, lambda index: links.labels[index][:, None], 100
    )
    around = held.around.transmitters.unflatten(0, (len(held.asked), -1))
    assert (around != held.asked.transmitters[:, None]).any(-1).all()


def test_a_squared_error_below_zero_by_rounding_has_a_likelihood():
    links = make("rssi", 10)
    products = torch.tensor([[[1.0, 1.1], [1.1, 1.0]]], dtype=torch.float64)
    held = HeldOut(links.query[:1], links.query[:1], products)
    assert negative_log_likelihood(
        links.scene, held, torch.tensor(1.0), torch.tensor(1e-4)
    ).isfinite()


@TASKS
def test_labels_that_the_trend_explains_are_predicted_by_it(task):
    links = make(task)
    links.labels[:] = torch.full(links.task.shape, 0.5)
    model = fitted(links)
    torch.testing.assert_close(
        model.predict(torch.rand(4, 3), 0), links.labels[:4], rtol=0, atol=1e-6
    )
    edge = (links.scene.upper - links.scene.lower).max().item()
    assert links.scene.spacing < model.process.length < 8 * edge


@pytest.mark.parametrize(("first", "count"), [(0, 1), (0, 2), (28, 2)])
def test_a_receiver_with_hardly_a_link_is_predicted(first, count):
    links, known = make("rssi", 40), slice(first, first + count)  # links from 28 on validate
    links.query.receivers[:32] = 0
    links.query.receivers[known] = 1
    found = fitted(links).predict(links.query.transmitters[known], 1)
    labels = links.labels[known]
    assert found.isfinite().all()
    assert (found - labels.mean()).abs().max() <= (labels - found.mean()).abs().max() + 1e-6


def test_a_state_whose_process_is_in_a_list_loads():
    links = make("rssi")
    model = fitted(links)
    state = {
        name.replace("scalar.", "scalar.0."): part for name, part in model.state_dict().items()
    }
    fresh = GaussianProcess(links.scene)
    fresh.load_state_dict(state)
    assert torch.equal(fresh.predict(links.query), model.predict(links.query))


# --- faults ---


def test_a_trend_that_does_not_suit_is_refused(monkeypatch):
    class Trained(Model):
        def __init__(self, scene):
            super().__init__(scene)
            self.level = torch.nn.Parameter(torch.zeros(()))

    monkeypatch.setitem(registry("model")._registered, "trained", Trained)
    with pytest.raises(ValueError, match="cannot be trained, got trained; take mean"):
        GaussianProcess(example_links().scene, trend={"name": "trained"})
    with pytest.raises(ValueError, match="model 'path_loss' predicts one real number a link"):
        GaussianProcess(example_links().scene, trend={"name": "path_loss"})
