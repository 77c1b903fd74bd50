"""Single places are held out."""

from gaigs.data import Links, Split
from gaigs.registry import register
from gaigs.split import part, places_of, rows_of


@register("split", "random")
def random(
    links: Links, test: float = 0.2, validation: float | None = None, seed: int = 0
) -> Split:
    """Random places test. This measures interpolation: on a dense trajectory a neighbour is always
    near.

    Options and errors: see ``gaigs.split.part``.
    """
    return part("random", links, places_of(links), test, validation, seed, rows=rows_of(links))
