"""What happens between the steps: density control, checkpoints to go on from, a line that tells how far it is.

Lightning's own checkpoint and progress callbacks are not used. ``ModelCheckpoint`` saves before a validation that is
due, by each process's own clock, and knows no stop at a signal: a training could not go on exactly where it stopped.
Its progress bars count the batches of an epoch, and a run counts steps.
"""

import contextlib
import math
import signal
import threading
import time
from pathlib import Path

import lightning
import torch
from lightning.pytorch.callbacks import Callback, Checkpoint, ProgressBar
from rich.progress import BarColumn, Progress, TimeRemainingColumn

from gaigs import checkpoint, density
from gaigs.io.files import atomic_write
from gaigs.processes import STOPPING
from gaigs.training import MeanScores, seeded
from gaigs.training.budget import share_done


class DensityControl(Callback):
    """Prunes, clones and splits Gaussians on a schedule.

    A Gaussian that the loss pulls at, though it is already where it should be, is too few: its mean positional gradient
    since the last time, times its distance to the receivers' middle (a pull per radian seen from there), is compared
    with ``gradient``. Wide ones split, narrow ones are cloned. Where places are frozen, nothing happens any more.

    Args:
        every: Steps between two rounds.
        start, stop: First and last step at which a round may happen.
        gradient: Bound on that pull [loss/rad].
        split_angle: A Gaussian is wide if its largest standard deviation over its distance exceeds this [rad].
        opacity: Gaussians below this opacity are pruned.
        max_count: Their number does not grow beyond this.
        seed: Of the halves' random places.

    Raises:
        ValueError: An option is out of range, or the model has no Gaussians.

    Source: Kerbl et al., 3D Gaussian Splatting, 2023, section 5.2; thresholds in docs/methods.md.
    """

    def __init__(
        self,
        every: int,
        start: int,
        stop: int,
        gradient: float,
        split_angle: float,
        opacity: float,
        max_count: int,
        seed: int,
    ):
        if every < 1:
            raise ValueError(f"density.every must be at least 1 step, got {every}")
        if not 0 <= start <= stop:
            raise ValueError(f"density.start and stop must satisfy 0 <= start <= stop, got {start} and {stop}")
        for option, bound in (("gradient", gradient), ("split_angle", split_angle)):
            if not bound >= 0:
                raise ValueError(f"density.{option} must be at least 0, got {bound}")
        if not 0 <= opacity < 1:
            raise ValueError(f"density.opacity must be in [0, 1), got {opacity}")
        if max_count < 1:
            raise ValueError(f"density.max_count must be at least 1, got {max_count}")
        self.every, self.start, self.stop = every, start, stop
        self.gradient, self.split_angle, self.opacity = gradient, split_angle, opacity
        self.max_count, self.seed = max_count, seed
        self.pull = torch.zeros(0)
        self.steps = 0

    def state_dict(self) -> dict:
        return {"pull": self.pull, "steps": self.steps}

    def load_state_dict(self, state: dict) -> None:
        self.pull, self.steps = state["pull"], state["steps"]

    def on_fit_start(self, trainer, module) -> None:
        if module.model.primitives is None:
            raise ValueError("density needs a model with Gaussians, and this one has none; leave density out")

    def on_before_optimizer_step(self, trainer, module, optimizer) -> None:
        gaussians = module.model.primitives
        if not gaussians.means.requires_grad:
            return
        pull = gaussians.means.grad.norm(dim=-1) * self._distances(module)
        self.pull = pull if self.steps == 0 else self.pull.to(pull) + pull
        self.steps += 1

    @torch.no_grad()
    def on_train_batch_end(self, trainer, module, *_) -> None:
        gaussians, optimizer, step = module.model.primitives, trainer.optimizers[0], trainer.global_step
        is_due = step % self.every == 0 and self.start <= step <= self.stop
        if not is_due or not gaussians.means.requires_grad:
            return
        pulled = self.pull / self.steps > self.gradient
        room = max(0, self.max_count - len(gaussians))
        if int(pulled.sum()) > room:  # only the hardest pulled
            chosen = torch.topk(torch.where(pulled, self.pull, -1), room).indices
            pulled = torch.zeros_like(pulled).index_fill(0, chosen, True)
        wide = gaussians.scales.amax(-1) / self._distances(module) > self.split_angle
        cloned, split = pulled & ~wide, pulled & wide
        density.clone(gaussians, optimizer, cloned)
        split = torch.cat((split, split.new_zeros(len(gaussians) - len(split))))
        density.split(gaussians, optimizer, split, seeded(self.seed, step))
        faint = gaussians.opacities < self.opacity
        if faint.any():
            density.prune(gaussians, optimizer, faint)
        self.steps = 0
        if trainer.world_size > 1:
            # All processes have the same Gaussians, as gradients are averaged before they are added up here, and draw
            # alike. What averages them, though, holds on to the parameters that were replaced.
            trainer.strategy.model = trainer.strategy._setup_model(module)

    def _distances(self, module) -> torch.Tensor:
        gaussians = module.model.primitives
        middle = module.model.scene.positions(gaussians.means).mean(0)
        return (gaussians.means.detach() - middle).norm(dim=-1)


