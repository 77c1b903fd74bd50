"""What happens between the steps: density control, checkpoints to go on from, a line that tells how far it is."""

import math
import time
from pathlib import Path

import lightning
import torch
from lightning.pytorch.callbacks import Callback, Checkpoint, ProgressBar
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TimeRemainingColumn

from gaigs import density


class DensityControl(Callback):
    """Prunes, clones and splits Gaussians on a schedule.

    A Gaussian that the loss pulls at, though it is already where it should be, is too few: its mean positional gradient
    since the last time, times its distance to the receivers' middle (a pull per radian seen from there), is compared
    with ``gradient``. Wide ones split, narrow ones are cloned.

    Args:
        every: Steps between two rounds.
        start, stop: First and last step at which a round may happen.
        gradient: Bound on that pull [loss/rad].
        wide: A Gaussian is wide if its largest standard deviation over its distance exceeds this [rad].
        opacity: Gaussians below this opacity are pruned.
        most: Their number does not grow beyond this.
        seed: Of the halves' random places.

    Raises:
        ValueError: ``every`` is less than one step, or the model has no Gaussians.

    Source: Kerbl et al., 3D Gaussian Splatting, 2023, section 5.2; thresholds in docs/methods.md.
    """

    def __init__(
        self, every: int, start: int, stop: int, gradient: float, wide: float, opacity: float, most: int, seed: int
    ):
        if every < 1:
            raise ValueError(f"density.every must be at least 1 step, got {every}")
        self.every, self.start, self.stop = every, start, stop
        self.gradient, self.wide, self.opacity, self.most, self.seed = gradient, wide, opacity, most, seed
        self.pull = torch.zeros(0)
        self.steps = 0

    def state_dict(self) -> dict:
        return {"pull": self.pull, "steps": self.steps}

    def load_state_dict(self, state: dict) -> None:
        self.pull, self.steps = state["pull"], state["steps"]

    def on_fit_start(self, trainer, module) -> None:
        if not hasattr(module.model, "gaussians"):
            raise ValueError("density needs a model with Gaussians, and this one has none; set density=null")

    def on_before_optimizer_step(self, trainer, module, optimizer) -> None:
        gaussians = module.model.gaussians
        pull = gaussians.means.grad.norm(dim=-1) * self._distances(module)
        self.pull = pull if self.steps == 0 else self.pull.to(pull) + pull
        self.steps += 1

    @torch.no_grad()
    def on_train_batch_end(self, trainer, module, *_) -> None:
        step = trainer.global_step
        if step % self.every or not self.start <= step <= self.stop:
            return
        gaussians, optimizer = module.model.gaussians, trainer.optimizers[0]
        pulled = self.pull / self.steps > self.gradient
        room = max(0, self.most - len(gaussians))
        if int(pulled.sum()) > room:  # only the hardest pulled
            chosen = torch.topk(torch.where(pulled, self.pull, -1), room).indices
            pulled = torch.zeros_like(pulled).index_fill(0, chosen, True)
        wide = gaussians.scales.amax(-1) / self._distances(module) > self.wide
        cloned, split = pulled & ~wide, pulled & wide
        density.clone(gaussians, optimizer, cloned)
        split = torch.cat((split, split.new_zeros(len(gaussians) - len(split))))
        generator = torch.Generator().manual_seed(hash((self.seed, step)) % 2**63)
        density.split(gaussians, optimizer, split, generator)
        faint = gaussians.opacities < self.opacity
        if faint.any():
            density.prune(gaussians, optimizer, faint)
        self.steps = 0

    def _distances(self, module) -> torch.Tensor:
        gaussians = module.model.gaussians
        middle = torch.stack([receiver.pose.position for receiver in module.model.scene.receivers]).mean(0)
        return (gaussians.means.detach() - middle.to(gaussians.means)).norm(dim=-1)


