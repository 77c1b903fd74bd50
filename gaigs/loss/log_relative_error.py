"""The logarithm of the relative error of complex channels."""

from jaxtyping import Float
from torch import Tensor

from gaigs.loss.relative_error import RelativeError
from gaigs.registry import register
from gaigs.task import Task


@register("loss", "log_relative_error")
class LogRelativeError(RelativeError):
    """The mean over the links of ln(1 + r / floor), r = |h - h'|² / |h|²: near the SNR in dB, each link with one vote.

    A link pulls by r / (r + floor) of what it would pull by if its error had to vanish: by 1 at the most, however deep
    its shadow is, and by less and less once its error is below the floor.

    Args:
        task: Whose labels are compared.
        floor: Relative error below which little is gained; 1e-3 is an SNR of 30 dB.

    Raises:
        ValueError: The floor is not positive, or the labels are real.

    Source: ours; docs/methods.md has what other losses cost.
    """

    name = "log_relative_error"

    def __init__(self, task: Task, floor: float):
        super().__init__(task)
        if not floor > 0:
            raise ValueError(f"loss.floor must be more than 0, got {floor}")
        self.floor = floor

    def mean(self, errors: Float[Tensor, "b"]) -> Float[Tensor, ""]:
        return (errors / self.floor).log1p().mean()
