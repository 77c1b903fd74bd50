"""Normalised mean squared error of complex channels."""

from torch import Tensor

from gaigs.geometry import FAINTEST
from gaigs.query import Batch
from gaigs.registry import register
from gaigs.task import Task


@register("loss", "nmse")
class Nmse:
    """The mean over the links of |h - h'|² / |h|²: each link counts alike, however weak its channel is.

    Args:
        task: Whose labels are compared.

    Raises:
        ValueError: The labels are real.

    Source: NeWRF, 2024.
    """

    def __init__(self, task: Task):
        if not task.dtype.is_complex:
            raise ValueError(
                f"labels of task {task.name!r} are real, and loss 'nmse' takes complex channels; take loss=squared"
            )

    def __call__(self, values: Tensor, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, which is its only term; see ``gaigs.loss.Loss``."""
        # Scaled by the strongest entry, so that squares of weak channels do not underflow; a denormal has no inverse.
        labels = batch.labels.flatten(1)
        largest = labels.abs().amax(1, keepdim=True).clamp_min(FAINTEST)
        errors, powers = ((part / largest).abs().square().sum(1) for part in (values.flatten(1) - labels, labels))
        nmse = (errors / powers).mean()
        return nmse, {"nmse": nmse}
