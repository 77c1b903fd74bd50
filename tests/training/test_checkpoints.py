"""The best and the last checkpoint: when they are written, and that a training goes on from the
last.
"""

import errno
import math
import os
import signal
import threading
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from fitting import Plane, Watch, fit, make_links, make_module
from torch import nn

from gaigs.core.task.rssi import Rssi
from gaigs.model import Model, Prediction, checkpoint
from gaigs.processes import STOPPING
from gaigs.splatting.loss.absolute import Absolute
from gaigs.training.checkpoints import Interrupted, KeepBest, KeepLast, save

SPECTRA, RSSI = make_links().task, Rssi()
ALONE = SimpleNamespace(
    reduce_boolean_decision=lambda decision, all: decision, barrier=lambda: None
)
"""The strategy of one process."""


class Trainer(SimpleNamespace):
    """The parts of Lightning's trainer that the callbacks use; a checkpoint is the number of its
    step.
    """

    def __init__(self, **state):
        state = {"enable_validation": True, "val_check_batch": 5, "loggers": []} | state
        state = {"strategy": ALONE, "is_global_zero": True} | state
        super().__init__(global_step=0, should_stop=False, sanity_checking=False, **state)

    def save_checkpoint(self, path, weights_only):
        assert not weights_only, "the optimizer's state belongs to it"
        path.write_text(str(self.global_step))

    def validate(self, callback, score, task=SPECTRA):
        self.global_step += 1
        self.callback_metrics = {f"validation/{task.monitor}": torch.tensor(score)}
        callback.on_validation_end(self, SimpleNamespace(task=task))


@pytest.fixture
def unsealed(monkeypatch):
    """Numbers instead of archives, which alone take a seal."""
    monkeypatch.setattr(checkpoint, "seal", lambda path: None)


def run(callback, trainer, steps):
    """Steps, with a validation after every ``val_check_batch``-th; yields the moments."""
    callback.on_train_start(trainer, None)
    for _ in range(steps):
        trainer.global_step += 1
        yield "within"
        callback.on_train_batch_end(trainer, None)
        yield "step"
        if trainer.enable_validation and trainer.global_step % trainer.val_check_batch == 0:
            callback.on_validation_end(trainer, None)
            yield "validation"


# --- the best ---


@pytest.mark.usefixtures("unsealed")
@pytest.mark.parametrize(("task", "sign"), [(SPECTRA, 1), (RSSI, -1)])
def test_the_best_has_the_highest_similarity_or_the_smallest_error(tmp_path, task, sign):
    path, trainer = tmp_path / "best.ckpt", Trainer()
    callback = KeepBest(path, patience=None)
    saved = []
    for score in (0.3, 0.5, 0.4, 0.5, 0.6, float("nan"), 0.1):
        trainer.validate(callback, sign * score, task)
        saved.append(path.read_text())
    callback.on_fit_end(trainer, None)
    assert saved == ["1", "2", "2", "2", "5", "5", "5"]
    assert path.read_text() == "5"
    assert not trainer.should_stop


@pytest.mark.usefixtures("unsealed")
@pytest.mark.parametrize("kill", [1, 3])
def test_patience_counts_validations_without_a_better_score(tmp_path, kill):
    callback, trainer = KeepBest(tmp_path / "best.ckpt", patience=2), Trainer()
    stops = []
    for number, ssim in enumerate((0.3, 0.2, 0.4, 0.4, 0.1)):
        if number == kill:
            state = callback.state_dict()
            callback = KeepBest(tmp_path / "best.ckpt", patience=2)
            callback.load_state_dict(state)
        trainer.validate(callback, ssim)
        stops.append(trainer.should_stop)
    assert stops == [False, False, False, False, True]
    resumed, again = KeepBest(tmp_path / "best.ckpt", patience=2), Trainer()
    resumed.load_state_dict(callback.state_dict())
    resumed.on_train_start(again, None)
    assert again.should_stop, "a stopped run stays so"
    with pytest.raises(ValueError, match="patience must be at least 1 validation or null, got 0"):
        KeepBest(tmp_path, patience=0)


@pytest.mark.usefixtures("unsealed")
@pytest.mark.parametrize(
    ("rival", "stops"),
    [
        (-4.0, [False, False, True]),  # 5.0 falls by 0.2 a fifth, to 4.6
        (-4.7, [False, False, False]),
        (None, [False, False, False]),
    ],
)
def test_a_training_that_would_stay_behind_a_rival_stops(tmp_path, rival, stops):
    callback = KeepBest(tmp_path / "best.ckpt", None, rival)
    trainer = Trainer(max_steps=5, callbacks=[])
    found = []
    for error in (7.0, 5.2, 5.0):
        trainer.validate(callback, error, RSSI)
        found.append(trainer.should_stop)
    assert found == stops
    resumed, again = KeepBest(tmp_path / "best.ckpt", None, rival), Trainer()
    resumed.load_state_dict(callback.state_dict())
    resumed.on_train_start(again, None)
    assert again.should_stop == stops[-1]


