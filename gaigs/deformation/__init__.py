"""Deformations say how each Gaussian changes for a query, from the tokens."""

from abc import ABC, abstractmethod
from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor, nn

from gaigs.placement import Placed
from gaigs.query import Query
from gaigs.tokenizer import Tokens


class Residuals(NamedTuple):
    """What a query changes in the Gaussians; None where nothing does.

    Source: GAI-GS, "Scene Mapping Network": d_rotation, d_scaling, d_signal, d_attn and the attenuation delta.
    """

    delta_quats: Float[Tensor, "b n 4"] | None = None
    delta_scales: Float[Tensor, "b n 3"] | None = None
    delta_signal: Float[Tensor, "b n c k"] | None = None
    delta_opacities: Float[Tensor, "b n"] | None = None
    attenuations: Float[Tensor, "b n"] | None = None


class Deformation(nn.Module, ABC):
    """The contract of kind ``deformation``; a constructor is offered ``scene``, ``channels`` and ``tokenizer_widths``.

    Attributes:
        reads_tokens: Whether it looks at tokens; where it does not, no tokenizer is made.
        sees_receivers: Whether two receivers of one place hear differently changed Gaussians.
    """

    reads_tokens: bool = True
    sees_receivers: bool = False

    @abstractmethod
    def forward(self, tokens: Tokens | None, placed: Placed, query: Query) -> Residuals:
        """What each query changes.

        Args:
            tokens: Of the queries and Gaussians; None where it reads none.
            placed: Where the Gaussians stand, without a gradient.
            query: Who sends, who hears, at which frequency.
        """
