import errno
import math
import os
import re
import signal
import threading
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch
from fitting import make_links

from gaigs import checkpoint
from gaigs.gaussians import Gaussians
from gaigs.geometry import Pose
from gaigs.processes import STOPPING
from gaigs.scene import Receiver
from gaigs.task.rssi import Rssi
from gaigs.training.callbacks import DensityControl, Interrupted, KeepBest, KeepLast, ProgressLine, save

MIDDLE = (1.0, 2.0, 0.5)


@pytest.fixture(autouse=True)
def handlers():
    """Signals are handled behind each test as before it."""
    before = {number: signal.getsignal(number) for number in STOPPING}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def unsealed(monkeypatch):
    """The checkpoints here are words, no archives that a seal could end."""
    monkeypatch.setattr(checkpoint, "seal", lambda path: None)


@pytest.fixture(scope="module")
def links():
    return make_links()


@pytest.fixture
def module(links):
    """What density control sees of it: six Gaussians 2 m from the receiver, the third wide, the sixth faint."""
    scene = replace(links.scene, receivers=(Receiver("gateway1", Pose.from_xyzw(MIDDLE, (0.0, 0.0, 0.0, 1.0))),))
    options = {"count": 6, "near": 2.0, "far": 2.0, "spread": 1.0, "opacity": 0.5, "signal": 1.0}
    gaussians = Gaussians(scene, zone=(0.0, math.pi / 2), channels=2, **options)
    with torch.no_grad():
        gaussians.log_scales.fill_(math.log(0.1))
        gaussians.log_scales[2, 1] = math.log(1.0)
        gaussians.opacity_logits[5] = -9
    optimizer = torch.optim.AdamW(gaussians.parameters(), lr=1e-9)
    return SimpleNamespace(model=SimpleNamespace(primitives=gaussians, scene=scene), optimizer=optimizer)


def control(**options):
    given = {"every": 2, "start": 2, "stop": 6, "gradient": 1.0, "split_angle": 0.2, "opacity": 0.01}
    return DensityControl(**(given | {"max_count": 100, "seed": 0} | options))


def step(callback, module, number, pulls):
    """One optimizer step at which the loss pulls at the Gaussians' means with these gradients [loss/m]."""
    gaussians = module.model.primitives
    for parameter in gaussians.parameters():
        parameter.grad = torch.zeros_like(parameter)
    gaussians.means.grad[: len(pulls), 1] = torch.tensor(pulls)
    callback.on_before_optimizer_step(None, module, module.optimizer)
    module.optimizer.step()
    trainer = SimpleNamespace(global_step=number, optimizers=[module.optimizer], world_size=1)
    callback.on_train_batch_end(trainer, module)
    return len(gaussians)


def test_density_control_clones_the_narrow_splits_the_wide_and_prunes_the_faint(module):
    callback = control()
    before = module.model.primitives.scales.detach().clone()
    # The bound is 1 per radian, 0.5 per metre at 2 m: the mean pull counts, so of the two steps 0.6 is what decides.
    assert step(callback, module, 1, [0.0, 0.9, 0.9, 0.45, 0.0, 0.0]) == 6
    assert step(callback, module, 2, [0.0, 0.3, 0.3, 0.45, 0.0, 0.0]) == 7
    scales = module.model.primitives.scales
    assert torch.equal(scales[[0, 1, 3, 4]], before[[0, 1, 3, 4]])
    assert torch.equal(scales[5], before[1]), "the clone"
    torch.testing.assert_close(scales[[2, 6]], before[[2, 2]] / 1.6)
    for parameter in module.model.primitives.parameters():
        assert module.optimizer.state[parameter]["exp_avg"].shape == parameter.shape


def test_density_control_keeps_its_schedule(module):
    callback = control(start=4, stop=6)
    counts = [step(callback, module, number, [9.0]) for number in range(1, 10)]
    assert counts == [6, 6, 6, 6, 6, 7, 7, 7, 7], "at 4 one is cloned and one pruned, at 6 one cloned"


def test_density_control_forgets_the_pull_after_a_round(module):
    callback = control()
    step(callback, module, 1, [9.0])
    assert step(callback, module, 2, [9.0]) == 6
    step(callback, module, 3, [0.0])
    assert step(callback, module, 4, [0.0]) == 6


def test_density_control_grows_to_the_bound_by_the_hardest_pulled(module):
    module.model.primitives.opacity_logits.data[5] = 0
    marks = torch.arange(6.0)
    module.model.primitives.signal.data[:, 0, 0] = marks
    step(control(every=1, start=1, max_count=8), module, 1, [2.0, 5.0, 1.0, 4.0, 3.0, 0.0])
    assert sorted(module.model.primitives.signal[:, 0, 0].tolist()) == sorted([*marks.tolist(), 1, 3])


