"""The parts that came with the data."""

import torch

from gaigs.data import Links, Split
from gaigs.registry import register
from gaigs.split import check, hold_out, rows_of


@register("split", "official")
def official(links: Links, length: int = 1, validation: float = 0.1, seed: int = 0) -> Split:
    """The data's own training and test links; validation links are drawn from the training links.

    Args:
        links: All of them.
        length: Rows in a run that validates; more than 1 where the test is a run of its own.
        validation: Fraction of the training links to validate on; 0 for none.
        seed: Of the validation links.

    Raises:
        ValueError: The data came without such parts, or an option is out of range.
    """
    if links.official is None:
        raise ValueError("this data has no official split; choose split=random, sparse, runs or blocks")
    check("length", length, length >= 1, "a whole number of rows, at least 1")
    check("validation", validation, 0 <= validation < 1, "in [0, 1)")
    train, test = (part.sort().values for part in links.official())
    generator = torch.Generator().manual_seed(seed)
    train, validating = hold_out(train, rows_of(links) // length, validation, generator)
    words = ["official"]
    if validation:
        words += [f"validation {validation:g}{f' in runs of {length}' if length > 1 else ''}", f"seed {seed}"]
    return Split(", ".join(words), train, validating, test)
