"""The Gaussian process against its formulas in numpy, and against draws of processes whose lengths are known."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist
from scipy.stats import multivariate_normal

from gaigs.data import Split
from gaigs.kriging import fit
from gaigs.kriging.fit import FEWEST, NOISE, hold_out, misfit
from gaigs.model import gaussian_process
from gaigs.model.gaussian_process import GaussianProcess
from gaigs.query import Query
from gaigs.registry import registry
from gaigs.task.csi import Csi
from gaigs.testing import check_model, example_links

TASKS = pytest.mark.parametrize("task", ["spectrum", "rssi", "csi", "one channel"])


def make(task="rssi", count=80, carriers=(), seed=0):
    """Random labels of random places, which both receivers hear in turn; the last fifth tests, a tenth validates."""
    links = example_links("csi" if task == "one channel" else task)
    generator = torch.Generator().manual_seed(seed)
    places = torch.rand(count, 3, generator=generator) * torch.tensor([6.0, 4.0, 2.0])
    made = Csi(1, torch.tensor([2.4e9])) if task == "one channel" else links.task
    labels = torch.randn(count, *made.shape, dtype=made.dtype, generator=generator)
    frequencies = torch.tensor(carriers)[torch.arange(count) % len(carriers)] if carriers else None
    train, validation, test = torch.arange(count).split((7 * count // 10, count // 10, count - 8 * count // 10))
    return replace(
        links,
        query=Query(places, torch.arange(count) // 2 % 2, frequencies),
        labels=labels,
        task=made,
        rows=None,
        split=Split("made up", train, validation, test),
    )


def held_out(links, receiver, model):
    """Links to choose hyperparameters by, where there is one carrier."""
    residuals = lambda index: torch.cat([part.reshape(len(part), -1) for _, part in model._residuals(index)])
    return hold_out(links.scene, links, model.known, receiver, None, residuals, 150)


def fitted(links, **options):
    model = GaussianProcess(links.scene, **options)
    model.fit(links)
    return model


def drawn(length, noise, count=250, seed=0):
    """Spectra whose 648 pixels are draws of the process with these hyperparameters; a single receiver hears them."""
    links = make("spectrum", count)
    rng = np.random.default_rng(seed)
    positions = links.query.transmitters.double().numpy()
    covariances = np.exp(-cdist(positions, positions) / length) + noise * np.eye(count)
    labels = 0.3 * np.linalg.cholesky(covariances) @ rng.standard_normal((count, 648))
    return replace(
        links,
        query=replace(links.query, receivers=torch.zeros(count, dtype=torch.long)),
        receivers=links.receivers[:1],
        labels=torch.from_numpy(labels).float().unflatten(1, (18, 36)),
    )


def kriged(model, links, receiver, asked, nearest=None):
    """trend + k' (K + noise)^-1 residuals in numpy, from all known links or some nearest ones."""
    index = torch.cat((links.split.train, links.split.validation))
    index = index[links.query.receivers[index] == receiver]
    positions, labels = links.query.transmitters[index].double().numpy(), links.labels[index].numpy()
    mean = labels.astype(np.complex128 if np.iscomplexobj(labels) else np.float64).mean(0)
    values = []
    for place in asked.double().numpy():
        chosen = np.argsort(np.linalg.norm(positions - place, axis=1))[:nearest]
        covariances = np.exp(-cdist(positions[chosen], positions[chosen]) / model.process.length)
        towards = np.exp(-np.linalg.norm(positions[chosen] - place, axis=1) / model.process.length)
        weights = np.linalg.solve(covariances + model.process.noise * np.eye(len(chosen)), towards)
        values.append(mean + np.tensordot(weights, labels[chosen] - mean, 1))
    return np.stack(values)


# --- predictions ---


@pytest.mark.parametrize("task", ["spectrum", "rssi", "csi"])
def test_it_keeps_the_contract_of_models(task):
    check_model(GaussianProcess, example_links(task))


