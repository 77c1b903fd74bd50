"""What the losses share that average a function of the error."""

from torch import Tensor

from gaigs.query import Batch
from gaigs.task import Task


class MeanError:
    """A mean over the errors of all links and directions, in the label's unit.

    Args:
        task: Whose labels are compared.

    Raises:
        ValueError: The labels are complex.
    """

    def __init__(self, task: Task):
        if task.dtype.is_complex:
            raise ValueError(
                f"labels of task {task.name!r} are complex, and this loss takes real ones; take loss=log_relative_error"
            )

    def __call__(self, values: Tensor, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and the mean absolute error; see ``gaigs.loss.Loss``."""
        errors = values - batch.labels
        return self.mean(values, batch.labels), {"mae": errors.abs().mean()}

    def mean(self, values: Tensor, labels: Tensor) -> Tensor:
        """The loss alone."""
        raise NotImplementedError
