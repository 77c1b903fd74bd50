"""No deformation: the Gaussians are equal for all transmitters."""

from gaigs.core.query import Query
from gaigs.registry import register
from gaigs.splatting.deformation import Deformation, Residuals
from gaigs.splatting.gaussians import Placed, Tokens


@register("deformation", "none")
class NoDeformation(Deformation):
    """No change and no tokenizer: static Gaussians."""

    reads_tokens = False

    def forward(self, tokens: Tokens | None, placed: Placed, query: Query) -> Residuals:
        return Residuals()
