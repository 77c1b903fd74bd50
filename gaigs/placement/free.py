"""The paper's placement: each Gaussian stands where it was learnt to stand, for every transmitter."""

from gaigs.gaussians import Gaussians
from gaigs.placement import Placed, Placement
from gaigs.query import Query
from gaigs.registry import register


@register("placement", "free")
class Free(Placement):
    """The Gaussians' own means.

    Source: GAI-GS, section "Framework".
    """

    def forward(self, gaussians: Gaussians, query: Query) -> Placed:
        """Where the Gaussians stand, whoever sends."""
        return Placed(gaussians.means[None])
