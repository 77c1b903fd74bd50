"""Mean absolute error."""

from torch import Tensor

from gaigs.registry import register
from gaigs.splatting.loss.errors import MeanError


@register("loss", "absolute")
class Absolute(MeanError):
    """Mean absolute error; outliers have no more effect than other labels."""

    def mean(self, values: Tensor, labels: Tensor) -> Tensor:
        return (values - labels).abs().mean()
