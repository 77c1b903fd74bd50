"""The progress line of a training."""

import time

from lightning.pytorch.callbacks import ProgressBar

from gaigs.core import stages
from gaigs.training.budget import share_done


class ProgressLine(ProgressBar):
    """One line in the terminal of the first process: steps, rate, time left, loss, validation
    score.

    Lightning's progress bars count batches of an epoch; a run counts steps.
    """

    def disable(self) -> None:
        """Called by Lightning in all other processes; their lines are always hidden."""

    def on_train_start(self, trainer, module) -> None:
        self.line = stages.make_bars(disable=not trainer.is_global_zero)
        self.start = time.monotonic()
        self.first = trainer.global_step
        self.share_done = share_done(trainer)
        self.task = self.line.add_task("training", total=1, **self._done(trainer), scores="")
        self.line.start()
        if trainer.is_global_zero:
            stages.current().bars = self.line  # of stages within the training, too

    def on_train_batch_end(self, trainer, module, outputs, *_) -> None:
        monitor = module.task.monitor
        scores = f"loss {outputs['loss']:.3f}"
        if (score := trainer.progress_bar_metrics.get(f"validation/{monitor}")) is not None:
            scores += f" {monitor} {score:.3f}"
        self.line.update(self.task, **self._done(trainer), scores=scores)

    def _done(self, trainer) -> dict:
        """Fields of the line after a step: fraction of the training, count and rate of steps."""
        step = trainer.global_step
        last = trainer.max_steps
        count = f"{step:{len(str(last))}d}/{last}" if last > 0 else f"{step} steps"
        rate = (step - self.first) / max(time.monotonic() - self.start, 1e-9)
        return {"completed": self.share_done(step), "count": f"{count} {rate:.1f} steps/s"}

    def on_train_end(self, trainer, module) -> None:
        self.line.stop()
        stages.current().bars = None

    def on_exception(self, trainer, module, exception) -> None:
        if hasattr(self, "line"):
            self.on_train_end(trainer, module)
