"""The choice of a model by validation links, from Python and as a run."""

import json
import logging
from dataclasses import replace

import numpy as np
import pytest
import torch

import gaigs
from gaigs.kriging.links import folds_of
from gaigs.kriging.scalar import ScalarProcess
from gaigs.kriging.scalar_fit import ScalarOptions
from gaigs.runs import choice
from gaigs.runs.choice import Tried, pick
from gaigs.runs.stacking import stack
from gaigs.training.descent import Descent

pytestmark = pytest.mark.usefixtures("unchecked")

BRIEF = {"max_steps": 2, "val_check_interval": 1, "enable_progress_bar": False}
SMALL = "data.transmitters=40", "data.order=0"


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(ScalarProcess, "options", ScalarOptions(neighbours=8))


@pytest.fixture(scope="module")
def links():
    return gaigs.links("synthetic_rssi", transmitters=40, order=0)


def tried(**gains):
    """Candidates with a score at each of some places."""
    found = []
    for name, values in gains.items():
        places = dict(enumerate(values))
        found.append(Tried(name, {"model": {"name": name}}, None, places, 0.0))
    return found


@pytest.mark.parametrize(
    ("simple", "complex_", "chosen"),
    [
        ([1.0, 2, 3, 4], [1.5, 2.5, 3.5, 4.4], "complex"),  # paired: places scatter, gains do not
        ([1.0, 2, 3, 4], [5.0, 0, 3, 2.1], "simple"),  # ahead by less than its error
        ([1.0, 2, 3, 4], [0.5, 2, 3, 4], "simple"),
        ([1.0], [1.1], "complex"),  # one place tells no scatter
    ],
)
def test_the_simplest_within_a_standard_error_is_chosen(simple, complex_, chosen):
    task = gaigs.registries["task"].build({"name": "rssi"})
    assert pick(tried(simple=simple, complex=complex_), task).chosen.label == chosen


def test_a_candidate_that_any_other_surely_leads_is_out():
    task = gaigs.registries["task"].build({"name": "rssi"})
    # The best mean scatters so much that the first is level with it, but behind the second.
    three = tried(first=[1.0, 2, 3], second=[1.5, 2.6, 3.4], third=[0.0, 0, 9])
    assert pick(three, task).chosen.label == "second"
    assert pick(three[::2], task).chosen.label == "first"


def test_only_places_that_all_have_count():
    task = gaigs.registries["task"].build({"name": "rssi"})
    one, other = tried(one=[-1.0, -1.0, -9.0], other=[-2.0, -2.0])
    result = pick([one, other], task)
    assert result.chosen.label == "one"
    assert "mean mae_db over 2 places: one 1, other 2" in result.reason


@pytest.mark.parametrize("number", [float("nan"), float("inf"), -float("inf")])
def test_scores_that_are_not_finite_lose(number):
    task = gaigs.registries["task"].build({"name": "rssi"})
    broken, whole = tried(broken=[-1.0, number, -1.0], whole=[-2.0, -2.0, -3.0])
    for pair in ([broken, whole], [whole, broken]):
        result = pick(pair, task)
        assert result.chosen.label == "whole"
        assert [one.label for one in result.level] == ["whole"]


def test_shares_are_those_of_least_squares():
    generator = np.random.default_rng(0)
    common = generator.normal(size=4000)
    labels = 10 * generator.normal(size=4000)
    one, other = (common + size * generator.normal(size=4000) for size in (1.0, 2.0))
    values = [torch.from_numpy(labels + error) for error in (one, other)]
    places = torch.arange(4000)
    shares, crossed = stack(torch.from_numpy(labels), values, places, places % 4)
    tried = np.arange(11) / 10
    best = tried[np.argmin([np.mean((w * one + (1 - w) * other) ** 2) for w in tried])]
    assert 0.6 < best < 1.0
    np.testing.assert_allclose(shares, [best, 1 - best])
    np.testing.assert_allclose(crossed[0], best, atol=0.11)
    # A worse copy of another model has no share.
    shares, _ = stack(torch.from_numpy(labels), [values[0], values[0] + 3], places, places % 4)
    np.testing.assert_allclose(shares, [1, 0], atol=1e-12)