def test_density_control_goes_on_from_its_state(module):
    first, second = control(), control()
    step(first, module, 1, [9.0])
    second.load_state_dict(first.state_dict())
    assert step(second, module, 2, [0.0]) == 6, "half of 9 is above the bound: one cloned, one pruned"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"every": 0}, r"every must be at least 1 step, got 0"),
        ({"start": -1}, r"start and stop must satisfy 0 <= start <= stop, got -1 and \d+"),
        ({"start": 9, "stop": 8}, r"start and stop must satisfy 0 <= start <= stop, got 9 and 8"),
        ({"gradient": math.nan}, r"gradient must be at least 0, got nan"),
        ({"gradient": -1.0}, r"gradient must be at least 0, got -1\.0"),
        ({"split_angle": -0.1}, r"split_angle must be at least 0, got -0\.1"),
        ({"opacity": 1.0}, r"opacity must be in \[0, 1\), got 1\.0"),
        ({"opacity": math.nan}, r"opacity must be in \[0, 1\), got nan"),
        ({"max_count": 0}, r"max_count must be at least 1, got 0"),
    ],
)
def test_density_control_refuses(options, message):
    with pytest.raises(ValueError, match=rf"^density\.{message}$"):
        control(**options)


def test_density_control_needs_gaussians():
    with pytest.raises(ValueError, match="density needs a model with Gaussians"):
        control().on_fit_start(None, SimpleNamespace(model=SimpleNamespace(primitives=None)))


# --- checkpoints ---

SPECTRA, RSSI = make_links().task, Rssi()
ALONE = SimpleNamespace(reduce_boolean_decision=lambda decision, all: decision, barrier=lambda: None)
"""The strategy of one process."""


class Trainer(SimpleNamespace):
    """What the checkpoint callbacks see of Lightning's trainer; a checkpoint is the number of its step."""

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


@pytest.mark.parametrize(("task", "sign"), [(SPECTRA, 1), (RSSI, -1)])
def test_the_best_checkpoint_is_that_of_the_best_score(tmp_path, task, sign):
    """The highest similarity, or the smallest error."""
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


def test_without_validation_the_last_step_is_the_best(tmp_path):
    path, trainer = tmp_path / "best.ckpt", Trainer(enable_validation=False)
    trainer.global_step = 7
    KeepBest(path, patience=None).on_fit_end(trainer, None)
    assert path.read_text() == "7"


def test_lightnings_trial_validation_counts_for_nothing(tmp_path):
    trainer = Trainer()
    trainer.sanity_checking = True
    for callback in (KeepBest(tmp_path / "best.ckpt", patience=1), KeepLast(tmp_path / "last.ckpt", every=0)):
        trainer.validate(callback, 0.9)
    assert not trainer.should_stop
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("kill", range(6))
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
    assert again.should_stop, "a run that had stopped stays so"


def test_patience_refuses():
    with pytest.raises(ValueError, match="patience must be at least 1 validation or null, got 0"):
        KeepBest(None, patience=0)


def run(callback, trainer, steps):
    """Steps, with a validation behind every ``val_check_batch``-th."""
    callback.on_train_start(trainer, None)
    for _ in range(steps):
        trainer.global_step += 1
        yield "within"
        callback.on_train_batch_end(trainer, None)
        yield "step"
        if trainer.enable_validation and trainer.global_step % trainer.val_check_batch == 0:
            callback.on_validation_end(trainer, None)
            yield "validation"


@pytest.mark.parametrize("validation", [True, False])
def test_the_last_checkpoint_is_never_written_between_a_step_and_its_validation(tmp_path, validation):
    path = tmp_path / "last.ckpt"
    trainer = Trainer(enable_validation=validation)
    saved = []
    for moment in run(KeepLast(path, every=0), trainer, 11):
        if path.is_file():
            saved.append((moment, int(path.read_text())))
            path.unlink()
    at = [("validation" if validation and number % 5 == 0 else "step", number) for number in range(1, 12)]
    assert saved == at


def test_the_last_checkpoint_waits_for_its_time(tmp_path, monkeypatch):
    path, now = tmp_path / "last.ckpt", [100.0]
    monkeypatch.setattr("time.monotonic", lambda: now[0])
    trainer, written = Trainer(enable_validation=False), []
    for moment in run(KeepLast(path, every=15), trainer, 11):
        if moment == "within":
            now[0] += 4
        elif path.is_file():
            written.append(trainer.global_step)
            path.unlink()
    assert written == [4, 8], "at 116 s and 132 s, the first steps 15 s after the start and after the write before"


@pytest.mark.parametrize("number", STOPPING)
@pytest.mark.parametrize(("step", "moments"), [(1, ["within"]), (4, ["within"]), (5, ["within", "step"])])
def test_a_signal_finishes_the_step_and_its_validation(tmp_path, step, moments, number):
    path, trainer = tmp_path / "last.ckpt", Trainer()
    callback = KeepLast(path, every=1e9)
    seen = []

    def go_on():
        for moment in run(callback, trainer, 20):
            if trainer.global_step == step:
                seen.append(moment)
                if moment == "within":
                    os.kill(os.getpid(), number)

    with pytest.raises(Interrupted, match=f"stopped after step {step}$") as stop:
        go_on()
    assert stop.value.number == number
    assert seen == moments
    assert path.read_text() == str(step)


