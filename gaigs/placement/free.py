"""The paper's placement: Gaussians at their learnt positions, for every transmitter."""

from gaigs.gaussians import Gaussians, Placed
from gaigs.placement import Placement
from gaigs.query import Query
from gaigs.registry import register


@register("placement", "free")
class Free(Placement):
    """The Gaussians' own means.

    Source: GAI-GS, section "Framework".
    """

    def forward(self, gaussians: Gaussians, query: Query) -> Placed:
        return Placed(gaussians.means[None])