class KeepBest(Checkpoint):
    """Writes the checkpoint of the best validation score (``Task.monitor``), or of the last step where nothing was
    validated.

    Args:
        path: Where it goes.
        patience: Validations without a better score until the training stops; None: it goes on to the last step.

    Raises:
        ValueError: The patience is less than one validation.
    """

    def __init__(self, path: Path, patience: int | None):
        if patience is not None and patience < 1:
            raise ValueError(f"training.patience must be at least 1 validation or null, got {patience}")
        self.path, self.patience = path, patience
        self.best, self.waited = -math.inf, 0  # an error counts as its negative

    def state_dict(self) -> dict:
        return {"best": self.best, "waited": self.waited}

    def load_state_dict(self, state: dict) -> None:
        self.best, self.waited = state["best"], state["waited"]

    @torch.no_grad()
    def on_train_start(self, trainer, module) -> None:
        """A model that predicts untrained counts as it starts, too: few readings may not better it."""
        self._stop_in_time(trainer)  # a run that was killed once it had stopped
        if trainer.enable_validation and self.best == -math.inf and module.model.predicts_untrained:
            self._validate(trainer, module)

    def on_validation_end(self, trainer, module) -> None:
        if trainer.sanity_checking:
            return
        score = trainer.callback_metrics[f"validation/{module.task.monitor}"].item()
        self.waited = 0 if self._keep(trainer, module, score) else self.waited + 1
        self._stop_in_time(trainer)

    @torch.no_grad()
    def on_train_end(self, trainer, module) -> None:
        """The last step counts too, where no validation was due at it."""
        if trainer.enable_validation and trainer.global_step % trainer.val_check_batch:
            self._validate(trainer, module)

    def _validate(self, trainer, module) -> None:
        module.eval()
        scores = MeanScores(module.task)
        for batch in trainer.val_dataloaders:
            batch = trainer.precision_plugin.convert_input(batch).to(module.device)
            with trainer.precision_plugin.val_step_context():
                scores.add(batch, module.model.evaluate(batch))
        module.train()
        self._keep(trainer, module, scores.over_processes(trainer.strategy)[module.task.monitor])

    def on_fit_end(self, trainer, module) -> None:
        if self.best == -math.inf:
            save(trainer, self.path)

    def _keep(self, trainer, module, score: float) -> bool:
        score = score if module.task.higher_is_better else -score
        better = score > self.best
        if better:
            self.best = score
            save(trainer, self.path)
        return better

    def _stop_in_time(self, trainer) -> None:
        if self.patience is not None and self.waited >= self.patience:
            trainer.should_stop = True