@pytest.mark.parametrize("second", STOPPING)
def test_a_second_signal_stops_at_once(tmp_path, second):
    callback = KeepLast(tmp_path / "last.ckpt", every=0)
    callback.on_train_start(Trainer(), None)
    os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(Interrupted, match="within a step") as stop:
        os.kill(os.getpid(), second)
    assert stop.value.number == second
    assert not list(tmp_path.iterdir())


def test_a_thread_sets_no_handlers(tmp_path):
    """Which Python would refuse: a training may run in a thread of another program."""
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


@pytest.mark.parametrize(("first", "hears"), [(True, False), (False, True)])
def test_of_several_processes_all_stop_when_one_is_told_to(tmp_path, first, hears):
    """The one that got no signal hears of it from the others, which are pretended here."""
    path, told = tmp_path / "last.ckpt", []
    strategy = SimpleNamespace(reduce_boolean_decision=lambda decision, all: told.append(decision) or True)
    strategy.barrier = lambda: None
    trainer = Trainer(strategy=strategy, is_global_zero=first, enable_validation=False)
    path.with_suffix(".part").write_text("another process's")
    callback = KeepLast(path, every=1e9)

    def go_on():
        for moment in run(callback, trainer, 3):
            if hears and moment == "within":
                os.kill(os.getpid(), signal.SIGTERM)

    with pytest.raises(Interrupted, match=r"stopped after step 1$") as stop:
        go_on()
    assert stop.value.number == (signal.SIGTERM if hears else signal.SIGINT)
    assert told == [hears, hears]
    assert path.is_file() == first, "the first alone puts the checkpoint in its place"


@pytest.mark.parametrize(("first", "saves"), [(True, True), (False, False)])
def test_of_several_processes_the_clock_of_the_first_counts(tmp_path, first, saves):
    path, trainer = tmp_path / "last.ckpt", Trainer(is_global_zero=first, enable_validation=False)
    list(run(KeepLast(path, every=0), trainer, 1))
    assert path.is_file() == saves


def test_a_checkpoint_is_written_whole_or_not_at_all(tmp_path):
    events = []

    class Full(Trainer):
        def save_checkpoint(self, path, weights_only):
            events.append("checkpoint")
            path.write_text("ha")
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    path = tmp_path / "last.ckpt"
    path.write_text("whole")
    message = r"last\.ckpt could not be written \(No space left on device\); see that its folder is there"
    with pytest.raises(OSError, match=message) as error:
        save(Full(loggers=[SimpleNamespace(save=lambda: events.append("log"))]), path)
    assert error.value.errno == errno.ENOSPC
    assert path.read_text() == "whole"
    assert [*tmp_path.iterdir()] == [path], "nothing of the new one is left"
    assert events == ["log", "checkpoint"], "else a kill in between loses rows of the log"


# --- the progress line ---


def test_the_progress_line_fits_80_columns_and_counts_from_where_the_training_goes_on(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    metrics = {"train/loss": 0.25, "v_num": 3}
    trainer = SimpleNamespace(global_step=1200, max_steps=1500, progress_bar_metrics=metrics, is_global_zero=True)
    trainer.callbacks = []
    line, module = ProgressLine(), SimpleNamespace(task=SPECTRA)
    line.on_train_start(trainer, None)
    trainer.global_step = 1499
    trainer.progress_bar_metrics["validation/ssim"] = 0.5
    line.on_train_batch_end(trainer, module)
    line.on_train_end(trainer, module)
    (shown,) = capsys.readouterr().out.strip().splitlines()
    assert len(shown) <= 80
    assert re.fullmatch(r"training \S+ +1499/1500 [\d.]+ steps/s \S+ loss 0\.250 ssim 0\.500", shown), shown


def test_the_progress_line_gives_the_terminal_back_after_an_error():
    line = ProgressLine()
    line.on_exception(None, None, ValueError())
    line.on_train_start(SimpleNamespace(global_step=0, max_steps=3, is_global_zero=True, callbacks=[]), None)
    line.on_exception(None, None, ValueError())
    assert not line.line.live.is_started


def test_of_several_processes_the_first_alone_shows_a_line(capsys):
    line, module = ProgressLine(), SimpleNamespace(task=SPECTRA)
    trainer = SimpleNamespace(global_step=0, max_steps=3, progress_bar_metrics={}, is_global_zero=False, callbacks=[])
    line.setup(trainer, module, "fit")
    line.on_train_start(trainer, module)
    line.on_train_batch_end(trainer, module)
    line.on_train_end(trainer, module)
    assert capsys.readouterr().out == ""