class Level(Model):
    """One number for all links, which the training raises by 1 dB a step."""

    def __init__(self, scene):
        super().__init__(scene)
        self.level = nn.Parameter(torch.zeros(()))

    def forward(self, batch):
        assert batch.query.transmitters.dtype == self.level.dtype
        return Prediction(self.level.expand(len(batch)), {})


class Ready(Level):
    """A level that predicts as it is made."""

    predicts_untrained = True


@pytest.mark.parametrize(
    ("model", "validation", "steps", "kept", "options"),
    [
        (Ready, 0.0, 12, 0, {}),  # each step is worse than the one before
        (Ready, 2.0, 12, 0, {}),  # as far off as the start at step 4, where nothing validates
        (Ready, 6.0, 12, 5, {"precision": "64-true"}),
        (Level, 0.0, 12, 5, {}),  # the start does not count
        (Level, 100.0, 10, 10, {}),  # each step is better
        (Level, 12.0, 12, 12, {"precision": "64-true"}),  # no validation is due at the end
        (Level, 8.0, 12, 10, {}),  # off by 2 at step 10 and by 4 at step 12
        (Ready, None, 7, 7, {"limit_val_batches": 0}),  # without validation the end
    ],
)
def test_the_best_of_start_validations_and_end_is_kept(
    links, tmp_path, model, validation, steps, kept, options
):
    labels = torch.full((len(links),), 100.0)
    labels[links.split.validation] = validation or 0.0
    readings = replace(links, labels=labels, task=Rssi())
    module = make_module(
        readings,
        model(readings.scene),
        loss=Absolute(readings.task),
        thinning={},
        learning_rates={"network": 1.0},
        optimizer={"_target_": "torch.optim.SGD"},
        schedule={"warmup": 0, "final": 1.0},
    )
    best = KeepBest(tmp_path / "best.ckpt", patience=None)
    fit(module, readings, tmp_path, steps, best, **options)
    content = torch.load(tmp_path / "best.ckpt", weights_only=True)
    assert (content["global_step"], content["state_dict"]["model.level"].item()) == (kept, kept)
    assert best.best == (-math.inf if validation is None else -abs(kept - validation))


# --- the last ---


@pytest.mark.usefixtures("unsealed")
@pytest.mark.parametrize("validation", [True, False])
def test_the_last_is_never_written_between_a_step_and_its_validation(tmp_path, validation):
    path = tmp_path / "last.ckpt"
    trainer = Trainer(enable_validation=validation)
    saved = []
    for moment in run(KeepLast(path, every=0), trainer, 11):
        if path.is_file():
            saved.append((moment, int(path.read_text())))
            path.unlink()
    assert saved == [
        ("validation" if validation and number % 5 == 0 else "step", number)
        for number in range(1, 12)
    ]


