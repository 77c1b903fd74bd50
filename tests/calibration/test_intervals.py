"""Intervals against draws whose errors are known, scipy, and numbers by hand."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.integrate import quad

import gaigs
from gaigs.calibration import Calibration, Estimate
from gaigs.calibration.conformal import nearest
from gaigs.calibration.scores import interval_scores, summarise_intervals
from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose, Rays
from gaigs.core.query import Query
from gaigs.core.task.csi import Csi
from gaigs.data import Split
from gaigs.kriging.scalar import ScalarProcess
from gaigs.kriging.scalar_fit import ScalarOptions
from gaigs.model import answers
from gaigs.model.kriging import Kriging
from gaigs.report.intervals import intervals
from gaigs.runs import evaluation
from gaigs.testing import example_links

TASKS = pytest.mark.parametrize("task", ["rssi", "spectrum", "csi"])
BOX = torch.tensor([6.0, 4.0, 2.0])


def made(task, count, seed=0, receivers=1, size=1.0):
    """Labels about values of a model, with errors that are heavy-tailed and alike within a link;
    and queries.
    """
    generator = torch.Generator().manual_seed(seed)
    kind = example_links(task).task
    values = torch.rand(count, *kind.shape, generator=generator).to(kind.dtype)
    scales = (
        size
        * 0.2
        * torch.rand(count, generator=generator)
        .reciprocal()
        .sqrt()
        .reshape(-1, *[1] * len(kind.shape))
    )
    errors = scales * torch.randn(count, *kind.shape, dtype=kind.dtype, generator=generator)
    labels = (values + errors).to(kind.dtype)
    labels = labels.clamp_min(0) if task == "spectrum" else labels
    query = Query(BOX * torch.rand(count, 3, generator=generator), torch.arange(count) % receivers)
    return kind, labels, values, query


def shares(task, count, level, repeats=40, **options):
    """Share of new links' numbers that intervals hold, mean over calibrations on ``count`` links."""
    found = []
    for seed in range(repeats):
        kind, labels, values, query = made(task, count + 200, seed, **options)
        held, new = slice(0, count), slice(count, None)
        ones = torch.ones(len(query))
        calibration = Calibration.of(
            kind, labels[held], values[held], ones[held], query[held], None, query[:1]
        )
        estimate = calibration.estimate(values[new], ones[new], query[new], level)
        found.append(interval_scores(labels[new], estimate, estimate)["coverage_90"].mean().item())
    return np.mean(found), np.std(found) / math.sqrt(repeats)


@TASKS
@pytest.mark.parametrize("count", [12, 60])
@pytest.mark.parametrize("level", [0.5, 0.9])
def test_intervals_hold_their_share_of_new_links(task, count, level):
    share, error = shares(task, count, level)
    # Of single numbers, those of a whole number of links.
    assert abs(share - level) <= 3 * error + (0.5 / (count + 1) if task == "rssi" else 0)


def test_receivers_with_enough_links_have_intervals_of_their_own():
    kind, labels, values, query = made("rssi", 400, receivers=2)
    labels = torch.where(query.receivers == 1, values + 10 * (labels - values), labels)
    calibration = Calibration.of(kind, labels, values, torch.ones(400), query, None, query[:1])
    estimate = calibration.estimate(values[:2], torch.ones(2), query[:2], 0.9)
    widths = estimate.upper - estimate.lower
    assert widths[1] > 5 * widths[0]
    few = slice(0, 180)
    pooled = Calibration.of(
        kind, labels[few], values[few], torch.ones(180), query[few], None, query[:1]
    )
    estimate = pooled.estimate(values[:2], torch.ones(2), query[:2], 0.9)
    torch.testing.assert_close(*(estimate.upper - estimate.lower))


def test_intervals_widen_with_the_distance_to_known_places():
    kind, labels, values, query = made("rssi", 400)
    known = Query(torch.zeros(1, 3), torch.zeros(1, dtype=torch.long))
    apart = query.transmitters.norm(dim=1)
    labels = values + apart * (labels - values)
    calibration = Calibration.of(
        kind, labels, values, torch.ones(400), query, apart.double(), known
    )
    at = Query(torch.tensor([[0.5, 0.0, 0.0], [30.0, 0.0, 0.0]]), torch.zeros(2, dtype=torch.long))
    near, far = (x for x in calibration.estimate(torch.zeros(2), torch.ones(2), at, 0.9).upper)
    assert far > near


