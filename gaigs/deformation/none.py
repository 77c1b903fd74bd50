"""No deformation: every transmitter excites the Gaussians alike."""

from gaigs.deformation import Deformation, Residuals
from gaigs.gaussians import Placed, Tokens
from gaigs.query import Query
from gaigs.registry import register


@register("deformation", "none")
class NoDeformation(Deformation):
    """No change and no tokenizer: static Gaussians."""

    reads_tokens = False

    def forward(self, tokens: Tokens | None, placed: Placed, query: Query) -> Residuals:
        return Residuals()