@TASKS
@pytest.mark.parametrize("receiver", [0, 1])
def test_predictions_are_the_processs_mean(task, receiver):
    links = make(task)
    model = fitted(links)
    asked = torch.rand(5, 3) * torch.tensor([6.0, 4.0, 2.0])
    found = model.predict(asked, receiver)
    assert found.dtype == links.task.dtype
    np.testing.assert_allclose(found, kriged(model, links, receiver, asked), rtol=0, atol=2e-5)


@TASKS
def test_many_links_are_predicted_from_the_nearest(task, monkeypatch):
    links = make(task)
    monkeypatch.setattr(gaussian_process, "LIMIT", 20)
    monkeypatch.setattr(gaussian_process, "NEIGHBOURS", 7)
    model = fitted(links)
    asked = torch.rand(5, 3) * torch.tensor([6.0, 4.0, 2.0])
    expected = kriged(model, links, 1, asked, nearest=7)
    np.testing.assert_allclose(model.predict(asked, 1), expected, rtol=0, atol=2e-5)
    assert abs(expected - kriged(model, links, 1, asked)).max() > 1e-4


@TASKS
def test_labels_are_held_in_memory_by_parts(task, monkeypatch):
    links, asked = make(task), torch.rand(5, 3)
    whole = fitted(links).predict(asked)
    sizes = []

    class Counted:
        def __getitem__(self, index):
            sizes.append(len(index))
            return links.labels[index]

    monkeypatch.setattr(gaussian_process, "PART", 9)
    model = fitted(replace(links, labels=Counted()), trend={"name": "mean"})
    sizes.remove(max(sizes))  # the trend's own
    sizes.remove(max(sizes))
    torch.testing.assert_close(model.predict(asked), whole, rtol=0, atol=1e-5)
    assert max(sizes) == 9


@pytest.mark.filterwarnings("ignore::gaigs.geometry.ExtrapolationWarning")
@TASKS
def test_far_away_nothing_is_left_but_the_trend(task):
    links = make(task)
    model, mean = fitted(links), registry("model").build({"name": "mean"}, scene=links.scene)
    mean.fit(links)
    far = torch.full((1, 3), 9e4)
    torch.testing.assert_close(model.predict(far), mean.predict(far), rtol=0, atol=1e-5)


def test_the_process_is_of_what_the_trend_leaves_over():
    links = example_links("rssi")
    law = registry("model").build({"name": "path_loss"}, scene=links.scene)
    law.load_state_dict({"levels": torch.tensor([-40.0, -45.0]), "exponents": torch.tensor([2.7, 1.9])})
    exact = replace(links, labels=law.predict(links.query))
    asked = torch.rand(6, 3) * torch.tensor([6.0, 4.0, 2.0])
    with_trend, without = fitted(exact, trend={"name": "path_loss"}), fitted(exact)
    torch.testing.assert_close(with_trend.predict(asked), law.predict(asked), rtol=0, atol=1e-3)
    assert (without.predict(asked) - law.predict(asked)).abs().max() > 0.1
    # What is added to the labels that the trend explains is added to the predictions.
    more = fitted(replace(links, labels=links.labels + exact.labels), trend={"name": "path_loss"})
    plain = fitted(links, trend={"name": "path_loss"})
    torch.testing.assert_close(more.predict(asked), plain.predict(asked) + law.predict(asked), rtol=0, atol=1e-2)


@pytest.mark.filterwarnings("ignore::gaigs.geometry.ExtrapolationWarning")
def test_channels_have_a_trend_too():
    links = example_links("csi")
    model, friis = fitted(links, trend={"name": "friis"}), registry("model").build({"name": "friis"}, scene=links.scene)
    friis.fit(links)
    far = torch.full((1, 3), 1e3)
    torch.testing.assert_close(model.predict(far), friis.predict(far))


