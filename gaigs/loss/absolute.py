"""Mean absolute error."""

from torch import Tensor

from gaigs.loss.errors import MeanError
from gaigs.registry import register


@register("loss", "absolute")
class Absolute(MeanError):
    """The magnitude is what is reported, and robust: a label that is far off pulls no harder than another."""

    def mean(self, values: Tensor, labels: Tensor) -> Tensor:
        return (values - labels).abs().mean()
