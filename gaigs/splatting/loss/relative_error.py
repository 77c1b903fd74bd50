"""The relative error of complex channels."""

from jaxtyping import Float
from torch import Tensor

from gaigs.core.geometry import FAINTEST
from gaigs.core.query import Batch
from gaigs.core.task import Task
from gaigs.registry import register


@register("loss", "relative_error")
class RelativeError:
    """The mean over the links of r = |h - h'|² / |h|².

    ``Task.align`` removes unknown phases and delays of labels.

    A link in deep shadow outweighs all others, so predictions near zero minimise this mean over a
    room. ``log_relative_error`` does not have this fault.

    Args:
        task: Task of the labels, which are complex.

    Raises:
        ValueError: The labels are real.

    Source: NeWRF, 2024, where it is called NMSE.
    """

    name = "relative_error"

    def __init__(self, task: Task):
        if not task.dtype.is_complex:
            raise ValueError(
                f"labels of task {task.name!r} are real, not complex channels; set loss=squared"
            )
        self.task = task

    def __call__(self, values: Tensor, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, which is its only term."""
        labels = self.task.align(batch.labels, values).flatten(1)  # (b, e s)
        # Scaled by the strongest entry, so that squares of weak channels do not underflow;
        # denormals have no inverse.
        largest = labels.abs().amax(1, keepdim=True).clamp_min(FAINTEST)  # (b, 1)
        errors = ((values.flatten(1) - labels) / largest).abs().square().sum(1)  # (b,)
        powers = (labels / largest).abs().square().sum(1)  # (b,)
        loss = self.mean(errors / powers)
        return loss, {self.name: loss}

    def mean(self, errors: Float[Tensor, " b"]) -> Float[Tensor, ""]:
        """The loss for the links' relative errors."""
        return errors.mean()