def test_channels_of_zeros_have_no_say_in_shares():
    labels = torch.tensor([1.0, 1j, 0.0, 0.0])
    values = [labels + torch.tensor([0.1, 0.1, 9, 9]), labels - torch.tensor([1.0, 1.0, 0, 0])]
    shares, _ = stack(labels, values, torch.arange(4), torch.arange(4))
    assert shares[0] > 0.8


def test_shares_without_a_fold_do_not_know_its_labels():
    labels = torch.zeros(4)
    values = [torch.tensor([0.0, 9, 9, 9]), torch.tensor([9.0, 0, 0, 0])]
    places = torch.arange(4)
    _, crossed = stack(labels, values, places, places)
    changed = [values[0].index_fill(0, places[:1], 50.0), values[1]]
    _, other = stack(labels, changed, places, places)
    torch.testing.assert_close(other[:, 0], crossed[:, 0])
    assert (other[:, 1:] != crossed[:, 1:]).all()


def test_a_blend_is_judged_by_folds(links, monkeypatch):
    # Errors of the first and the second model, and the shares of the first, in ten folds.
    one, other, crossed = torch.tensor(
        [[1.0, 2.0, 0.0]] * 5 + [[1.0, 2.0, 1.0]] + [[2.5, 1.0, 1.0]] * 2 + [[2.5, 1.0, 0.0]] * 2
    ).T
    asked = links.split.known
    folds = folds_of(links, asked)
    shares = torch.stack((crossed, 1 - crossed))[:, folds]
    monkeypatch.setattr(choice, "stack", lambda *_: (torch.tensor([0.5, 0.5]), shares))
    two = [
        choice._scored(candidate, links, asked, links.labels[asked] + errors[folds])
        for candidate, errors in zip(tried(one=[], other=[]), (one, other), strict=True)
    ]
    # The blend is behind by 0.2 dB, more than a standard error over places, less than over folds.
    assert choice.settle(two, links).chosen.weights == (0.5, 0.5)


def level(monkeypatch, shares=(0.7, 0.3)):
    """Makes all candidates level, and their shares known."""
    monkeypatch.setattr(choice, "pick", lambda tried, *_: choice.ChosenModel(tried[0], "", tried))
    fixed = torch.tensor(shares, dtype=torch.float64)
    monkeypatch.setattr(
        choice, "stack", lambda labels, *_: (fixed, fixed[:, None].expand(-1, len(labels)))
    )


def test_level_look_ups_are_averaged(links, tmp_path, monkeypatch):
    level(monkeypatch)
    model = gaigs.train(links, folder=tmp_path, candidates=["knn", "gaussian_process"])
    asked = links.query[links.split.test]
    parts = [gaigs.train(name, links) for name in ("knn", "gaussian_process")]
    expected = 0.7 * parts[0].predict(asked).numpy() + 0.3 * parts[1].predict(asked).numpy()
    np.testing.assert_allclose(model.predict(asked), expected, rtol=1e-5)
    loaded = gaigs.load(tmp_path)
    for own, other in zip(
        model.predict(asked, interval=0.8), loaded.predict(asked, interval=0.8), strict=True
    ):
        torch.testing.assert_close(own, other)
    low, high = model.predict(asked, interval=0.8)[2:4]
    labels = links.labels[links.split.test]
    assert 0.6 < ((low <= labels) & (labels <= high)).float().mean() < 0.97
    # The process states deviations, the neighbours do not.
    batch = links.batch(links.split.test)
    torch.testing.assert_close(model.deviations(batch), parts[1].deviations(batch))
    assert model.process_at(0) is not None
    assert not model.any_receiver
    with pytest.raises(ValueError, match="'knn' predicts for its own receivers alone"):
        model.predict(asked.transmitters, receiver=[1.0, 2.0, 1.5])