class KeepLast(Checkpoint):
    """Writes the checkpoint to go on from: every so often, at Ctrl-C or SIGTERM, and at the end.

    It does so between two steps, behind the validation where one is due, and behind the other callbacks, whose state it
    stores: from there a training goes on as if it had never stopped. At the first signal it stops there, at the second
    at once. Several processes go by the clock of the first, and stop together whichever of them got the signal.

    Args:
        path: Where it goes.
        every: Time from one to the next [s].
    """

    def __init__(self, path: Path, every: float):
        self.path, self.every = path, every
        self.received: int | None = None
        self.random: dict | None = None

    def state_dict(self) -> dict:
        """The states of torch's global generators, which a model may draw from."""
        devices = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else []
        return {"processor": torch.random.get_rng_state(), "devices": devices}

    def load_state_dict(self, state: dict) -> None:
        self.random = state

    def interrupt(self, number: int, *_) -> None:
        """The handler of the signals that stop a run."""
        if self.received is not None:
            raise Interrupted("stopped within a step", number)
        self.received = number

    def on_train_start(self, trainer, module) -> None:
        self.saved = time.monotonic()
        if threading.current_thread() is threading.main_thread():  # others may set no handlers
            for number in STOPPING:
                # Here, behind Lightning's own for SIGTERM, which talks to the other processes in the midst of a step.
                signal.signal(number, self.interrupt)
        if self.random is not None:
            torch.random.set_rng_state(self.random["processor"])
            for device, state in enumerate(self.random["devices"][: torch.cuda.device_count()]):
                torch.cuda.set_rng_state(state, device)

    def on_train_batch_end(self, trainer, module, *_) -> None:
        if not (trainer.enable_validation and trainer.global_step % trainer.val_check_batch == 0):
            self._rest(trainer)

    def on_validation_end(self, trainer, module) -> None:
        if not trainer.sanity_checking:
            self._rest(trainer)

    def on_fit_end(self, trainer, module) -> None:
        save(trainer, self.path)

    def _rest(self, trainer) -> None:
        anyone = lambda holds: trainer.strategy.reduce_boolean_decision(holds, all=False)
        is_due = trainer.is_global_zero and time.monotonic() >= self.saved + self.every
        if not anyone(is_due or self.received is not None):
            return
        save(trainer, self.path)
        self.saved = time.monotonic()
        if anyone(self.received is not None):
            raise Interrupted(f"stopped after step {trainer.global_step}", self.received or signal.SIGINT)


class Interrupted(Exception):
    """Ctrl-C or SIGTERM. No KeyboardInterrupt, at which Lightning would end the process.

    Args:
        message: Where it stopped.
        number: Of the signal.
    """

    def __init__(self, message: str, number: int):
        super().__init__(message)
        self.number = number


def save(trainer: lightning.Trainer, path: Path) -> None:
    """Writes a checkpoint, whole or not at all, behind the log of the steps before it; every process has to call it."""
    for logger in trainer.loggers:
        logger.save()
    with atomic_write(path) if trainer.is_global_zero else contextlib.nullcontext(path.with_suffix(".part")) as part:
        trainer.save_checkpoint(part, weights_only=False)  # which only the first process writes
        if trainer.is_global_zero:
            checkpoint.seal(part)
    trainer.strategy.barrier()


class ProgressLine(ProgressBar):
    """Steps done, their rate, the time left, loss and validation score in one line of the first process's terminal."""

    def disable(self) -> None:
        """Lightning's call in all other processes, whose lines stay hidden from the start."""

    def on_train_start(self, trainer, module) -> None:
        bar, left = BarColumn(None), TimeRemainingColumn()
        count, rate, scores = "{task.fields[count]}", "{task.fields[rate]:.1f} steps/s", "{task.fields[scores]}"
        hidden = not trainer.is_global_zero
        self.line = Progress("training", bar, count, rate, left, scores, expand=True, disable=hidden)
        self.start, self.first, self.share_done = time.monotonic(), trainer.global_step, share_done(trainer)
        self.task = self.line.add_task("", total=1, **self._done(trainer), rate=0, scores="")
        self.line.start()

    def on_train_batch_end(self, trainer, module, *_) -> None:
        step, values = trainer.global_step, trainer.progress_bar_metrics
        rate = (step - self.first) / (time.monotonic() - self.start)
        words = {"train/loss": "loss", f"validation/{module.task.monitor}": module.task.monitor}
        scores = " ".join(f"{word} {values[name]:.3f}" for name, word in words.items() if name in values)
        self.line.update(self.task, **self._done(trainer), rate=rate, scores=scores)

    def _done(self, trainer) -> dict:
        step, last = trainer.global_step, trainer.max_steps
        count = f"{step:{len(str(last))}d}/{last}" if last > 0 else f"{step} steps"
        return {"completed": self.share_done(step), "count": count}

    def on_train_end(self, trainer, module) -> None:
        self.line.stop()

    def on_exception(self, trainer, module, exception) -> None:
        if hasattr(self, "line"):
            self.line.stop()
