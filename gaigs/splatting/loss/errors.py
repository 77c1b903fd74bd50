"""Common part of the losses that average a function of the error."""

from abc import ABC, abstractmethod

from torch import Tensor

from gaigs.core.query import Batch
from gaigs.core.task import Task


class MeanError(ABC):
    """A mean over the errors of all links and directions, in the label's unit."""

    def __init__(self, task: Task):
        if task.dtype.is_complex:
            raise ValueError(
                f"labels of task {task.name!r} are complex, not real; set loss=log_relative_error"
            )

    def __call__(self, values: Tensor, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and the mean absolute error."""
        errors = values - batch.labels
        return self.mean(values, batch.labels), {"mae": errors.abs().mean()}

    @abstractmethod
    def mean(self, values: Tensor, labels: Tensor) -> Tensor:
        """The loss alone."""
