"""Splits say which links train, validate and test. docs/data.md says what each of them measures.

A component of kind ``split`` is a function of the links and its own options. Validation links are taken out of the
training links in the way that the test links were taken out of all links, so that they predict the test error. Links of
one row are never parted but by the official parts: they have their place in common, and so mostly what shadows it.
"""

import torch
from jaxtyping import Int
from torch import Tensor

from gaigs.data import Links, Split


def rows_of(links: Links) -> Int[Tensor, "n"]:
    """Row of each link in the order of measurement."""
    return torch.arange(len(links)) if links.rows is None else links.rows


def part(
    name: str,
    links: Links,
    groups: Int[Tensor, "n"],
    test: float,
    validation: float,
    seed: int,
) -> Split:
    """Holds out whole groups of links, for the test and of the rest for validation.

    Args:
        name: Of the protocol, with its own options.
        links: All of them.
        groups: Number of each link's group, which is never parted.
        test: Fraction of the links to test on.
        validation: Fraction of the training links to validate on; 0 for none.
        seed: Of everything drawn at random.

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
    name: str, links: Int[Tensor, "k"], groups: Int[Tensor, "n"], fraction: float, generator: torch.Generator
) -> tuple[Int[Tensor, "kept"], Int[Tensor, "held"]]:
    """Parts links into those kept and those held out: random whole groups, as near to the fraction as they come.

    Args:
        name: Of the option that says how many, as errors call it.
        links: Numbers of the links to part, ascending.
        groups: Number of the group of every link there is.
        fraction: Of ``links`` to hold out; 0 for none.
        generator: Draws the groups.

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


def folds(links: Links, count: int, seed: int) -> list[Split]:
    """Parts the training links into folds of random whole rows; each split tests on one of them.

    Args:
        links: With a split, whose validation links all splits keep.
        count: Of folds.
        seed: Of the order.

    Raises:
        ValueError: There are fewer rows than folds.
    """
    split = links.split
    present, row = torch.unique(rows_of(links)[split.train], return_inverse=True)
    if len(present) < count:
        raise ValueError(f"kriging_folds must be at most {len(present)}, the rows of training links, got {count}")
    fold = (torch.randperm(len(present), generator=torch.Generator().manual_seed(seed)) % count)[row]
    return [
        Split(
            f"{split.name}, fold {i + 1} of {count}", split.train[fold != i], split.validation, split.train[fold == i]
        )
        for i in range(count)
    ]


def generator_of(seed: int) -> torch.Generator:
    """What draws at random.

    Raises:
        ValueError: torch has no such seed.
    """
    check("seed", seed, 0 <= seed < 2**63, "a whole number from 0 to 2**63 - 1")
    return torch.Generator().manual_seed(seed)


def runs_of(links: Links, length: int) -> Int[Tensor, "n"]:
    """Number of the run of rows that each link is in.

    Raises:
        ValueError: A run has no row.
    """
    check("length", length, length >= 1, "a whole number of rows, at least 1")
    rows = rows_of(links)
    return rows // min(length, int(rows.max()) + 1)  # a longer run holds all rows too, and may be beyond int64


def check_fractions(test: float, validation: float) -> None:
    """Sees to it that both are in range.

    Raises:
        ValueError: One is not.
    """
    check("test", test, 0 < test < 1, "in (0, 1)")
    check("validation", validation, 0 <= validation < 1, "in [0, 1)")


def check(name: str, value: float, holds: bool, bounds: str) -> None:
    """Sees to it that an option is within its bounds.

    Raises:
        ValueError: It is not.
    """
    if not holds:
        raise ValueError(f"split.{name} must be {bounds}, got {value}")
