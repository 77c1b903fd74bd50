"""Poolings turn a map over directions, or propagation paths, into the label of a receiver."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

from torch import Tensor, nn

from gaigs.data import Links
from gaigs.geometry import Directions, Grid
from gaigs.query import Query


class Pooling(nn.Module, ABC):
    """The contract of kind ``pooling``. A pooling reads maps; one of ``gaigs.pooling.paths.PathPooling`` reads paths.

    Attributes:
        channels: Real numbers that a Gaussian sends: channels of the map, or real and imaginary part of a path.
        grid: Directions of the map that it sums over. None: the label has a value for each direction, and the map is
            rendered in those asked for.
        zone: Lowest and highest elevation from which anything is heard, where the label has no direction for each pixel
            of the map [rad].
    """

    channels: int = 2
    grid: Grid | None = None
    zone: tuple[float, float] = (-math.pi / 2, math.pi / 2)

    def fit(self, links: Links) -> None:
        """Takes what can be computed from the training links at once; by default nothing."""

    @abstractmethod
    def forward(self, received, query: Query, directions: Directions | None = None) -> Tensor:
        """The label of each query (b, ...).

        Args:
            received: Maps (b, c, rows, columns), or ``ReceivedPaths``.
            query: The link of each map or set of paths; all to one receiver.
            directions: Directions asked for, where the label has a value for each and the pooling does not read them
                from the map; None for all of the task's.
        """


def sphere(option: str, shape: Sequence[int]) -> Grid:
    """A pooling's own grid from its option [rows, columns].

    Raises:
        ValueError: The option is not two whole numbers, or too few of either.
    """
    if not isinstance(shape, list | tuple) or len(shape) != 2 or not all(type(size) is int for size in shape):
        raise ValueError(f"{option} must be [rows, columns], two whole numbers, got {shape}")
    try:
        return Grid.sphere(*shape)
    except ValueError as error:
        raise ValueError(f"{option} must be of a sphere: {error}") from None