def test_intervals_do_not_narrow_with_the_distance_to_known_places():
    """Errors that fall with it are those of other regions, or chance: no model is surer of what it
    has not seen.
    """
    kind, labels, values, query = made("rssi", 400)
    known = Query(torch.zeros(1, 3), torch.zeros(1, dtype=torch.long))
    apart = query.transmitters.norm(dim=1)
    labels = values + (labels - values) / apart
    calibration = Calibration.of(
        kind, labels, values, torch.ones(400), query, apart.double(), known
    )
    assert len(calibration.counts) == 1


def test_a_models_own_deviation_scales_the_interval():
    kind, labels, values, query = made("rssi", 200)
    deviations = 1 + query.transmitters[:, 0]
    labels = values + deviations * (labels - values)
    calibration = Calibration.of(kind, labels, values, deviations, query, None, query[:1])
    found = calibration.estimate(values[:2], torch.tensor([1.0, 3.0]), query[:2], 0.9)
    assert (found.upper - found.value)[1] == pytest.approx(
        3 * (found.upper - found.value)[0].item(), rel=1e-4
    )
    assert found.std[1] == pytest.approx(3 * found.std[0].item())


def test_amplitudes_are_not_negative_and_larger_ones_err_more():
    kind, labels, values, query = made("spectrum", 100)
    labels = (values + values * (labels - values)).clamp_min(0)
    calibration = Calibration.of(kind, labels, values, torch.ones(100), query, None, query[:1])
    found = calibration.estimate(values, torch.ones(100), query, 0.9)
    assert found.lower.min() == 0
    half = found.upper - found.value
    assert half[values > 0.9].mean() > 3 * half[values < 0.1].mean()


def test_a_direction_asked_alone_has_the_interval_that_it_has_beside_others():
    links = example_links("spectrum")
    model = gaigs.train("knn", links)
    alone, both = (
        model.predict(
            [1.0, 1.0, 1.0], directions=Rays(torch.tensor(up), torch.tensor(round_)), interval=0.8
        ).upper
        for up, round_ in (([0.3], [1.0]), ([0.3, 0.7], [1.0, 2.0]))
    )
    torch.testing.assert_close(alone[..., 0], both[..., 0])


@pytest.mark.parametrize("count", [10, 20])
def test_pixels_of_a_bin_that_err_together_count_as_few_numbers(count):
    """Links with one amplitude each, so that a bin has pixels of few links."""
    kind = example_links("spectrum").task
    held = []
    for seed in range(30):
        generator = torch.Generator().manual_seed(seed)
        values = torch.rand(220, 1, 1, generator=generator).expand(-1, *kind.shape)
        scales = torch.rand(220, 1, 1, generator=generator).reciprocal().sqrt()
        labels = values + 0.1 * scales * torch.randn(220, *kind.shape, generator=generator)
        query, ones = Query(torch.rand(220, 3), torch.zeros(220, dtype=torch.long)), torch.ones(220)
        few, new = slice(0, count), slice(count, None)
        calibration = Calibration.of(
            kind, labels[few], values[few], ones[few], query[few], None, query[:1]
        )
        estimate = calibration.estimate(values[new], ones[new], query[new], 0.9)
        estimate = estimate._replace(lower=2 * values[new] - estimate.upper)
        held.append(interval_scores(labels[new], estimate, estimate)["coverage_90"].mean().item())
    assert abs(np.mean(held) - 0.9) < 0.02


def test_discs_and_the_expected_snr_of_channels():
    kind, labels, values, query = made("csi", 300, size=0.1)
    held = slice(0, 40)  # too few for groups of distances: the calibration's own links may be asked
    calibration = Calibration.of(
        kind, labels[held], values[held], torch.ones(40), query[held], None, query[:1]
    )
    labels, values, query = labels[held], values[held], query[held]
    found = calibration.estimate(values, torch.ones(40), query, 0.9)
    assert (found.lower, found.upper) == (None, None)
    inside = ((labels - values).abs() <= found.radius).double().mean()
    assert inside == pytest.approx(0.9 * 41 / 40, abs=0.01)
    errors = (labels - values).abs().double().square()
    expected = 10 * (values.abs().double().square().mean() / errors.mean()).log10()
    assert found.snr_db.double().mean() == pytest.approx(expected.item(), abs=0.5)


