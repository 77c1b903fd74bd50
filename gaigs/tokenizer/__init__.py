"""Tokenizers embed the query, the Gaussians and the scene as a whole."""

from typing import NamedTuple

from jaxtyping import Float
from torch import Tensor


class Tokens(NamedTuple):
    """What a deformation sees; any width may be 0.

    Attributes:
        scene: CLS, one a query (b, d_scene).
        gaussians: E(P_x), one a Gaussian (n, d_x), or one for each query and Gaussian (b, n, d_x).
        transmitters: E(P_TX), one a query (b, d_tx).

    Source: GAI-GS, "Multi-view Tokenizer".
    """

    scene: Float[Tensor, "b d_scene"]
    gaussians: Float[Tensor, "*b n d_x"]
    transmitters: Float[Tensor, "b d_tx"]
