"""The parts that came with the data."""

from gaigs.data import Links, Split
from gaigs.registry import register
from gaigs.split import check, generator_of, hold_out, rows_of, runs_of


@register("split", "official")
def official(links: Links, length: int = 1, validation: float = 0.1, seed: int = 0) -> Split:
    """The data's own training and test links; validation links are drawn from the training links.

    Args:
        length: Rows in a run that validates; more than 1 if the test is a separate run. Runs are shorter where fewer
            than four would validate.
        validation: Fraction of the training links to validate on, with runs the most; 0 for none.

    Raises:
        ValueError: The data have no such parts, or an option is out of range.
    """
    if links.official is None:
        raise ValueError("this data has no official split; choose split=random, sparse, runs or blocks")
    check("length", length, length >= 1, "a whole number of rows, at least 1")
    check("validation", validation, 0 <= validation < 1, "in [0, 1)")
    generator = generator_of(seed)
    train, test = (part.sort().values for part in links.official())
    length = min(length, max(1, int(validation * len(rows_of(links)[train].unique()) / 4)))
    runs = runs_of(links, length)
    train, validating = hold_out("validation", train, runs, validation, generator, at_most=length > 1)
    words = ["official"]
    if validation:
        words += [f"validation {validation:g}{f' in runs of {length}' if length > 1 else ''}", f"seed {seed}"]
    return Split(", ".join(words), train, validating, test, runs)
