"""Checkpoints of a training: the best one, and the last one for resumption."""

import logging
import math
import signal
import threading
import time
from functools import partial
from pathlib import Path

import torch
from lightning.pytorch.callbacks import Checkpoint

from gaigs.io.files import atomic_write
from gaigs.model import checkpoint
from gaigs.processes import STOPPING, hang_up
from gaigs.training import MeanScores
from gaigs.training.budget import share_done

log = logging.getLogger(__name__)


class KeepBest(Checkpoint):
    """Writes the checkpoint of the best validation score (``Task.monitor``).

    Without validation it is the checkpoint of the last step. The training stops after ``patience``
    validations without a better score. It also stops if the best score, which rises to the end as
    fast as since the last validation, stays below the score ``rival``.
    """

    def __init__(self, path: Path, patience: int | None, rival: float | None = None):
        if patience is not None and patience < 1:
            raise ValueError(
                f"training.patience must be at least 1 validation or null, got {patience}"
            )
        self.path = path
        self.patience = patience
        self.rival = rival
        self.best = -math.inf  # an error counts as its negative
        self.waited = 0
        self.share = 0.0  # of the training, at the last validation
        self.is_behind = False

    def state_dict(self) -> dict:
        names = "best", "waited", "share", "is_behind"
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state: dict) -> None:
        for name, value in state.items():  # fewer in checkpoints of earlier versions
            setattr(self, name, value)

    def on_train_start(self, trainer, module) -> None:
        """Scores the model before the first step, too, if it ``predicts_untrained``."""
        self._stop_without_progress(trainer)  # a run that was killed once it had stopped
        if trainer.enable_validation and self.best == -math.inf and module.model.predicts_untrained:
            self._validate(trainer, module)

    def on_validation_end(self, trainer, module) -> None:
        if trainer.sanity_checking:
            return
        score = trainer.callback_metrics[f"validation/{module.task.monitor}"].item()
        last_best, last_share = self.best, self.share
        self.waited = 0 if self._keep(trainer, module, score) else self.waited + 1
        if self.rival is not None:
            self.share = share_done(trainer)(trainer.global_step)
            rate = (self.best - last_best) / max(self.share - last_share, 1e-9)
            extrapolated = self.best + rate * (1 - self.share)  # at the end of the training
            self.is_behind = extrapolated < self.rival
        if self.is_behind:
            log.info("step %d: a law of distance stays ahead of the room", trainer.global_step)
        self._stop_without_progress(trainer)

    def on_train_end(self, trainer, module) -> None:
        """Scores the model after the last step, if no validation followed this step."""
        if trainer.enable_validation and trainer.global_step % trainer.val_check_batch:
            self._validate(trainer, module)

    @torch.no_grad()
    def _validate(self, trainer, module) -> None:
        """Scores all validation links outside of Lightning's own validations."""
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
        """Writes a checkpoint if the score is better than before; returns whether it is."""
        score = score if module.task.higher_is_better else -score
        is_better = score > self.best
        if is_better:
            self.best = score
            save(trainer, self.path)
        return is_better

    def _stop_without_progress(self, trainer) -> None:
        """Asks Lightning to stop if the score stays below the rival or after ``patience``."""
        if self.is_behind or (self.patience is not None and self.waited >= self.patience):
            trainer.should_stop = True


class KeepLast(Checkpoint):
    """Writes the checkpoint to resume from: ``every`` [s], at a signal to stop, and at the end.

    The checkpoint is written between two steps, after a due validation and all other callbacks, so
    a resumed training equals an uninterrupted one. At the first signal the training stops at this
    point, at the second signal immediately. Several processes follow the clock of the first, and
    stop together after a signal to any of them. (Lightning's ``ModelCheckpoint`` saves before a due
    validation, by each process's clock.)
    """

    def __init__(self, path: Path, every: float | int):
        self.path = path
        self.every = every
        self.received: int | None = None
        self.random: dict | None = None

    def state_dict(self) -> dict:
        """The states of torch's global generators."""
        devices = torch.cuda.get_rng_state_all() if torch.cuda.is_initialized() else []
        return {"processor": torch.random.get_rng_state(), "devices": devices}

    def load_state_dict(self, state: dict) -> None:
        self.random = state

    def interrupt(self, number: int, *_) -> None:
        """Handles the signals that stop a run."""
        if self.received is not None:
            raise Interrupted("stopped within a step", number)
        self.received = number
        hang_up(number)

    def on_train_start(self, trainer, module) -> None:
        self.saved = time.monotonic()
        if threading.current_thread() is threading.main_thread():  # others may set no handlers
            for number in STOPPING:
                # After Lightning's handler of SIGTERM, which would talk to the other processes in
                # the midst of a step.
                signal.signal(number, self.interrupt)
        if self.random is not None:
            torch.random.set_rng_state(self.random["processor"])
            for device, state in enumerate(self.random["devices"][: torch.cuda.device_count()]):
                torch.cuda.set_rng_state(state, device)

    def on_train_batch_end(self, trainer, module, *_) -> None:
        if not (trainer.enable_validation and trainer.global_step % trainer.val_check_batch == 0):
            self._save_if_due(trainer)

    def on_validation_end(self, trainer, module) -> None:
        if not trainer.sanity_checking:
            self._save_if_due(trainer)

    def on_fit_end(self, trainer, module) -> None:
        save(trainer, self.path)

    def _save_if_due(self, trainer) -> None:
        """Writes a checkpoint between two steps if it is due; a signal stops the training."""
        any_of = partial(trainer.strategy.reduce_boolean_decision, all=False)
        is_due = trainer.is_global_zero and time.monotonic() >= self.saved + self.every
        if not any_of(is_due or self.received is not None):
            return
        save(trainer, self.path)
        self.saved = time.monotonic()
        if any_of(self.received is not None):
            raise Interrupted(
                f"stopped after step {trainer.global_step}", self.received or signal.SIGINT
            )


class Interrupted(Exception):
    """A signal that stops a run; Lightning would end the process at a KeyboardInterrupt."""

    def __init__(self, message: str, number: int):
        super().__init__(message)
        self.number = number


def save(trainer, path: Path) -> None:
    """Writes a checkpoint atomically, after the log of all earlier steps.

    Every process must call this function.
    """
    for logger in trainer.loggers:
        logger.save()
    if trainer.is_global_zero:
        with atomic_write(path) as part:
            trainer.save_checkpoint(part, weights_only=False)
            checkpoint.seal(part)
    else:  # takes part, and writes nothing
        trainer.save_checkpoint(path.with_suffix(".part"), weights_only=False)
    trainer.strategy.barrier()
