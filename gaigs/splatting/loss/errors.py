"""Base class of the losses that average a function of the error."""

from abc import ABC, abstractmethod

from torch import Tensor

from gaigs.core.query import Batch
from gaigs.core.task import Task


class MeanError(ABC):
    """A mean over the errors of all links and directions.

    Args:
        task: Task of the labels.
    """

    def __init__(self, task: Task):
        if task.dtype.is_complex:
            raise ValueError(
                f"labels of task {task.name!r} are complex, not real; set loss=log_relative_error"
            )

    def __call__(self, values: Tensor, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and the mean absolute error in the label's unit."""
        mean_error = (values - batch.labels).abs().mean()
        return self.mean(values, batch.labels), {"mae": mean_error}

    @abstractmethod
    def mean(self, values: Tensor, labels: Tensor) -> Tensor:
        """The loss, without terms for the log."""
