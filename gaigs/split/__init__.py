"""Splits of links into training, validation and test; only official parts may separate links of one row."""

import torch
from jaxtyping import Int
from torch import Tensor

from gaigs.data import Links, Split


def rows_of(links: Links) -> Int[Tensor, " n"]:
    """Row of each link in the order of measurement."""
    return torch.arange(len(links)) if links.rows is None else links.rows


def part(
    name: str,
    links: Links,
    groups: Int[Tensor, " n"],
    test: float,
    validation: float,
    seed: int,
    train: int | None = None,
) -> Split:
    """Holds out whole groups of links, first for the test and then in the same way for validation.

    Args:
        name: Name of the protocol, with its own options.
        links: All links.
        groups: Number of each link's group.
        test: Fraction of the links to test on; 0 for none.
        validation: Fraction of the training links to validate on; 0 for none.
        seed: Seed of all random numbers.
        train: Groups to train and validate on; None for all that do not test.

    Raises:
        ValueError: An option is out of range, or there are too few groups.
    """
    check("test", test, 0 <= test < 1, "in [0, 1)")
    check("validation", validation, 0 <= validation < 1, "in [0, 1)")
    generator = generator_of(seed)
    training, testing = hold_out("test", torch.arange(len(links)), groups, test, generator)
    if train is not None:
        present = groups[training].unique()
        check("train", train, 1 <= train <= len(present), f"in 1..{len(present)}, the rows that do not test")
        chosen = present[torch.randperm(len(present), generator=generator)[:train]]
        training = training[torch.isin(groups[training], chosen)]
    training, validating = hold_out("validation", training, groups, validation, generator)
    words = [name, f"test {test:g}", *([f"validation {validation:g}"] if validation else []), f"seed {seed}"]
    return Split(", ".join(words), training, validating, testing, groups)


def hold_out(
    name: str,
    links: Int[Tensor, " k"],
    groups: Int[Tensor, " n"],
    fraction: float,
    generator: torch.Generator,
    at_most: bool = False,
) -> tuple[Int[Tensor, " kept"], Int[Tensor, " held"]]:
    """Holds out random whole groups, as near to a fraction of some ascending links as possible.

    With ``at_most`` it is not more than the fraction, if one group is not. The groups are those of all links of the
    data; there must be two or more. An error calls the fraction ``name``.
    """
    if not fraction:
        return links, links[:0]
    present, sizes = torch.unique(groups[links], return_counts=True)
    if len(present) < 2:
        without = ", or set split.validation=0" if name == "validation" else ""
        raise ValueError(
            f"split.{name}={fraction:g} holds out whole rows, runs or cubes, so there must be two of them or more, got "
            f"{len(present)} with {len(links)} links; choose smaller runs or cubes, add measurements{without}"
        )
    order = torch.randperm(len(present), generator=generator)
    surplus = sizes[order].cumsum(0)[:-1] - fraction * len(links)
    count = max(1, int((surplus <= 0).sum())) if at_most else int(surplus.abs().argmin()) + 1
    chosen = present[order[:count]]
    held = torch.isin(groups[links], chosen)
    return links[~held], links[held]


def generator_of(seed: int) -> torch.Generator:
    """The random numbers of a seed; a ``ValueError`` unless torch accepts it."""
    check("seed", seed, 0 <= seed < 2**63, "a whole number from 0 to 2**63 - 1")
    return torch.Generator().manual_seed(seed)


def runs_of(links: Links, length: int) -> Int[Tensor, " n"]:
    """Number of each link's run of ``length`` rows; a ``ValueError`` unless it is 1 or more."""
    check("length", length, length >= 1, "a whole number of rows, at least 1")
    rows = rows_of(links)
    return rows // min(length, int(rows.max()) + 1)  # the length may exceed int64


def check(name: str, value: float, holds: bool, bounds: str) -> None:
    """Raises a ``ValueError`` for an option out of its bounds."""
    if not holds:
        raise ValueError(f"split.{name} must be {bounds}, got {value}")
