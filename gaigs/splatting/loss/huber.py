"""Huber's loss."""

from torch import Tensor
from torch.nn.functional import huber_loss

from gaigs.core.task import Task
from gaigs.registry import register
from gaigs.splatting.loss.errors import MeanError


@register("loss", "huber")
class Huber(MeanError):
    """A mean over errors: quadratic up to ``delta``, as error² / 2, and linear above.

    Args:
        delta: Error at which the loss becomes linear, in the label's unit (dB for RSSI).

    Raises:
        ValueError: ``delta`` is not positive, or the labels are complex.

    Source: Huber, Robust estimation of a location parameter, 1964.
    """

    def __init__(self, task: Task, delta: float = 5.0):
        super().__init__(task)
        if not delta > 0:
            raise ValueError(f"loss.delta must be more than 0, got {delta}")
        self.delta = delta

    def mean(self, values: Tensor, labels: Tensor) -> Tensor:
        return huber_loss(values, labels, delta=self.delta)
