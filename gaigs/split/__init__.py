"""Splits of links into training, validation and test; docs/data.md describes the purpose of each.

A component of kind ``split`` is a function of the links and its own options. Validation links are taken from the
training links as the test links are taken from all links, so that they predict the test error. Only the official parts
may separate links of one row: these share a place, and so mostly its shadows.
"""

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
) -> Split:
    """Holds out whole groups of links, first for the test and then for validation.

    Args:
        name: Name of the protocol, with its own options.
        links: All links.
        groups: Number of each link's group, which stays whole.
        test: Fraction of the links to test on.
        validation: Fraction of the training links to validate on; 0 for none.
        seed: Seed of all random numbers.

    Raises:
        ValueError: An option is out of range, or there are too few groups.
    """
    check_fractions(test, validation)
    generator = generator_of(seed)
    train, testing = hold_out("test", torch.arange(len(links)), groups, test, generator)
    train, validating = hold_out("validation", train, groups, validation, generator)
    words = [name, f"test {test:g}", *([f"validation {validation:g}"] if validation else []), f"seed {seed}"]
    return Split(", ".join(words), train, validating, testing)


def hold_out(
    name: str, links: Int[Tensor, " k"], groups: Int[Tensor, " n"], fraction: float, generator: torch.Generator
) -> tuple[Int[Tensor, " kept"], Int[Tensor, " held"]]:
    """Holds out random whole groups, as near to a fraction of the links as possible.

    Args:
        name: Name of the option with the fraction, for errors.
        links: Numbers of the links to divide, ascending.
        groups: Number of the group of every link of the data.
        fraction: Fraction of ``links`` to hold out; 0 for none.
        generator: Generator that draws the groups.

    Raises:
        ValueError: There are fewer than two groups.
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
    chosen = present[order[: int(surplus.abs().argmin()) + 1]]
    held = torch.isin(groups[links], chosen)
    return links[~held], links[held]


def generator_of(seed: int) -> torch.Generator:
    """The random numbers of a seed; a ``ValueError`` for a seed that torch does not take."""
    check("seed", seed, 0 <= seed < 2**63, "a whole number from 0 to 2**63 - 1")
    return torch.Generator().manual_seed(seed)


def runs_of(links: Links, length: int) -> Int[Tensor, " n"]:
    """Number of each link's run of ``length`` rows; a ``ValueError`` for a run without rows."""
    check("length", length, length >= 1, "a whole number of rows, at least 1")
    rows = rows_of(links)
    return rows // min(length, int(rows.max()) + 1)  # a longer run holds all rows too, and may be beyond int64


def check_fractions(test: float, validation: float) -> None:
    """Raises a ``ValueError`` for fractions out of range."""
    check("test", test, 0 < test < 1, "in (0, 1)")
    check("validation", validation, 0 <= validation < 1, "in [0, 1)")


def check(name: str, value: float, holds: bool, bounds: str) -> None:
    """Raises a ``ValueError`` for an option that is not within its bounds."""
    if not holds:
        raise ValueError(f"split.{name} must be {bounds}, got {value}")
