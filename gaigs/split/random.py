"""A split that holds out random places."""

from gaigs.data import Links, Split
from gaigs.registry import register
from gaigs.split import part, places_of, rows_of


@register("split", "random")
def random(
    links: Links, test: float = 0.2, validation: float | None = None, seed: int = 0
) -> Split:
    """Tests on random places. This measures interpolation, as a known place is always near.

    Options and errors: see ``gaigs.split.part``.
    """
    return part("random", links, places_of(links), test, validation, seed, rows=rows_of(links))
