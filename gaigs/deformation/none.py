"""No deformation: every transmitter excites the Gaussians alike."""

from gaigs.deformation import Deformation, Residuals
from gaigs.placement import Placed
from gaigs.query import Query
from gaigs.registry import register
from gaigs.tokenizer import Tokens


@register("deformation", "none")
class NoDeformation(Deformation):
    """Nothing changes, and no tokenizer is made: what is left are static Gaussians."""

    reads_tokens = False

    def forward(self, tokens: Tokens | None, placed: Placed, query: Query) -> Residuals:
        """No residuals."""
        return Residuals()
