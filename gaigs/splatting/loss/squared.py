"""Mean squared error."""

from torch import Tensor

from gaigs.registry import register
from gaigs.splatting.loss.errors import MeanError


@register("loss", "squared")
class Squared(MeanError):
    """Mean squared error; predictions that minimise it are the mean of the labels at a place."""

    def mean(self, values: Tensor, labels: Tensor) -> Tensor:
        return (values - labels).square().mean()