def test_a_blend_with_a_trained_model_costs_no_training_again(links, tmp_path, monkeypatch):
    level(monkeypatch)
    names = ["path_loss", "mirrored"]
    words = "model=auto", "data=synthetic_rssi", "baselines=[mean]", *SMALL
    trainer = [f"trainer.{key}={value}".replace("False", "false") for key, value in BRIEF.items()]
    config = gaigs.compose(*words, f"model.candidates=[{','.join(names)}]", *trainer)
    metrics = gaigs.run(config, tmp_path)
    assert [*metrics["models"]] == ["auto", "mean"]
    assert metrics["auto"]["chosen"] == "0.7 path_loss + 0.3 mirrored"
    assert metrics["auto"]["weights"] == pytest.approx({"path_loss": 0.7, "mirrored": 0.3})
    assert metrics["models"]["auto"]["calibration_links"] > 0
    model = gaigs.load(tmp_path)
    asked = links.query[links.split.test]
    members = [gaigs.load(tmp_path / f"candidates/{number}/best.ckpt") for number in "01"]
    expected = 0.7 * members[0].predict(asked) + 0.3 * members[1].predict(asked)
    torch.testing.assert_close(model.predict(asked), expected)
    # Its room is that of the trained member, and it moves to other receivers as its members do.
    assert type(model.underlying) is type(members[1])
    place = [[1.0, 2.0, 1.5]]
    door = gaigs.Receiver("door", gaigs.Pose.at([3.0, 0.2, 2.0]))
    moved = [one.predict(place, receiver=door) for one in (model, *members)]
    torch.testing.assert_close(moved[0], 0.7 * moved[1] + 0.3 * moved[2])
    # Links that no member has seen: the look-up is fitted without the validation links.
    for unseen in model.unseen(links):
        assert torch.isin(unseen.asked, links.split.validation).all()
        law = gaigs.registries["model"].build("path_loss", scene=links.scene)
        law.fit(replace(links, split=links.split.validating()))
        own = unseen.model.members[0]
        torch.testing.assert_close(own.predict(asked), law.predict(asked))


def test_channels_of_unknown_phase_are_not_averaged(monkeypatch):
    level(monkeypatch)
    for phase, name in {"known": "ensemble", "per_link": "friis"}.items():
        links = gaigs.links("synthetic_csi", transmitters=20, order=0)
        task = gaigs.registries["task"].build(
            {"name": "csi"}, **links.scene.task.options() | {"phase": phase}
        )
        links = replace(links, task=task)
        model = gaigs.train(links, candidates=["friis", "knn"])
        assert model.configuration["name"] == name


def test_links_alone_are_enough(links, tmp_path, capsys, caplog):
    caplog.set_level(logging.WARNING, "gaigs")  # as in Python
    options = {"candidates": ["path_loss", "knn"]}
    model = gaigs.train(links, "seed=0", folder=tmp_path, **options)
    assert "auto: " in capsys.readouterr().out
    name = model.configuration["name"]
    alone = gaigs.train(name, links)
    asked = links.query[links.split.test]
    # The chosen one has learnt from the validation links too.
    assert torch.equal(model.predict(asked), alone.predict(asked))
    assert torch.equal(gaigs.load(tmp_path / "best.ckpt").predict(asked), alone.predict(asked))
    assert torch.equal(gaigs.load(tmp_path).predict(asked), alone.predict(asked))
    assert model.predict([1.0, 2.0, 1.5], interval=0.9)[2].shape == (4,)


