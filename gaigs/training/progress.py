"""The progress line of a training."""

import time

from lightning.pytorch.callbacks import ProgressBar
from rich.progress import BarColumn, Progress, TimeRemainingColumn

from gaigs.training.budget import share_done


class ProgressLine(ProgressBar):
    """Steps, their rate, the time left, loss and validation score in one line of the first process's terminal.

    Lightning's progress bars count the batches of an epoch, and a run counts steps.
    """

    def disable(self) -> None:
        """Called by Lightning in all other processes, whose lines are hidden from the start."""

    def on_train_start(self, trainer, module) -> None:
        bar, left = BarColumn(None), TimeRemainingColumn()
        count, rate, scores = "{task.fields[count]}", "{task.fields[rate]:.1f} steps/s", "{task.fields[scores]}"
        hidden = not trainer.is_global_zero
        self.line = Progress("training", bar, count, rate, left, scores, expand=True, disable=hidden)
        self.start, self.first, self.share_done = time.monotonic(), trainer.global_step, share_done(trainer)
        self.task = self.line.add_task("", total=1, **self._done(trainer), rate=0, scores="")
        self.line.start()

    def on_train_batch_end(self, trainer, module, outputs, *_) -> None:
        step, monitor = trainer.global_step, module.task.monitor
        rate = (step - self.first) / (time.monotonic() - self.start)
        scores = f"loss {outputs['loss']:.3f}"
        if (score := trainer.progress_bar_metrics.get(f"validation/{monitor}")) is not None:
            scores += f" {monitor} {score:.3f}"
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
