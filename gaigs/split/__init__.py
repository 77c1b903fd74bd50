"""Splits of links into training, validation and test.

Links of one row, that is one transmission to several receivers or at several frequencies, are in
the same part. Only the split of the data (``official``) may separate them. Fractions count places,
not readings: all links of one place, receiver and carrier count as one.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.data import Links, Split


def rows_of(links: Links) -> Int[Tensor, " n"]:
    """Row of each link in the order of measurement."""
    return torch.arange(len(links)) if links.rows is None else links.rows


def places_of(links: Links) -> Int[Tensor, " n"]:
    """Number of each link's group: a group has the links at one place, or of one row.

    A row is one transmission. The number of a group is its first row.
    """
    rows = rows_of(links)
    last = rows.new_full((len(rows),), int(rows.max()))
    # Each link gets the lowest row at its place, and then the lowest of these rows in its own row.
    for numbers in (links.query.place_keys, rows):
        _, set_of = numbers.unique(return_inverse=True)  # links of one place or row, (n,)
        first = last.scatter_reduce(0, set_of, rows, "amin")
        rows = first[set_of]
    return rows


def part(
    name: str,
    links: Links,
    groups: Int[Tensor, " n"],
    test: float,
    validation: float | None,
    seed: int,
    train: int | None = None,
    rows: Int[Tensor, " n"] | None = None,
) -> Split:
    """Holds out whole groups of links, first for the test, then in the same way for validation.

    If all links are at a single place, such as readings at a new receiver, none are held out.

    Args:
        name: Name of the split with its specific options; the common options are appended.
        links: All links.
        groups: Number of each link's group.
        test: Fraction of the links to test on; 0 for none.
        validation: Fraction of the training links to validate on; 0 for none. None: 0.1, or more if
            there are too few links for intervals of 90 %, see ``hold_out``.
        seed: Seed of all random numbers.
        train: Number of groups to train and validate on; None: all groups outside the test.
        rows: Row of each link. They make the random order independent of repeated places, see
            ``drawn``.
    """
    check("test", test, 0 <= test < 1, "in [0, 1)")
    check_validation(validation)
    generator = generator_of(seed)
    votes, places = links.query.votes, links.query.place_keys
    if (places == places[0]).all():
        test = validation = 0.0
    training, testing, _ = hold_out(
        "test", torch.arange(len(links)), groups, votes, test, generator, rows=rows
    )
    if validation is None and (places[training] == places[training[0]]).all():
        validation = 0.0
    if train is not None:
        order = drawn(groups, training, generator, rows)
        bounds = f"in 1..{len(order)}, the places that do not test"
        check("train", train, 1 <= train <= len(order), bounds)
        training = training[torch.isin(groups[training], order[:train])]
    training, validating, share = hold_out(
        "validation", training, groups, votes, validation, generator, rows=rows
    )
    words = [name, f"test {test:g}"]
    if share:
        words.append(f"validation {share:g}")
    words.append(f"seed {seed}")
    return Split(", ".join(words), training, validating, testing, groups)


def drawn(
    groups: Int[Tensor, " n"],
    links: Int[Tensor, " k"],
    generator: torch.Generator,
    rows: Int[Tensor, " n"] | None = None,
) -> Int[Tensor, " g"]:
    """The groups of the numbered links in random order.

    With ``rows`` all rows of the links are shuffled, and groups are in the order of their first
    rows. A place that is measured again then does not change the order of other groups.
    """
    shuffled = groups[links] if rows is None else torch.cat((groups[links], rows[links]))
    shuffled = shuffled.unique()
    order = shuffled[torch.randperm(len(shuffled), generator=generator)]
    return order[torch.isin(order, groups[links])]


class Parted(NamedTuple):
    """Numbers of kept links and of held-out links, both ascending."""

    kept: Int[Tensor, " k"]
    held: Int[Tensor, " h"]
    fraction: float  # the fraction held out, for the split's name


def hold_out(
    name: str,
    links: Int[Tensor, " k"],
    groups: Int[Tensor, " n"],
    votes: Float[Tensor, " n"],
    fraction: float | None,
    generator: torch.Generator,
    at_most: bool = False,
    rows: Int[Tensor, " n"] | None = None,
) -> Parted:
    """Holds out random whole groups of links.

    Args:
        name: Option with the fraction, for errors.
        links: Ascending numbers of the links to divide, in at least two groups.
        groups: Group of each link of the data.
        votes: Weight of each link of the data.
        fraction: Fraction of the links' total weight to hold out, as nearly as groups allow. None:
            0.1, or up to 0.3 to reach the nine links that intervals of 90 % need.
        at_most: True to hold out no more than the fraction, but at least one group.
        rows: See ``drawn``.
    """
    if fraction == 0:
        return Parted(links, links[:0], 0.0)
    usual = 0.1 if fraction is None else fraction
    order = drawn(groups, links, generator, rows)
    if len(order) < 2:
        without = ", or set split.validation=0" if name == "validation" else ""
        raise ValueError(
            f"split.{name}={usual:g} holds out whole places, runs or cubes, so there must be two "
            f"of them or more, got {len(order)} with {len(links)} links; choose smaller runs or "
            f"cubes, add measurements{without}"
        )
    # Numbers of the groups from 0: of each group in the random order, then of each link's group.
    _, numbers = torch.cat((order, groups[links])).unique(return_inverse=True)
    ordered, of_links = numbers.tensor_split([len(order)])
    weights = votes.new_zeros(len(order)).index_add(0, of_links, votes[links])
    # Weight of the first 1, 2, ... groups. Single precision rounds sums of thirds to whole numbers.
    filled = weights[ordered].cumsum(0).float()
    total = filled[-1].item()
    filled = filled[:-1]  # one group at least is kept
    surplus = filled - usual * total
    count = int(surplus.abs().argmin()) + 1
    if at_most:
        count = max(1, int((surplus <= 0).sum()))
    # Nine links are sought, up to 0.3 of the weight.
    if fraction is None and filled[count - 1] < 9:
        enough = int((filled < 9).sum())
        if enough < len(filled) and filled[enough] <= 0.3 * total:
            count = enough + 1
            usual = round(filled[enough].item() / total, 2)
    held = torch.isin(groups[links], order[:count])
    return Parted(links[~held], links[held], usual)


def generator_of(seed: int) -> torch.Generator:
    """The random generator of a seed; a ``ValueError`` unless torch accepts the seed."""
    check("seed", seed, 0 <= seed < 2**63, "a whole number from 0 to 2**63 - 1")
    return torch.Generator().manual_seed(seed)


def runs_of(links: Links, length: int) -> Int[Tensor, " n"]:
    """Number of each link's run of ``length`` rows; a ``ValueError`` unless it is 1 or more."""
    check("length", length, length >= 1, "a whole number of rows, at least 1")
    rows = rows_of(links)
    return rows // min(length, int(rows.max()) + 1)  # the length may exceed int64


def check_validation(validation: float | None) -> None:
    """Raises a ``ValueError`` unless the fraction of validation links is None or in [0, 1)."""
    check("validation", validation, validation is None or 0 <= validation < 1, "in [0, 1)")


def check(name: str, value: float | None, holds: bool, bounds: str) -> None:
    """Raises a ``ValueError`` for an option out of its bounds."""
    if not holds:
        raise ValueError(f"split.{name} must be {bounds}, got {value}")
