"""A split with few training places."""

from gaigs.data import Links, Split
from gaigs.registry import register
from gaigs.split import part, places_of, rows_of


@register("split", "sparse")
def sparse(
    links: Links, train: int, test: float = 0.2, validation: float | None = None, seed: int = 0
) -> Split:
    """Trains and validates on few random places; test places are as with ``random``.

    With the same seed a smaller number of places is a subset of a larger one.

    Args:
        train: Number of places to train and validate on. Other options and errors are as for
            ``gaigs.split.part``.
    """
    return part(
        f"sparse {train}", links, places_of(links), test, validation, seed, train, rows_of(links)
    )
