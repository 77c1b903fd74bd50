"""Bars of stages, and the limit of a whole run, by a clock that the test sets."""

import io
import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import rich
from rich.console import Console

import gaigs
from gaigs import runs
from gaigs.core import stages
from gaigs.kriging import scalar_fit
from gaigs.kriging.scalar import ScalarProcess
from gaigs.kriging.scalar_fit import ScalarOptions
from gaigs.model.answers import count_in_time
from gaigs.model.gaussian_process import GaussianProcess
from gaigs.model.kriging import Kriging
from gaigs.testing import example_links
from gaigs.training import budget


class Clock:
    """Goes on by ``step`` [s] whenever it is read."""

    def __init__(self, step=0.0):
        self.now, self.step = 0.0, step

    def monotonic(self):
        self.now += self.step
        return self.now


@pytest.fixture
def clock(monkeypatch):
    found = Clock()
    monkeypatch.setattr(stages, "time", found)
    monkeypatch.setattr(budget, "time", Clock(1.0))
    return found


class AtOnce:
    """A timer that does not wait."""

    def __init__(self, seconds, work):
        assert seconds == 1.0
        self.start, self.cancel = work, lambda: None


@pytest.fixture
def terminal(monkeypatch):
    found = Console(file=io.StringIO(), force_terminal=True, width=80)
    monkeypatch.setattr(rich, "get_console", lambda: found)
    monkeypatch.setattr(stages.threading, "Timer", AtOnce)
    return found


def test_open_stages_have_a_bar_each_with_an_estimate(terminal):
    with stages.watched() as watch, stages.stage("folds", 4) as folds:
        for number, _ in enumerate(stages.track(range(3), "kriging")):
            assert [(bar.description, bar.completed) for bar in watch.bars.tasks] == [
                ("folds", 0),
                ("kriging", number),
            ]
        folds.advance()
        (bar,) = watch.bars.tasks
        assert (bar.completed, bar.total, bar.fields["count"]) == (1, 4, "1/4")
    assert watch.bars is None
    assert watch.stages == []
    assert "-:--:--" in terminal.file.getvalue(), "time left"


@pytest.mark.parametrize(
    ("shown", "is_terminal", "name"), [(False, True, "a"), (True, False, "a"), (True, True, "")]
)
def test_bars_are_silent_where_nobody_reads_them(terminal, shown, is_terminal, name):
    terminal._force_terminal = is_terminal
    with stages.watched(shown=shown) as watch:
        for _ in stages.track(range(3), name):
            assert watch.bars is None
    assert terminal.file.getvalue() == ""


@pytest.mark.parametrize("progress", [True, False])
def test_progress_false_is_quiet(terminal, progress):
    links = example_links("rssi")
    model = gaigs.train("gaussian_process", links, progress=progress)
    gaigs.evaluate(model, links, ["knn"], progress=progress)
    gaigs.radio_map(model, pitch=0.5, progress=progress)
    gaigs.locate(model, links.labels[:2], links, progress=progress)
    gaigs.survey(model, count=3, progress=progress)
    assert ("places to measure" in terminal.file.getvalue()) == progress
    assert ("intervals" in terminal.file.getvalue()) == progress
    assert terminal.file.getvalue() or not progress


def test_bars_in_a_notebook_need_no_widgets(monkeypatch):
    notebook = Console(file=io.StringIO(), force_jupyter=True, width=80)
    monkeypatch.setattr(rich, "get_console", lambda: notebook)
    monkeypatch.setattr(stages.threading, "Timer", AtOnce)
    pages = []
    output = SimpleNamespace(update=lambda page, raw: pages.append(page["text/plain"]))
    shown = SimpleNamespace(display=lambda page, raw, display_id: output)
    monkeypatch.setattr(stages.importlib, "import_module", {"IPython.display": shown}.get)
    with stages.watched():
        for _ in stages.track(range(3), "kriging"):
            pass
    assert any("kriging" in page and "1/3" in page for page in pages)
    assert pages[-1].strip() == "", "a stage that has ended leaves nothing"


def test_a_stage_ends_at_its_share_of_the_limit(clock):
    assert math.isinf(stages.left())
    with stages.watched(100.0):
        with stages.stage(until=0.5), stages.stage(until=0.8):
            clock.now = 49.0
            assert (stages.left(), stages.is_up()) == (1.0, False)
            clock.now = 50.0
            assert stages.is_up()
        assert (stages.left(), stages.is_up()) == (50.0, False)
    assert math.isinf(stages.left())


def test_a_portion_ends_after_a_share_of_what_is_left(clock):
    with stages.portion(0.6):
        assert math.isinf(stages.left())  # no limit
    with stages.watched(100.0), stages.stage(until=0.5):
        clock.now = 10.0
        with stages.portion(0.6):
            assert stages.left() == pytest.approx(24.0)  # of 40
        assert stages.left() == pytest.approx(40.0)


def test_what_cannot_be_shortened_is_announced(clock, caplog):
    model = gaigs.train("mean", example_links("rssi"))
    for limit in (40.0, 20.0):
        with stages.watched(limit):
            for _ in model.predict_batches([[1.0, 2.0, 1.0]] * 8, batch_size=1):
                clock.now += 4.0
        assert [
            record.message for record in caplog.records if record.name == "gaigs.core.stages"
        ] == (
            []
            if limit == 40
            else ["predictions: 28 s more, which cannot be shortened; max_time leaves 16 s"]
        )