@TASKS
def test_places_measured_twice_do_not_break_the_matrices(task):
    links = make(task)
    positions = links.query.transmitters
    positions[4:40] = positions[:4].repeat(9, 1)
    model = fitted(links)
    model.process = model.process._replace(noise=NOISE[0])
    model.solved = [model._solve(index) for index in model.known]
    found, expected = model.predict(positions[:2], 0), kriged(model, links, 0, positions[:2])
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-4)
    copies = links.labels[:40].unflatten(0, (10, 4))[:, :2].mean(0)
    torch.testing.assert_close(found, copies, rtol=0, atol=1e-3)


def test_predictions_do_not_depend_on_the_order_of_the_links():
    links = make("rssi", 400)
    order = torch.randperm(400, generator=torch.Generator().manual_seed(1))
    places = order.argsort()
    parts = [places[part].sort().values for part in links.split.parts().values()]
    turned = replace(links, query=links.query[order], labels=links.labels[order], split=Split("turned", *parts))
    asked = torch.rand(6, 3)
    torch.testing.assert_close(fitted(turned).predict(asked), fitted(links).predict(asked), rtol=0, atol=1e-3)


# --- hyperparameters ---


@pytest.mark.parametrize("validation", [True, False])
@pytest.mark.parametrize(("length", "noise"), [(0.5, 0.01), (2.0, 0.1), (1.0, 1.0)])
def test_length_and_noise_are_those_of_the_process(length, noise, validation, monkeypatch):
    monkeypatch.setattr(fit, "AROUND", 24)
    links = drawn(length, noise)
    if not validation:
        split = links.split
        links = replace(links, split=replace(split, train=torch.arange(200), validation=split.validation[:0]))
    model = fitted(links)
    # Validation links are few.
    tolerance = 0.5 if validation else 0.3
    assert model.process.length == pytest.approx(length, rel=tolerance)
    assert model.process.noise == pytest.approx(noise, rel=tolerance, abs=0.02)
    assert model.facts() == {"length_m": model.process.length, "noise_to_signal": model.process.noise}


def test_the_misfit_is_the_density_of_held_out_labels_given_those_around():
    links = make("rssi", 60)
    model = fitted(links)
    held = held_out(links, 0, model)
    residuals = links.labels - links.labels[model.known[0]].mean()
    validation = links.split.train[links.query.receivers[links.split.train] == 0]  # fewer than FEWEST validate
    assert torch.equal(held.asked.transmitters, links.query.transmitters[validation])
    length, noise = 1.3, 0.2
    conditionals, values = [], []
    around = held.around.transmitters.unflatten(0, (len(validation), -1)).double().numpy()
    lookup = {tuple(place): value for place, value in zip(links.query.transmitters.tolist(), residuals, strict=True)}
    for one, others in zip(held.asked.transmitters.double().numpy(), around, strict=True):
        places = np.vstack((one[None], others))
        covariances = np.exp(-cdist(places, places) / length) + noise * np.eye(len(places))
        label = np.array([lookup[tuple(place)] for place in places.tolist()])
        # p(one | others) = p(all) / p(others), for the process's variance s: a parabola in 1 / s of known height.
        conditionals.append((covariances, label))
        inverse = np.linalg.inv(covariances)
        values.append(label @ inverse @ label - label[1:] @ np.linalg.solve(covariances[1:, 1:], label[1:]))
    variance = np.mean(values)
    total = sum(
        multivariate_normal(np.zeros(len(label)), variance * covariances).logpdf(label)
        - multivariate_normal(np.zeros(len(label) - 1), variance * covariances[1:, 1:]).logpdf(label[1:])
        for covariances, label in conditionals
    )
    found = misfit(links.scene, held, torch.tensor(length), torch.tensor(noise)).item()
    assert found == pytest.approx(-2 * total - len(values) * (1 + np.log(2 * np.pi)), rel=1e-6)


