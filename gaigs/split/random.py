"""Single rows are held out."""

from gaigs.data import Links, Split
from gaigs.registry import register
from gaigs.split import part, rows_of


@register("split", "random")
def random(links: Links, test: float = 0.2, validation: float = 0.1, seed: int = 0) -> Split:
    """Random rows test: interpolation, as on dense trajectories a neighbour is always near.

    Args:
        links: All links.
        test: Fraction of the links to test on.
        validation: Fraction of the training links to validate on; 0 for none.
        seed: Seed of all random numbers.

    Raises:
        ValueError: An option is out of range, or there are too few rows.
    """
    return part("random", links, rows_of(links), test, validation, seed)