def test_a_run_has_a_row_and_says_why(tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(choice, "pick", lambda tried, _: choice.ChosenModel(tried[-1], "last"))
    caplog.set_level(logging.INFO)
    words = "model=auto", "data=synthetic_rssi", "baselines=[mean]", *SMALL
    candidates = "model.candidates=[path_loss,{name: knn, k: 2},mirrored]"
    trainer = [f"trainer.{key}={value}".replace("False", "false") for key, value in BRIEF.items()]
    metrics = gaigs.run(gaigs.compose(*words, candidates, *trainer), tmp_path)
    assert [*metrics["models"]] == ["auto", "auto_trend", "mean"]
    facts = json.loads((tmp_path / "metrics.json").read_text())["auto"]
    assert [*facts["candidates"]] == ["path_loss", "knn, k=2", "mirrored"]
    assert facts["chosen"] == "mirrored"
    assert facts["candidates"]["knn, k=2"]["places"] > facts["candidates"]["mirrored"]["places"]
    assert f"auto: {facts['reason']}" in caplog.text
    assert "auto" in metrics["validation"]
    assert gaigs.load(tmp_path).calibration is not None


def test_a_trained_choice_is_that_of_its_own_run(links, tmp_path, monkeypatch):
    monkeypatch.setattr(choice, "pick", lambda tried, _: choice.ChosenModel(tried[-1], "last"))
    model = gaigs.train(links, folder=tmp_path, candidates=["path_loss", "gaigs"], **BRIEF)
    alone = gaigs.train("gaigs", links, **BRIEF)
    asked = links.query[links.split.test]
    torch.testing.assert_close(model.predict(asked), alone.predict(asked))
    assert torch.equal(gaigs.load(tmp_path).predict(asked), model.predict(asked))
    assert (tmp_path / "log").is_dir()
    # The same call goes on: nothing is trained twice.
    monkeypatch.setattr(Descent, "training_step", lambda *_: pytest.fail("trained"))
    again = gaigs.train(links, folder=tmp_path, candidates=["path_loss", "gaigs"], **BRIEF)
    torch.testing.assert_close(again.predict(asked), model.predict(asked))
    with pytest.raises(ValueError, match="max_steps was 2, is 3"):
        gaigs.train(
            links, folder=tmp_path, candidates=["path_loss", "gaigs"], **BRIEF | {"max_steps": 3}
        )


def test_candidates_without_time_are_left_out(links, caplog, monkeypatch):
    options = {"candidates": ["path_loss", "mirrored"], "enable_progress_bar": False}
    monkeypatch.setattr(choice, "seconds", lambda *_: 0.0)
    model = gaigs.train(links, **options)
    assert model.configuration["name"] == "path_loss"
    assert "model=auto has not tried mirrored" in caplog.text


def test_a_candidate_that_fails_is_left_out(links, caplog):
    rates = {"training.learning_rates.network": 1e30}
    model = gaigs.train(links, candidates=["knn", "gaigs"], **rates, **BRIEF | {"max_steps": 20})
    assert model.configuration["name"] == "knn"
    assert "auto: gaigs is left out: " in caplog.text


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"candidates": []}, "candidates must have a model or more, got none"),
        ({"candidates": ["knm"]}, "there is no model 'knm' .did you mean 'knn'"),
        ({"candidates": ["friis"]}, "friis"),
        ({"candidates": ["auto"]}, "must be names or configurations of models, got 'auto'"),
        ({"candidates": [{"name": "knn", "kk": 3}]}, "kk"),
        ({"candidate": ["knn"]}, "candidate"),
        ({"model.max_time": "soon"}, "model.max_time must be at least 1 s"),
        ({"tokenizer.octaves": [0, 1]}, "octaves"),
        ({"placement": "mirrored"}, "is an option of some models, and model=auto tries several"),
    ],
)
def test_mistakes_end_in_two_lines(links, options, message):
    with pytest.raises((ValueError, TypeError), match=message) as raised:
        gaigs.train("auto", links, **options)
    assert str(raised.value).count("\n") <= 1


def test_a_choice_needs_validation_links():
    links = gaigs.links("synthetic_rssi", transmitters=40, order=0, validation=0.0)
    with pytest.raises(ValueError, match="model=auto chooses by validation links"):
        gaigs.train(links)
