"""Losses compare predicted values with labels."""

from typing import Protocol, runtime_checkable

from torch import Tensor

from gaigs.core.query import Batch


@runtime_checkable
class Loss(Protocol):
    """Base class of components of kind ``loss``; a constructor takes the labels' ``task``."""

    def __call__(self, values: Tensor, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """Compares predictions with the labels of a batch.

        Args:
            values: Predictions for the batch's directions, of the labels' shape.
            batch: Links with labels.

        Returns:
            The loss, a mean over the links, and its terms by name for the log.
        """
        ...
