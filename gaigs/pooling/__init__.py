"""Poolings turn the map over directions into what the receiver reports."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

from jaxtyping import Complex, Float
from torch import Tensor, nn

from gaigs.data import Links
from gaigs.directions import Directions, Grid
from gaigs.query import Query


class Pooling(nn.Module, ABC):
    """The contract of kind ``pooling``.

    Attributes:
        channels: How many the rasterizer shall render.
        grid: Directions of the map that it sums over; None where a label has a value for each direction, and the map is
            rendered in those asked for.
        zone: Lowest and highest elevation from which anything is heard, where it has a grid of its own [rad].
        takes: What it takes of a rasterizer without pixels: ``lags`` or ``fields`` of ``aperture``; None: it takes maps
            alone.
    """

    channels: int
    grid: Grid | None = None
    zone: tuple[float, float] = (-math.pi / 2, math.pi / 2)
    takes: str | None = None

    def fit(self, links: Links) -> None:
        """Takes what can be computed from the training links at once; by default nothing."""

    @abstractmethod
    def forward(
        self, image: Float[Tensor, "b c rows columns"], query: Query, directions: Directions | None = None
    ) -> Tensor:
        """What the receiver reports of each map (b, ...).

        Args:
            image: Maps.
            query: The link of each map; all to one receiver.
            directions: Those asked for, where the label has one value for each and the map a grid of its own; None: all
                of the task's.
        """

    def hear(self, heard: Complex[Tensor, "b ..."], query: Query, directions: Directions | None = None) -> Tensor:
        """What the receiver reports of what ``aperture`` gives it, as ``takes`` says.

        Args:
            heard: Lags (b, l) or fields (b, e, s).
            query, directions: As for ``forward``.
        """
        raise NotImplementedError


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