@pytest.mark.usefixtures("unsealed")
def test_the_last_waits_for_its_time(tmp_path, monkeypatch):
    path, now = tmp_path / "last.ckpt", [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    trainer, written = Trainer(enable_validation=False), []
    for moment in run(KeepLast(path, every=15), trainer, 11):
        if moment == "within":
            now[0] += 4
        elif path.is_file():
            written.append(trainer.global_step)
            path.unlink()
    assert written == [4, 8], (
        "at 116 s and 132 s, the first steps 15 s after the start and after the write before"
    )


def test_lightnings_trial_validation_does_not_count(tmp_path):
    trainer = Trainer()
    trainer.sanity_checking = True
    for callback in (
        KeepBest(tmp_path / "best.ckpt", patience=1),
        KeepLast(tmp_path / "last.ckpt", every=0),
    ):
        trainer.validate(callback, 0.9)
    assert not trainer.should_stop
    assert not list(tmp_path.iterdir())


@pytest.mark.usefixtures("unsealed")
@pytest.mark.parametrize("number", STOPPING)
@pytest.mark.parametrize(("step", "moments"), [(4, ["within"]), (5, ["within", "step"])])
def test_a_signal_finishes_the_step_and_its_validation(tmp_path, step, moments, number):
    path, trainer, seen = tmp_path / "last.ckpt", Trainer(), []

    def go_on():
        for moment in run(KeepLast(path, every=1e9), trainer, 20):
            if trainer.global_step == step:
                seen.append(moment)
                if moment == "within":
                    os.kill(os.getpid(), number)

    with pytest.raises(Interrupted, match=f"stopped after step {step}$") as stop:
        go_on()
    assert stop.value.number == number
    assert seen == moments
    assert path.read_text() == str(step)


def test_a_second_signal_stops_at_once(tmp_path):
    callback = KeepLast(tmp_path / "last.ckpt", every=0)
    callback.on_train_start(Trainer(), None)
    os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(Interrupted, match="within a step") as stop:
        os.kill(os.getpid(), signal.SIGTERM)
    assert stop.value.number == signal.SIGTERM
    assert not list(tmp_path.iterdir())


def test_a_thread_sets_no_handlers(tmp_path):
    """Python would refuse it: a training may run in a thread of another program."""
    before, errors = signal.getsignal(signal.SIGTERM), []

    def start():
        try:
            KeepLast(tmp_path / "last.ckpt", every=0).on_train_start(Trainer(), None)
        except ValueError as error:
            errors.append(error)

    thread = threading.Thread(target=start)
    thread.start()
    thread.join()
    assert not errors
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.usefixtures("unsealed")
@pytest.mark.parametrize(("first", "hears"), [(True, False), (False, True)])
def test_of_several_processes_all_stop_at_the_signal_of_one(tmp_path, first, hears):
    path, asked = tmp_path / "last.ckpt", []
    strategy = SimpleNamespace(
        reduce_boolean_decision=lambda decision, all: asked.append(decision) or True
    )
    strategy.barrier = lambda: None
    trainer = Trainer(strategy=strategy, is_global_zero=first, enable_validation=False)
    path.with_suffix(".part").write_text("another process's")

    def go_on():
        for moment in run(KeepLast(path, every=1e9), trainer, 3):
            if hears and moment == "within":
                os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(Interrupted, match=r"stopped after step 1$") as stop:
        go_on()
    assert stop.value.number == (signal.SIGTERM if hears else signal.SIGINT)
    assert asked == [hears, hears]
    assert path.is_file() == first, "the first alone puts the checkpoint in its place"


@pytest.mark.usefixtures("unsealed")
@pytest.mark.parametrize("first", [True, False])
def test_of_several_processes_the_clock_of_the_first_counts(tmp_path, first):
    path, trainer = tmp_path / "last.ckpt", Trainer(is_global_zero=first, enable_validation=False)
    list(run(KeepLast(path, every=0), trainer, 1))
    assert path.is_file() == first


def test_a_checkpoint_is_written_atomically_after_the_log(tmp_path):
    events = []

    class Full(Trainer):
        def save_checkpoint(self, path, weights_only):
            events.append("checkpoint")
            path.write_text("ha")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "last.ckpt"
    path.write_text("whole")
    with pytest.raises(OSError, match=r"last\.ckpt .*No space left on device") as error:
        save(Full(loggers=[SimpleNamespace(save=lambda: events.append("log"))]), path)
    assert error.value.errno == errno.ENOSPC
    assert path.read_text() == "whole"
    assert [*tmp_path.iterdir()] == [path], "nothing of the new one is left"
    assert events == ["log", "checkpoint"], "else a kill in between loses rows of the log"


# --- going on ---


class Noisy(Plane):
    """A plane that draws from torch's global generator, in training and in validation."""

    def forward(self, batch):
        value, penalties = super().forward(batch)
        return type(self.prediction)(value + 0.1 * torch.randn(value.shape), penalties)


@pytest.mark.parametrize("at", [3, 5])  # 5: a validation is due, which draws too
def test_a_resumed_training_draws_the_next_random_numbers(links, tmp_path, at):
    def make():
        torch.manual_seed(0)
        return make_module(links, Noisy(links.scene))

    whole, part, rest = Watch(), Watch(at), Watch()
    path = tmp_path / "last.ckpt"
    fit(make(), links, tmp_path, 8, whole, KeepLast(tmp_path / "whole.ckpt", every=math.inf))
    with pytest.raises(Interrupted, match=f"stopped after step {at}$"):
        fit(make(), links, tmp_path, 8, part, KeepLast(path, every=math.inf))
    module = make()
    torch.manual_seed(2)  # another process need not start from the same
    fit(module, links, tmp_path, 8, rest, KeepLast(path, every=math.inf), resume=path)
    assert part.losses == whole.losses[:at]
    assert rest.losses == whole.losses[at:]
