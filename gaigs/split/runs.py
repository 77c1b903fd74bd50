"""A split that holds out contiguous runs of rows."""

from gaigs.data import Links, Split
from gaigs.registry import register
from gaigs.split import part, runs_of


@register("split", "runs")
def runs(
    links: Links, length: int, test: float = 0.2, validation: float | None = None, seed: int = 0
) -> Split:
    """Tests on random runs of rows: the gaps in a trajectory.

    Args:
        length: Rows in a run. Other options and errors: see ``gaigs.split.part``.
    """
    return part(f"runs of {length}", links, runs_of(links, length), test, validation, seed)
