"""The logarithm of the relative error of complex channels."""

from jaxtyping import Float
from torch import Tensor

from gaigs.core.task import Task
from gaigs.registry import register
from gaigs.splatting.loss.relative_error import RelativeError


@register("loss", "log_relative_error")
class LogRelativeError(RelativeError):
    """The mean over the links of ln((1 + r / floor) / (1 + r floor)), r = |h - h'|² / |h|².

    r is the relative error of a link with the label h and the prediction h'. The SNR of a link is
    -10 log10 r [dB]. Between the bounds -10 log10(floor) and 10 log10(floor) dB the loss is linear
    in the SNR, so all links have equal weight. Outside the bounds the weight of a link falls.

    Args:
        task: Task of the labels, which are complex.
        floor: Relative error at the upper bound, and inverse of the relative error at the lower
            bound. 1e-3 is 30 dB.

    Raises:
        ValueError: The floor is not in (0, 1), or the labels are real.

    Source: ours; docs/results.md compares losses.
    """

    name = "log_relative_error"

    def __init__(self, task: Task, floor: float = 1e-3):
        super().__init__(task)
        if not 0 < floor < 1:
            raise ValueError(f"loss.floor must be more than 0 and less than 1, got {floor}")
        self.floor = floor

    def mean(self, errors: Float[Tensor, " b"]) -> Float[Tensor, ""]:
        above = (errors / self.floor).log1p()
        below = (errors * self.floor).log1p()
        return (above - below).mean()
