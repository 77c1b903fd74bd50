"""Contiguous runs of rows are held out."""

from gaigs.data import Links, Split
from gaigs.registry import register
from gaigs.split import part, runs_of


@register("split", "runs")
def runs(links: Links, length: int, test: float = 0.2, validation: float = 0.1, seed: int = 0) -> Split:
    """Random runs test: a trajectory with gaps.

    Args:
        links: All links; their rows are in the order of measurement.
        length: Rows in a run.
        test: Fraction of the links to test on.
        validation: Fraction of the training links to validate on; 0 for none.
        seed: Seed of all random numbers.

    Raises:
        ValueError: An option is out of range, or there are too few runs.
    """
    return part(f"runs of {length}", links, runs_of(links, length), test, validation, seed)
