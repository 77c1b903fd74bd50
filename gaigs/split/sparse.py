"""Few rows train."""

from gaigs.data import Links, Split
from gaigs.registry import register
from gaigs.split import part, rows_of


@register("split", "sparse")
def sparse(links: Links, train: int, test: float = 0.2, validation: float = 0.1, seed: int = 0) -> Split:
    """Few random rows train and validate, fewer as a subset of more; test rows are those of ``random``.

    Args:
        train: Rows to train and validate on. Other options and errors are those of ``gaigs.split.part``.
    """
    return part(f"sparse {train}", links, rows_of(links), test, validation, seed, train)
