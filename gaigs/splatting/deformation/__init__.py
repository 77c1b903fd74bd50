"""Deformations predict the change of each Gaussian for a query from the tokens."""

from abc import ABC, abstractmethod
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor, nn

from gaigs.core.query import Query
from gaigs.splatting.gaussians import Placed, Tokens


class Residuals(NamedTuple):
    """Changes of the Gaussians for a query. A change that is None does not occur.

    Attributes:
        delta_quats: d_rotation, added to the unit quaternions.
        delta_scales: d_scaling, added to the standard deviations [m].
        delta_signal: d_signal, added to the coefficients of the signal.
        delta_opacities: d_attn, added to the opacities.
        attenuations: delta in (0, 1], the fraction of the field that a Gaussian transmits.

    Source: GAI-GS, "Scene Mapping Network"; eq. (11) for delta.
    """

    delta_quats: Float[Tensor, "b n 4"] | None = None
    delta_scales: Float[Tensor, "b n 3"] | None = None
    delta_signal: Float[Tensor, "b n c k"] | None = None
    delta_opacities: Float[Tensor, "b n"] | None = None
    attenuations: Float[Tensor, "b n"] | None = None


class Deformation(nn.Module, ABC):
    """Base class of components of kind ``deformation``.

    A constructor may take ``scene``; ``channels``, the number of signal channels;
    ``tokenizer_widths``; and ``count``, the number of Gaussians. ``count`` is None if a placement
    adds further Gaussians.

    Attributes:
        reads_tokens: True if the deformation needs tokens; if False, no tokenizer is built.
        sees_receivers: True if the residuals depend on the receiver.
        follows: Names of parameters with a row for each Gaussian; density control prunes and copies
            their rows.
        learning_rate: Rate of the parameter group ``network``; None: the model's default.
    """

    reads_tokens: bool = True
    sees_receivers: bool = False
    follows: tuple[str, ...] = ()
    learning_rate: float | None = None

    @abstractmethod
    def forward(self, tokens: Tokens, placed: Placed, query: Query) -> Residuals:
        """Predicts the residuals for each query.

        Args:
            tokens: Tokens of the queries and Gaussians; None if ``reads_tokens`` is False.
            placed: Placed Gaussians, without a gradient.
            query: The links.
        """
