"""Placements: positions and strengths of the Gaussians for each query."""

from abc import ABC, abstractmethod
from collections.abc import Mapping

from jaxtyping import Float
from torch import Tensor, nn

from gaigs.core.query import Query
from gaigs.data import Links
from gaigs.splatting.gaussians import Gaussians, Placed


class Placement(nn.Module, ABC):
    """Base class of kind ``placement``; a constructor may take ``scene`` and ``channels``.

    Attributes:
        sees_receivers: True if the Gaussians of a transmitter depend on the receiver.
        model: Name of the only model that may use this placement, so that results named GAI-GS
            always have the paper's placement; None: any model.
        has_own: True if the placement itself makes Gaussians; the trainable ``Gaussians`` may then
            be missing.
        learning_rates: Default learning rate of each parameter group; ``training.learning_rates``
            overrides it.
        penalty_weights: Default weight of each penalty; ``training.penalties`` overrides it.
    """

    sees_receivers: bool = False
    model: str | None = None
    has_own: bool = False
    learning_rates: Mapping[str, float] = {"network": 1.6e-2}
    penalty_weights: Mapping[str, float] = {}

    @abstractmethod
    def forward(self, gaussians: Gaussians, query: Query) -> Placed:
        """The Gaussians of each link of a query.

        Args:
            gaussians: The trainable Gaussians; may be None for a placement with ``has_own``.
            query: The links.
        """

    def fit(self, links: Links) -> None:
        """Computes the placement's state from the links before training; by default nothing."""

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by the names in ``learning_rates``."""
        return {"network": list(self.parameters())}

    def penalties(self) -> dict[str, Float[Tensor, ""]]:
        """Terms added to the loss, by the names in ``penalty_weights``."""
        return {}
