"""Mean absolute error."""

from torch import Tensor

from gaigs.loss.errors import MeanError
from gaigs.registry import register


@register("loss", "absolute")
class Absolute(MeanError):
    """The mean absolute error, which is also reported; outliers pull no harder than other labels."""

    def mean(self, values: Tensor, labels: Tensor) -> Tensor:
        return (values - labels).abs().mean()