def test_scores_are_those_of_the_normal_distribution():
    labels, value, std = (
        torch.tensor([1.0, -2.0]),
        torch.tensor([0.5, 3.0]),
        torch.tensor([0.7, 2.0]),
    )
    estimate = Estimate(value, std, value - 1, value + 1)
    found = interval_scores(labels, estimate, estimate._replace(lower=value - 6, upper=value + 6))
    assert found["coverage_50"].tolist() == [1, 0]
    assert found["coverage_90"].tolist() == [1, 1]
    assert found["width_90"].tolist() == [12, 12]
    for i in range(2):
        normal = stats.norm(value[i].item(), std[i].item())

        def steps(x, i=i, normal=normal):
            return (normal.cdf(x) - (x >= labels[i].item())) ** 2

        expected, _ = quad(steps, -30, 30, points=[labels[i].item(), value[i].item()], limit=200)
        assert found["crps"][i].item() == pytest.approx(expected, rel=1e-5)
        assert found["nll"][i].item() == pytest.approx(-normal.logpdf(labels[i].item()), rel=1e-6)
    numbers = summarise_intervals(
        {**found, "calibration_links": torch.tensor([2.0, 2.0]), "places": torch.arange(2)}
    )
    assert (numbers["coverage_50"], numbers["coverage_50_error"]) == (0.5, pytest.approx(0.5**0.5))


def test_readings_of_one_place_count_as_one_where_they_err_together():
    generator = torch.Generator().manual_seed(0)
    places = torch.arange(400).repeat_interleave(4)

    def error(inside):
        scores = {
            "coverage_90": inside.double(),
            "calibration_links": torch.full((1600,), 1e9),
            "places": places,
        }
        return summarise_intervals(scores)["coverage_90_error"]

    alone = torch.rand(1600, generator=generator) < 0.9
    together = (torch.rand(400, generator=generator) < 0.9).repeat_interleave(4)
    assert error(alone) == pytest.approx(0.3 / 40, rel=0.15)
    assert error(together) == pytest.approx(0.3 / 20, rel=0.15)
    assert error(torch.ones(1600)) == pytest.approx(0.3 / 20)  # no scatter is no certainty


def test_each_place_calibrates_once_however_often_it_is_read():
    """A robot's run of 60 places, with half of the readings at one of them, and shadowing of each
    place.
    """
    held = []
    for seed in range(12):
        generator = torch.Generator().manual_seed(seed)
        places = 10 * torch.rand(260, 3, generator=generator)
        shadows = 6 * torch.randn(260, generator=generator) - 60
        readings = torch.ones(60, dtype=torch.long).index_fill(
            0, torch.randint(60, (1,), generator=generator), 60
        )
        place = torch.arange(60).repeat_interleave(readings)
        levels = shadows[place] + torch.randn(len(place), generator=generator)
        links = gaigs.links(
            task="rssi",
            transmitters=places[place],
            receivers=[0, 0, 3],
            labels=levels,
            split="random",
            seed=seed,
        )
        model = gaigs.train("mean", links)
        assert model.calibration.counts.sum() == len(
            links.query[links.split.known].place_keys.unique()
        )
        found = model.predict(places[60:], interval=0.9)
        held.append(
            ((found.lower <= shadows[60:]) & (shadows[60:] <= found.upper)).double().mean().item()
        )
    assert min(held) > 0.75
    assert np.mean(held) > 0.87


def test_the_places_of_test_links_are_theirs():
    links = gaigs.links("synthetic_rssi", transmitters=100, order=0)
    assert len(links.receivers) > 1
    found = gaigs.evaluate(gaigs.train("mean", links), links, []).scores["mean"]["interval_places"]
    same = links.query.transmitters[links.split.test]
    assert torch.equal(found[:, None] == found, (same[:, None] == same).all(-1))


def test_intervals_of_few_numbers_have_the_shares_of_all():
    """Labels of more numbers than count: an unknown phase is that of all, and no row or column is
    left out.
    """
    frequencies = np.linspace(2.4e9, 2.48e9, 256)
    task = Csi(64, frequencies, "per_link")
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(80, 64, 256, dtype=task.dtype, generator=generator)
    sizes = torch.where((torch.arange(256) % 16 - 8).abs() < 5, 1.0, 0.1)
    labels = values + sizes * torch.randn(80, 64, 256, dtype=task.dtype, generator=generator)
    labels = (
        labels * torch.polar(torch.ones(80), 6 * torch.rand(80, generator=generator))[:, None, None]
    )
    query, ones = Query(torch.rand(80, 3), torch.zeros(80, dtype=torch.long)), torch.ones(80)
    calibration = Calibration.of(task, labels, values, ones, query, None, query[:1])
    for level in (0.5, 0.9):
        estimate = calibration.estimate(values, ones, query, level)
        share = (
            interval_scores(task.align(labels, values), estimate, estimate)["coverage_90"]
            .mean()
            .item()
        )
        assert share == pytest.approx(level, abs=0.04)


