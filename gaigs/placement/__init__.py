"""Placements say where the Gaussians stand for each transmitter."""

from abc import ABC, abstractmethod
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor, nn

from gaigs.gaussians import Gaussians
from gaigs.query import Query


class Placed(NamedTuple):
    """Where the Gaussians stand.

    Attributes:
        means: Centres, world frame (1, n, 3), or (b, n, 3) where they depend on the query [m].
        lengths: Of the path from the transmitter by way of the Gaussian's images, (b, n) [m]; None where a Gaussian
            says nothing of it.
    """

    means: Float[Tensor, "b n 3"]
    lengths: Float[Tensor, "b n"] | None = None


class Placement(nn.Module, ABC):
    """The contract of kind ``placement``; a constructor is offered ``scene``.

    Attributes:
        sees_receivers: Whether Gaussians stand elsewhere for another receiver of the same place.
    """

    sees_receivers: bool = False

    @abstractmethod
    def forward(self, gaussians: Gaussians, query: Query) -> Placed:
        """Where the Gaussians stand for each query."""
