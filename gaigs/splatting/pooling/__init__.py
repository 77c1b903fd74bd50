"""Poolings convert a map over directions, or propagation paths, into the label of a receiver."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

from torch import Tensor, nn

from gaigs.core.geometry import Directions, Grid
from gaigs.core.query import Query
from gaigs.data import Links


class Pooling(nn.Module, ABC):
    """Base class of kind ``pooling``. A pooling reads maps; a ``PathPooling`` reads paths.

    Attributes:
        channels: Number of real values that a Gaussian emits: channels of the map, or real and
            imaginary part of a path.
        grid: Directions of the map that the pooling sums. None: the map is rendered in the label's
            directions.
        zone: Lowest and highest elevation from which the receiver gets power [rad]; used with
            ``grid``.

    Source: the final step of GAI-GS, "Projection and Render Module".
    """

    channels: int = 2
    grid: Grid | None = None
    zone: tuple[float, float] = (-math.pi / 2, math.pi / 2)

    def fit(self, links: Links) -> None:
        """Computes the state of the pooling from training links; by default nothing."""

    @abstractmethod
    def forward(self, received, query: Query, directions: Directions | None = None) -> Tensor:
        """The label of each query (b, ...).

        Args:
            received: Maps (b, c, rows, columns), or ``ReceivedPaths``.
            query: The link of each map or set of paths. All links are to one receiver.
            directions: Requested directions of the label, if different from the map's. None: the
                directions of the task.
        """


def sphere(option: str, shape: Sequence[int]) -> Grid:
    """The part of a grid over the sphere that a pooling sums, from its option [rows, columns].

    Args:
        option: Name of the option, for errors.
        shape: Rows and columns of the map over the full sphere.
    """
    if len(shape) != 2:
        raise ValueError(f"{option} must be [rows, columns], got {list(shape)}")
    return Grid.sphere(*shape)