def test_distances_are_those_to_the_same_receivers_places():
    places, receivers = torch.tensor([[0.0, 0, 0], [1, 0, 0]]), torch.tensor([0, 1])
    query = Query(torch.tensor([[0.0, 2, 0], [0.0, 2, 0], [0, 0, 0]]), torch.tensor([0, 1, 2]))
    assert nearest(query, places, receivers).tolist() == [2, pytest.approx(5**0.5), math.inf]


# --- models ---


@TASKS
@pytest.mark.parametrize("name", ["mean", "knn", "gaussian_process", "gaigs"])
def test_trained_models_and_look_ups_have_intervals(task, name, tmp_path):
    links = example_links(task)
    few = (
        {"enable_progress_bar": False, "max_steps": 2, "count": 10, "accelerator": "cpu"}
        if name == "gaigs"
        else {}
    )
    links = replace(
        links,
        split=Split(
            "halves", *torch.arange(len(links)).split((len(links) // 2, len(links) // 2 - 2, 2))
        ),
    )
    model = gaigs.train(name, links, **few)
    places = BOX * torch.rand(2, 1, 3)
    found, narrow = model.predict(places, interval=0.8), model.predict(places, interval=0.4)
    assert torch.equal(found.value, model.predict(places))
    axes = (2, 1, len(links.receivers))
    assert found.std.shape == found.value.shape == (*axes, *links.task.shape)
    if task == "csi":
        assert (narrow.radius <= found.radius).all()
        assert found.snr_db.shape == axes
    else:
        assert (found.lower <= narrow.lower).all()
        assert (narrow.upper <= found.upper).all()
    model.save(tmp_path / "model.ckpt")
    again = gaigs.load(tmp_path / "model.ckpt").predict(places, interval=0.8)
    for a, b in zip(found, again, strict=True):
        assert a is b is None or torch.equal(a, b)


@pytest.mark.parametrize("validation", [0.0, 0.1])
def test_look_ups_are_calibrated_by_all_known_links(validation):
    links = gaigs.links("synthetic_rssi", transmitters=300, order=0, validation=validation)
    model = gaigs.train("knn", links)
    assert model.calibration.counts.min() >= 50, "groups of distances are of other folds' places"
    assert model.calibration.edges.min() > 0
    known = links.query.transmitters[links.split.train[:1]]
    near, far = (model.predict(place, interval=0.9).std for place in (known, [10.0, 2.0, 1.5]))
    assert (far > near).all()
    scores = gaigs.evaluate(model, links, baselines=["mean"]).models
    assert abs(scores["knn"]["coverage_90"] - 0.9) < 0.06
    assert scores["mean"]["calibration_links"] > 900


@pytest.mark.parametrize("data", ["synthetic_rssi", "synthetic_csi"])
def test_folds_state_deviations_with_the_hyperparameters_of_all_links(monkeypatch, data):
    links = gaigs.links(data, transmitters=30, order=0)
    model, spreads, stating = gaigs.train("gaussian_process", links), answers.spreads, []
    monkeypatch.setattr(
        answers, "spreads", lambda one, *rest: stating.append(one) or spreads(one, *rest)
    )
    answers.calibrated(model, links)
    assert len(stating) == 5
    for one in stating:
        if one.scalar is None:
            assert one.process == model.process
        else:
            whole = model.scalar.logarithms
            torch.testing.assert_close(one.scalar.logarithms, whole, rtol=0, atol=0)


@pytest.mark.usefixtures("quick")
def test_halves_state_deviations_with_the_hyperparameters_of_all_links(monkeypatch):
    links = gaigs.links("synthetic_rssi", transmitters=60, order=0, validation=0.3)
    model, spreads, stating = (
        Kriging(links.scene, barely_trained(links)).krige(links),
        answers.spreads,
        [],
    )
    monkeypatch.setattr(
        answers, "spreads", lambda one, *rest: stating.append(one) or spreads(one, *rest)
    )
    answers.calibrated(model, links)
    assert len(stating) == 2
    for one in stating:
        found, whole = (each.posterior.process.logarithms for each in (one, model))
        torch.testing.assert_close(found, whole, rtol=0, atol=0)


@pytest.mark.parametrize(("level", "need"), [(0.9, 9), (0.8, 4), (0.5, 1), (0.99, 99)])
def test_as_many_links_as_a_level_needs_are_enough(level, need):
    kind, labels, values, query = made("rssi", need)
    calibration = Calibration.of(kind, labels, values, torch.ones(need), query, None, query[:1])
    assert calibration.gives(level)
    calibration.estimate(values, torch.ones(need), query, level)
    if need > 1:
        few = slice(0, need - 1)
        fewer = Calibration.of(
            kind, labels[few], values[few], torch.ones(need)[few], query[few], None, query[:1]
        )
        assert not fewer.gives(level)


def test_intervals_that_the_links_cannot_give_are_refused():
    links = example_links("rssi")
    none = replace(links, split=replace(links.split, validation=links.split.validation[:0]))
    few = {"enable_progress_bar": False, "max_steps": 1, "count": 10, "accelerator": "cpu"}
    model = gaigs.train("gaigs", none, **few)
    with pytest.raises(ValueError, match="no held-out links have measured its errors"):
        model.predict([1.0, 1.0, 1.0], interval=0.9)
    model = gaigs.train("knn", links)
    with pytest.raises(
        ValueError, match=r"99.9 % needs 999 links to calibrate it, the model has \d+"
    ):
        model.predict([1.0, 1.0, 1.0], interval=0.999)
    for wrong in (0.0, 1.0, 90):
        with pytest.raises(ValueError, match="interval must be a probability"):
            model.predict([1.0, 1.0, 1.0], interval=wrong)


@pytest.fixture
def quick(monkeypatch):
    options = ScalarOptions(neighbours=4, iterations=2)
    monkeypatch.setattr(ScalarProcess, "options", options)


def barely_trained(links):
    return gaigs.train(
        "gaigs",
        links,
        enable_progress_bar=False,
        max_steps=1,
        count=10,
        accelerator="cpu",
        kriging=False,
    )


@pytest.mark.usefixtures("quick")
def test_the_links_that_calibrate_kriging_did_not_choose_its_weights(monkeypatch):
    links = gaigs.links("synthetic_rssi", transmitters=60, order=0, validation=0.3)
    trend = barely_trained(links)
    chosen, predicted = [], []
    krige, predict = Kriging.krige, answers.predicted
    monkeypatch.setattr(
        Kriging, "krige", lambda *a, **k: chosen.append(a[1].split.validation) or krige(*a, **k)
    )

    def record(model, links, index):
        if isinstance(model, Kriging):
            predicted.append(index)
        return predict(model, links, index)

    monkeypatch.setattr(answers, "predicted", record)
    monkeypatch.setattr(answers, "at_new_receivers", lambda *_: None)  # by the trend alone
    kriged = Kriging(links.scene, trend)
    calibration = answers.calibrated(kriged.krige(links), links)
    assert torch.equal(chosen[0], links.split.validation)
    assert len(chosen) == 3
    assert calibration.counts.sum() == len(links.split.validation)
    assert torch.equal(torch.cat(predicted).sort().values, links.split.validation.sort().values)
    for own, other in zip(chosen[1:], predicted, strict=True):
        assert not torch.isin(own, other).any()
        places = links.query.transmitters
        assert not (places[own][:, None] == places[other]).all(-1).any(), "halves share no place"


@pytest.mark.usefixtures("quick")
def test_validation_links_that_chose_nothing_calibrate_kriging_as_it_is(monkeypatch):
    links = gaigs.links("synthetic_rssi", transmitters=400, order=0, validation=0.5)
    kriged = Kriging(links.scene, barely_trained(links))
    model = kriged.krige(links)
    monkeypatch.setattr(Kriging, "krige", None)
    (one,) = model.unseen(links, enough=100, most=150)
    held = links.split.validation
    assert one.model is model
    assert len(one.asked) == 150
    assert torch.isin(one.asked, held).all()
    assert torch.isin(model.chosen_by, held).any()
    assert not torch.isin(one.asked, model.chosen_by).any()
    assert kriged.chosen_by is None, "it has learnt from all validation links"


@pytest.mark.parametrize(
    ("count", "level", "held"), [(9, 0.5, 5), (19, 0.9, 18), (19, 0.8, 16), (37, 0.9, 35)]
)
def test_an_interval_of_few_links_ends_at_the_error_of_its_rank(count, level, held):
    kind = example_links("rssi").task
    query, ones = (
        Query(torch.zeros(count, 3), torch.zeros(count, dtype=torch.long)),
        torch.ones(count),
    )
    errors = torch.arange(1.0, count + 1)
    calibration = Calibration.of(kind, errors, torch.zeros(count), ones, query, None, query[:1])
    assert calibration.estimate(torch.zeros(1), ones[:1], query[:1], level).upper.item() == held


def test_a_receiver_that_one_place_hears_leaves_the_others_their_intervals():
    full = gaigs.links("synthetic_rssi", transmitters=40, order=0)
    stand = torch.stack([receiver.pose.position for receiver in full.receivers])
    labels = torch.full((40, len(stand)), math.nan)
    places, which = full.query.transmitters.unique(dim=0, return_inverse=True)
    labels = labels[: len(places)].index_put(
        (which, full.query.receivers), full.labels[torch.arange(len(full))]
    )
    labels[1:, -1] = math.nan
    links = gaigs.links(
        task="rssi",
        transmitters=places,
        receivers=stand,
        labels=labels,
        split="random",
        test=0.0,
        seed=0,
    )
    calibration = gaigs.train("knn", links).calibration
    assert calibration.counts.sum() == len(links) - 1


@pytest.mark.usefixtures("quick")
def test_kriging_does_not_know_a_single_group_of_validation_links():
    links = gaigs.links("synthetic_rssi", transmitters=40, order=0)
    alone = (
        (links.query.transmitters == links.query.transmitters[links.split.validation[0]])
        .all(1)
        .nonzero()[:, 0]
    )
    links = replace(links, split=links.split.only(links.split.train).choosing(alone))
    kriged = Kriging(links.scene, barely_trained(links))
    kriged.krige(links)
    ((model, part, known),) = kriged.unseen(links)
    assert torch.equal(part, alone)
    assert len(model.posterior.process.values) == len(known) == len(links.split.train)


def test_elements_that_an_array_lacks_have_no_intervals_and_count_in_none(tmp_path):
    frequencies, rng = np.linspace(2.4e9, 2.48e9, 5), np.random.default_rng(0)
    places = rng.uniform([0.5, 0.5, 0.5], [6, 4, 2], (150, 3))

    def pose(x):
        return Pose(torch.tensor([x, 2.0, 1.5]), torch.eye(3))

    receivers = [
        Receiver("four", pose(6.4), Array.planar(2, 2, 0.06)),
        Receiver("one", pose(0.2), Array.single()),
    ]
    labels = np.zeros((150, 2, 4, 5), complex)
    for number, receiver in enumerate(receivers):
        stand = (receiver.pose.position + receiver.array.elements).numpy()
        for image, gain in ((places, 1.0), (places * [-1, 1, 1], -0.5)):
            lengths = np.linalg.norm(image[:, None] - stand, axis=-1)[..., None]
            labels[:, number, : len(stand)] += (
                gain / lengths * np.exp(-2j * np.pi * frequencies / 3e8 * lengths)
            )
    # In the order of the receivers: batches then have links of one array alone.
    rows, index = np.tile(np.arange(150), 2), np.arange(2).repeat(150)
    links = {
        "transmitters": places[rows],
        "receivers": receivers,
        "labels": labels[rows, index],
        "index": index,
    }
    links = gaigs.links(task=Csi(4, frequencies), **links)
    model, test = gaigs.train("friis", links), links.split.test
    found, held = model.predict(links.query[test], interval=0.9), []
    for number, count in enumerate((4, 1)):
        own = links.query.receivers[test] == number
        inside = (links.labels[test] - found.value).abs() <= found.radius
        held += inside[own][:, :count].flatten(1).double().mean(1).tolist()
        assert found.radius[own][:, count:].isnan().all()
        assert found.snr_db[own].isfinite().all()
        assert inside[own][:, :count].double().mean() > 0.75, "it was 0 at the single antenna"
    model.deviations = lambda batch: torch.ones(
        len(batch.query)
    )  # over four elements, of which one array lacks three
    batch = links.batch(test)
    spread, own = model.spread(batch, model.evaluate(batch))[:, 0, 0], batch.query.receivers
    torch.testing.assert_close(spread, torch.tensor([1.0, 2.0])[own])
    del model.deviations
    scores = gaigs.evaluate(model, links).scores["friis"]
    torch.testing.assert_close(scores["interval_coverage_90"].mean().item(), np.mean(held))
    evaluation.score({"friis": model}, {}, links, tmp_path)
    right = intervals(tmp_path, links.task, "random").axes[1].lines[0].get_xydata()
    assert np.isfinite(right).all()
