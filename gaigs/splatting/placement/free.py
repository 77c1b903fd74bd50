"""The paper's placement: Gaussians at their learnt positions, for every transmitter."""

from gaigs.core.query import Query
from gaigs.registry import register
from gaigs.splatting.gaussians import Gaussians, Placed
from gaigs.splatting.placement import Placement


@register("placement", "free")
class Free(Placement):
    """Gaussians at their trainable means, for every query.

    Source: GAI-GS, section "Framework".
    """

    def forward(self, gaussians: Gaussians, query: Query) -> Placed:
        return Placed(gaussians.means[None])  # (1, n, 3)
