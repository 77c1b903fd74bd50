"""Few rows train."""

import torch

from gaigs.data import Links, Split
from gaigs.registry import register
from gaigs.split import check, check_fractions, generator_of, hold_out, rows_of


@register("split", "sparse")
def sparse(links: Links, train: int, test: float = 0.2, validation: float = 0.1, seed: int = 0) -> Split:
    """Few random rows train and validate, a smaller number being a subset of a larger; test rows are as for ``random``.

    Args:
        links: All links.
        train: Rows to train and validate on.
        test: Fraction of the links to test on.
        validation: Fraction of the training links to validate on; 0 for none.
        seed: Seed of all random numbers.

    Raises:
        ValueError: An option is out of range, or there are too few rows.
    """
    check_fractions(test, validation)
    rows, generator = rows_of(links), generator_of(seed)
    training, testing = hold_out("test", torch.arange(len(links)), rows, test, generator)
    present = rows[training].unique()
    check("train", train, 1 <= train <= len(present), f"in 1..{len(present)}, the rows that do not test")
    chosen = present[torch.randperm(len(present), generator=generator)[:train]]
    training = training[torch.isin(rows[training], chosen)]
    training, validating = hold_out("validation", training, rows, validation, generator)
    words = [f"sparse {train}", f"test {test:g}", *([f"validation {validation:g}"] if validation else [])]
    return Split(", ".join([*words, f"seed {seed}"]), training, validating, testing)