class KeepBest(Checkpoint):
    """Writes the checkpoint of the best validation score (``Training.scoring``), or of the last step where nothing was
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
        """RSSI starts from its reference, which few readings may not better: so that start counts too."""
        self._stop_in_time(trainer)  # a run that was killed once it had stopped
        if trainer.enable_validation and self.best == -math.inf and module.model.scene.grid is None:
            self._validate(trainer, module)

    def on_validation_end(self, trainer, module) -> None:
        if trainer.sanity_checking:
            return
        score = trainer.callback_metrics[f"validation/{module.scoring.watched}"].item()
        self.waited = 0 if self._keep(trainer, module, score) else self.waited + 1
        self._stop_in_time(trainer)

    @torch.no_grad()
    def on_train_end(self, trainer, module) -> None:
        """The last step counts too, where no validation was due at it."""
        if trainer.enable_validation and trainer.global_step % trainer.val_check_batch:
            self._validate(trainer, module)

    def _validate(self, trainer, module) -> None:
        module.eval()
        batches = (batch.to(module.device) for batch in trainer.val_dataloaders)
        scores = [module.scoring.scores(batch.labels, module.model(batch).label) for batch in batches]
        module.train()
        self._keep(trainer, module, torch.cat([score[module.scoring.watched] for score in scores]).mean().item())

    def on_fit_end(self, trainer, module) -> None:
        if self.best == -math.inf:
            save(trainer, self.path)

    def _keep(self, trainer, module, score: float) -> bool:
        score = score if module.scoring.larger_is_better else -score
        better = score > self.best
        if better:
            self.best = score
            save(trainer, self.path)
        return better

    def _stop_in_time(self, trainer) -> None:
        if self.patience is not None and self.waited >= self.patience:
            trainer.should_stop = True


class KeepLast(Checkpoint):
    """Writes the checkpoint to go on from: every so often, at Ctrl-C, and at the end.

    It does so between two steps, behind the validation where one is due, and behind the other callbacks, whose state it
    stores: from there a training goes on as if it had never stopped. At the first Ctrl-C it stops there, at the second
    at once.

    Args:
        path: Where it goes.
        every: Time from one to the next [s].
    """

    def __init__(self, path: Path, every: float):
        self.path, self.every = path, every
        self.interrupted = False

    def interrupt(self, *_) -> None:
        """The handler of the signal that Ctrl-C sends."""
        if self.interrupted:
            raise Interrupted("stopped within a step")
        self.interrupted = True

    def on_train_start(self, trainer, module) -> None:
        self.saved = time.monotonic()

    def on_train_batch_end(self, trainer, module, *_) -> None:
        if not (trainer.enable_validation and trainer.global_step % trainer.val_check_batch == 0):
            self._rest(trainer)

    def on_validation_end(self, trainer, module) -> None:
        if not trainer.sanity_checking:
            self._rest(trainer)

    def on_fit_end(self, trainer, module) -> None:
        save(trainer, self.path)

    def _rest(self, trainer) -> None:
        if self.interrupted or time.monotonic() >= self.saved + self.every:
            save(trainer, self.path)
            self.saved = time.monotonic()
        if self.interrupted:
            raise Interrupted(f"stopped after step {trainer.global_step}")


class Interrupted(Exception):
    """Ctrl-C. No KeyboardInterrupt, at which Lightning would end the process."""


def save(trainer: lightning.Trainer, path: Path) -> None:
    """Writes a checkpoint, whole or not at all, behind the log of the steps before it."""
    for logger in trainer.loggers:
        logger.save()
    part = path.with_suffix(".part")
    trainer.save_checkpoint(part, weights_only=False)
    part.replace(path)


class ProgressLine(ProgressBar):
    """Steps done, their rate, the time left, loss and validation score in one line of the terminal."""

    def on_train_start(self, trainer, module) -> None:
        bar, count, left = BarColumn(None), MofNCompleteColumn(), TimeRemainingColumn()
        rate, scores = "{task.fields[rate]:.1f} steps/s", "{task.fields[scores]}"
        self.line = Progress("training", bar, count, rate, left, scores, expand=True)
        self.start, self.first = time.monotonic(), trainer.global_step
        self.task = self.line.add_task("", total=trainer.max_steps, completed=self.first, rate=0, scores="")
        self.line.start()

    def on_train_batch_end(self, trainer, module, *_) -> None:
        step, values = trainer.global_step, trainer.progress_bar_metrics
        rate = (step - self.first) / (time.monotonic() - self.start)
        words = {"train/loss": "loss", "validation/ssim": "SSIM", "validation/mae_db": "MAE/dB"}
        scores = " ".join(f"{word} {values[name]:.3f}" for name, word in words.items() if name in values)
        self.line.update(self.task, completed=step, rate=rate, scores=scores)

    def on_train_end(self, trainer, module) -> None:
        self.line.stop()

    def on_exception(self, trainer, module, exception) -> None:
        if hasattr(self, "line"):
            self.line.stop()
