"""Placements say where the Gaussians stand for each query, and how strong they are there."""

from abc import ABC, abstractmethod
from typing import NamedTuple

from jaxtyping import Complex, Float
from torch import Tensor, nn

from gaigs.data import Links
from gaigs.gaussians import Gaussians
from gaigs.query import Query


class Placed(NamedTuple):
    """The Gaussians of each query, before anything deforms them. What does not depend on the query has b = 1.

    Attributes:
        means: Centres, world frame (1, n, 3), or (b, n, 3) where they depend on the query [m].
        lengths: Of the path from the transmitter to the receiver that a Gaussian stands for, (b, n) [m]; None where a
            Gaussian says nothing of it.
        quats, scales, opacities, signal: As those of ``Gaussians``, of all n; scales (1, n, 3), or (b, n, 3) [m];
            signal (n, c, 1), or (b, n, c, 1). None: the free Gaussians' own.
        gains: Complex strength of each path's field (b, n), its phase included, by which the signal is multiplied.
            None: 1.
        coherences: Share of each path's field, in [0, 1] (n,), whose phase is known; the rest adds as power. None: 1.
        bandwidth: Of the band that powers are averaged over, a scalar [Hz]; None: one carrier.
    """

    means: Float[Tensor, "b n 3"]
    lengths: Float[Tensor, "b n"] | None = None
    quats: Float[Tensor, "n 4"] | None = None
    scales: Float[Tensor, "b n 3"] | None = None
    opacities: Float[Tensor, "n"] | None = None
    signal: Float[Tensor, "*b n c 1"] | None = None
    gains: Complex[Tensor, "b n"] | None = None
    coherences: Float[Tensor, "n"] | None = None
    bandwidth: Float[Tensor, ""] | None = None


class Placement(nn.Module, ABC):
    """The contract of kind ``placement``; a constructor is offered ``scene`` and ``channels``.

    Attributes:
        sees_receivers: Whether Gaussians stand elsewhere for another receiver of the same place.
        model: Name of the model that results with it go by; None: any. Numbers under the name GAI-GS are the paper's.
        has_own: Whether it brings Gaussians of its own, so that there need be no free ones.
    """

    sees_receivers: bool = False
    model: str | None = None
    has_own: bool = False

    @abstractmethod
    def forward(self, gaussians: Gaussians | None, query: Query) -> Placed:
        """The Gaussians of each query.

        Args:
            gaussians: Free ones, which stand where they were learnt to stand; None where there are none.
            query: Who sends, who hears, at which frequency.
        """

    def fit(self, links: Links) -> None:
        """Takes what can be computed before the training at once; by default nothing."""

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by the name of the learning rate they follow."""
        return {"network": list(self.parameters())}

    def penalties(self) -> dict[str, Float[Tensor, ""]]:
        """To be added to the loss, by name; by default none."""
        return {}