def test_they_are_the_likeliest_within_their_bounds():
    links = make("spectrum", 100)
    links.labels.add_(links.query.transmitters[:, :1, None].sin())
    model = fitted(links)
    held = [held_out(links, receiver, model) for receiver in (0, 1)]
    total = lambda *at: sum(misfit(links.scene, one, *map(torch.tensor, at)).item() for one in held)
    best = total(model.process.length, model.process.noise)
    edge = (links.scene.upper - links.scene.lower).max().item()
    low, high = (links.scene.spacing, NOISE[0]), (8 * edge, NOISE[1])
    for factors in ((1.2, 1), (1 / 1.2, 1), (1, 1.2), (1, 1 / 1.2), (30, 1), (1 / 30, 1), (1, 30), (1, 1 / 30)):
        at = np.clip(np.array([model.process.length, model.process.noise]) * factors, low, high)
        assert total(*at) >= best - 1e-6, factors


def test_validation_links_are_held_out_from_the_training_links():
    links = make("rssi", 400)
    assert len(links.split.validation) >= FEWEST
    held = held_out(links, 1, fitted(links))
    heard = lambda part: part[links.query.receivers[part] == 1]
    as_set = lambda places: {tuple(place) for place in places.tolist()}
    places = links.query.transmitters
    assert as_set(held.asked.transmitters) == as_set(places[heard(links.split.validation)])
    assert as_set(held.around.transmitters) <= as_set(places[heard(links.split.train)])


def test_without_a_validation_copies_of_a_link_do_not_predict_it(monkeypatch):
    """Else noise would pass for signal: every copy has the same noise."""
    monkeypatch.setattr(fit, "AROUND", 24)
    links = drawn(1.0, 1.0)
    twice = torch.arange(400) % 200
    split = Split("twice", torch.arange(400), torch.arange(0), torch.arange(400, 450))
    query = links.query[torch.cat((twice, torch.arange(200, 250)))]
    labels = links.labels[torch.cat((twice, torch.arange(200, 250)))]
    assert fitted(replace(links, query=query, labels=labels, split=split)).process.noise > 0.3


@TASKS
def test_labels_that_the_trend_explains_are_predicted_by_it(task):
    links = make(task)
    links.labels[:] = torch.full(links.task.shape, 0.5)
    model = fitted(links)
    torch.testing.assert_close(model.predict(torch.rand(4, 3)), links.labels[:4], rtol=0, atol=1e-6)
    edge = (links.scene.upper - links.scene.lower).max().item()
    assert links.scene.spacing < model.process.length < 8 * edge


@pytest.mark.parametrize("known", [1, 2])
def test_a_receiver_with_hardly_a_link_is_predicted(known):
    links = make("rssi", 40)
    links.query.receivers[:32] = 0
    links.query.receivers[:known] = 1
    model = fitted(links)
    found = model.predict(links.query.transmitters[:known], 1)
    assert found.isfinite().all()
    assert (found - links.labels[:known].mean()).abs().max() <= (links.labels[:known] - found.mean()).abs().max() + 1e-6


# --- several carriers ---


def test_the_distance_is_over_place_and_log_frequency():
    links = make("rssi", 120, carriers=(1e9, 1.7e9, 2.9e9))
    links.labels.add_(3 * links.query.frequencies.log() + links.query.transmitters[:, 0])
    model = fitted(links)
    assert model.facts() == {
        "length_m": model.process.length,
        "noise_to_signal": model.process.noise,
        "frequency_scale_m": model.process.scale,
    }
    stretched = lambda query: torch.cat(
        (query.transmitters.double(), model.process.scale * query.frequencies.double().log()[:, None]), 1
    )
    index = model.known[0]
    asked = Query(torch.rand(4, 3), torch.zeros(4, dtype=torch.long), torch.tensor([1e9, 1.3e9, 2e9, 5e9]))
    places, towards = stretched(links.query[index]).numpy(), stretched(asked).numpy()
    labels = links.labels[index].double().numpy()
    covariances = np.exp(-cdist(places, places) / model.process.length) + model.process.noise * np.eye(len(index))
    weights = np.exp(-cdist(towards, places) / model.process.length) @ np.linalg.inv(covariances)
    expected = labels.mean() + weights @ (labels - labels.mean())
    np.testing.assert_allclose(model.predict(asked), expected, rtol=0, atol=1e-3)


