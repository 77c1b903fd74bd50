"""The logarithm of the relative error of complex channels."""

from jaxtyping import Float
from torch import Tensor

from gaigs.loss.relative_error import RelativeError
from gaigs.registry import register
from gaigs.task import Task


@register("loss", "log_relative_error")
class LogRelativeError(RelativeError):
    """The mean over the links of ln((1 + r / floor) / (1 + r floor)), r = |h - h'|² / |h|²: the SNR between two bounds.

    Between an SNR of 10 log10(floor) dB and its negative the loss is in proportion to the SNR in dB, so each link has
    one vote. Beyond, a link pulls less and less: what is that good needs no more, and a link that is 30 dB weaker than
    anything that explains it does not dim the room around it.

    Args:
        task: Whose labels are compared.
        floor: Relative error below which little is gained, and over whose inverse little is lost; 1e-3 is 30 dB.

    Raises:
        ValueError: The floor is not in (0, 1), or the labels are real.

    Source: ours; docs/results.md has what other losses cost.
    """

    name = "log_relative_error"

    def __init__(self, task: Task, floor: float = 1e-3):
        super().__init__(task)
        if not 0 < floor < 1:
            raise ValueError(f"loss.floor must be more than 0 and less than 1, got {floor}")
        self.floor = floor

    def mean(self, errors: Float[Tensor, "b"]) -> Float[Tensor, ""]:
        return ((errors / self.floor).log1p() - (errors * self.floor).log1p()).mean()
