"""The choice of a model by validation links, from Python and as a run."""

import json
import logging

import pytest
import torch

import gaigs
from gaigs.kriging.scalar import ScalarProcess
from gaigs.kriging.scalar_fit import ScalarOptions
from gaigs.runs import choice
from gaigs.runs.choice import Tried, pick
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
    assert "mean mae_db at 2 places: one 1, other 2" in result.reason


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