def test_a_fit_of_a_process_ends_with_its_stage(clock, monkeypatch):
    links, calls, one = example_links("rssi"), [], scalar_fit.conditional
    monkeypatch.setattr(scalar_fit, "conditional", lambda *parts: calls.append(0) or one(*parts))
    counts = []
    for limit in (math.inf, 1e9, 10.0):
        calls.clear()
        clock.now = 0.0
        with stages.watched(limit):
            clock.now = 11.0
            model = GaussianProcess(links.scene)
            model.fit(links)
        counts.append(len(calls))
        assert model.scalar.weights.isfinite().all()
    assert counts[0] == counts[1]
    assert counts[2] < counts[0] / 3


def test_kriging_takes_as_many_links_as_it_has_time_for(clock, monkeypatch):
    links = example_links("rssi")
    many = replace(links, split=replace(links.split, train=links.split.train.repeat(400)))
    model = Kriging(
        links.scene, gaigs.train("gaigs", links, max_steps=1, count=10, enable_progress_bar=False)
    )
    monkeypatch.setattr("gaigs.model.answers.time", Clock(64.0))  # a second a link
    assert count_in_time(model.trend, many, 6000) == 6000
    with stages.watched(9 * 250.0 * len(links.receivers)):
        assert count_in_time(model.trend, many, 6000) in (249, 250)


SMALL = (
    "+experiment=rssi", "data.transmitters=40", "data.order=0", "split.validation=0.3", "tokenizer=euclidean",
    "rasterizer=torch", "gaussians.count=10", "deformation.width=8", "trainer.accelerator=cpu", "trainer.max_steps=3",
    "trainer.val_check_interval=1", "trainer.enable_progress_bar=false", "baselines=[mean,gaussian_process]",
    "kriging=true",
)  # fmt: skip


@pytest.fixture(scope="module")
def unlimited(tmp_path_factory):
    folder = tmp_path_factory.mktemp("unlimited")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ScalarProcess, "options", ScalarOptions(neighbours=8, iterations=2))
        return folder, runs.run(gaigs.compose(*SMALL), folder)


def test_a_limit_that_is_far_changes_nothing(unlimited, clock, monkeypatch, tmp_path):
    monkeypatch.setattr(ScalarProcess, "options", ScalarOptions(neighbours=8, iterations=2))
    folder, before = unlimited
    metrics = runs.run(gaigs.compose(*SMALL, "max_time=00:01:00:00"), tmp_path)
    assert metrics["left_out"] == []
    assert {"max_time", "left_out"}.isdisjoint(before)
    for part in ("models", "validation"):
        assert metrics[part] == before[part]
    with (
        np.load(folder / "predictions.npz") as there,
        np.load(tmp_path / "predictions.npz") as here,
    ):
        for name in there.files:
            np.testing.assert_array_equal(here[name], there[name])


def test_a_run_whose_time_is_up_ends_with_what_it_has(clock, tmp_path):
    """The time is up from the start: each part does the least, and the run says what it lacks."""
    config = gaigs.compose(*SMALL, max_time="00:00:00:10")
    clock.step = 4.0
    metrics = runs.run(config, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    assert metrics["max_time"] == 10.0
    parts = (
        "the time for the fit of gaigs was up", "the training ended after 1 of 3 steps", "the fit of kriging ended",
        "0 of 2 folds calibrate kriging", "no validation scores of mean, gaussian_process",
        "no test scores of mean, gaussian_process",
    )  # fmt: skip
    assert len(metrics["left_out"]) == len(parts)
    for said, part in zip(metrics["left_out"], parts, strict=True):
        assert said.startswith(part), said
    assert list(metrics["models"]) == list(metrics["validation"]) == ["gaigs", "gaigs_trend"]
    assert gaigs.load(tmp_path).predict([[1.0, 2.0, 1.0]]).isfinite().all()


def test_train_takes_the_limit_of_all_its_parts(clock, caplog):
    clock.step = 1.0
    small = {
        "max_steps": 3,
        "count": 10,
        "accelerator": "cpu",
        "enable_progress_bar": False,
        "kriging": True,
    }
    gaigs.train("gaigs", example_links("rssi"), max_time="00:00:00:10", **small)
    assert "max_time: the fit of kriging ended early" in [
        record.message for record in caplog.records
    ]
    with pytest.raises(
        ValueError, match=r"^max_time must be at least 1 s as 'DD:HH:MM:SS', .* got '60 s'$"
    ):
        gaigs.train("gaigs", example_links("rssi"), max_time="60 s", **small)


def test_time_alone_may_end_a_training_of_a_limited_run(clock):
    with stages.watched(60.0), stages.stage(until=0.5):
        clock.now = 10.0
        _, found = budget.make_budget({"max_steps": -1}, searched=4.0)
        trainer = SimpleNamespace(
            strategy=SimpleNamespace(broadcast=lambda own: own), should_stop=False
        )
        found.on_fit_start(trainer, None)
    assert found.limit == 24.0, "20 s after the search"