def test_the_scale_of_frequencies_is_that_of_the_process(monkeypatch):
    monkeypatch.setattr(fit, "AROUND", 24)
    scale, length, noise, count = 3.0, 2.0, 0.05, 250
    links = make("spectrum", count, carriers=(1e9, 1.7e9, 2.9e9, 5e9))
    query = replace(links.query, receivers=torch.zeros(count, dtype=torch.long))
    stretched = torch.cat((query.transmitters.double(), scale * query.frequencies.double().log()[:, None]), 1).numpy()
    covariances = np.exp(-cdist(stretched, stretched) / length) + noise * np.eye(count)
    draws = np.linalg.cholesky(covariances) @ np.random.default_rng(0).standard_normal((count, 648))
    split = Split("no validation", torch.arange(200), torch.arange(0), torch.arange(200, count))
    links = replace(links, query=query, receivers=links.receivers[:1], split=split)
    model = fitted(replace(links, labels=torch.from_numpy(draws).float().unflatten(1, (18, 36))))
    assert model.process.scale == pytest.approx(scale, rel=0.2)
    assert model.process.length == pytest.approx(length, rel=0.2)


def test_a_missing_frequency_is_refused():
    model = fitted(make("rssi", carriers=(1e9, 2e9)))
    with pytest.raises(ValueError, match="2 carriers"):
        model.predict(torch.zeros(2, 3))
    with pytest.raises(ValueError, match="2 carriers"):
        model.predict(Query(torch.zeros(2, 3), torch.zeros(2, dtype=torch.long)))


# --- what it is, and what it refuses ---


def test_it_is_a_look_up():
    model = fitted(example_links("rssi"), trend={"name": "path_loss"})
    assert not model.state_dict()
    assert not list(model.parameters())


def test_no_test_label_is_looked_at():
    links = make("spectrum")
    labels = links.labels.clone()
    labels[links.split.test] = torch.nan
    asked = links.query[links.split.test]
    assert torch.equal(fitted(links).predict(asked), fitted(replace(links, labels=labels)).predict(asked))


def test_a_trend_that_is_trained_is_refused(monkeypatch):
    class Trained(torch.nn.Linear):
        def __init__(self, scene):
            super().__init__(3, 1)

    monkeypatch.setitem(registry("model")._registered, "trained", Trained)
    with pytest.raises(ValueError, match="must be a model that is fitted at once, and trained is trained; take mean"):
        GaussianProcess(example_links().scene, trend={"name": "trained"})


def test_a_trend_for_other_labels_is_refused():
    with pytest.raises(ValueError, match="model path_loss must have one real number a link"):
        GaussianProcess(example_links().scene, trend={"name": "path_loss"})


def test_a_receiver_without_known_links_is_refused():
    links = example_links("rssi")
    links.query.receivers[:20] = 0  # the other is heard in the test alone
    with pytest.raises(ValueError, match="on split 'example' there are none of gateway1; choose another split"):
        fitted(links)


@pytest.mark.parametrize("factor", [1e3, 1e-6])
def test_a_channel_that_is_far_too_loud_is_not_heard_all_over_the_room(factor):
    """Channels that are alike within a metre, and one that is not."""
    links = make("csi")
    places = links.query.transmitters
    labels = torch.polar(torch.ones(80), places.sum(1))[:, None, None] * links.labels[:1]
    changed = labels.clone()
    changed[3] *= factor
    asked = links.split.test[links.query.receivers[links.split.test] == links.query.receivers[3]]
    error = {}
    for name, part in (("plain", labels), ("changed", changed)):
        model = fitted(replace(links, labels=part), trend={"name": "friis"})  # no gain where phases are not geometry's
        left = model.predict(links.query[asked]) - labels[asked]
        error[name] = left.abs().square().mean((1, 2)).median().sqrt().item()
    assert error["changed"] < 2 * error["plain"] < labels.abs().square().mean().sqrt().item()
