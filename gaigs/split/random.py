"""Single rows are held out."""

from gaigs.data import Links, Split
from gaigs.registry import register
from gaigs.split import part, rows_of


@register("split", "random")
def random(links: Links, test: float = 0.2, validation: float = 0.1, seed: int = 0) -> Split:
    """Random rows test: interpolation, since a neighbour on a dense trajectory is always near.

    Options and errors are those of ``gaigs.split.part``.
    """
    return part("random", links, rows_of(links), test, validation, seed)
