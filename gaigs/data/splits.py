"""Split protocols: which links train, validate and test. docs/data.md says what each of them measures."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.data import Split

OPTIONS = {
    "official": ("length",),
    "random": ("test",),
    "sparse": ("train", "test"),
    "runs": ("length", "test"),
    "blocks": ("edge", "test"),
}
"""Options that each protocol has besides ``seed`` and ``validation``."""

TEST = 0.2
"""Fraction of the links that test where none is given; the published s23 split has 0.20 too."""


def split(
    transmitters: Float[Tensor, "n 3"],
    protocol: str = "official",
    *,
    official: tuple[Int[Tensor, "train"], Int[Tensor, "test"]] | None = None,
    rows: Int[Tensor, "n"] | None = None,
    seed: int = 0,
    validation: float = 0.1,
    **options: float | None,
) -> Split:
    """Parts the links by a protocol.

    Validation links are taken out of the training links in the way that the test links were taken out of all links
    (whole runs for ``runs``, whole cubes for ``blocks``, else row by row), so that they predict the test error; where
    the official test is another run, so do official validation links in runs of some ``length``. Links of one row
    are never parted but by the official parts: they have their place in common, and so mostly what shadows it.

    Args:
        transmitters: Positions of all links [m], in the order of measurement.
        protocol: ``official``: the parts that came with the data. ``random``: single rows are held out. ``sparse``:
            the test rows are those of ``random``, and few of the others train. ``runs``: contiguous runs are held out.
            ``blocks``: cubes of space are held out.
        official: Training and test links that came with the data.
        rows: Row of each link in the order of measurement, from 0: the links by which several receivers heard one
            transmission have the same. Each link has its own unless given.
        seed: Of everything drawn at random.
        validation: Fraction of the training links to validate on; 0 for none.
        **options: ``test``, fraction of the links to test on, 0.2 unless given (all protocols but ``official``);
            ``train``, number of rows to train and validate on (``sparse``); ``length`` of a run in rows (``runs``; for
            ``official``, where it is 1 unless given, of the runs that validate); ``edge`` of a cube [m] (``blocks``).
            None counts as not given.

    Returns:
        The parts, each in ascending order, disjoint, with a name that says everything that was given.

    Raises:
        ValueError: The protocol is unknown, an option is missing, not the protocol's or out of range, the data came
            without official parts, or too little is left to part.
    """
    options = {name: value for name, value in options.items() if value is not None}
    if protocol not in OPTIONS:
        raise ValueError(f"unknown split protocol {protocol!r}; there are: {', '.join(OPTIONS)}")
    unknown = options.keys() - OPTIONS[protocol]
    if unknown:
        words, takes = ", ".join(sorted(unknown)), ", ".join((*OPTIONS[protocol], "validation", "seed"))
        raise ValueError(f"split protocol {protocol!r} has no option {words}; it has: {takes}; set others to null")
    if protocol == "official":
        options.setdefault("length", 1)
    else:
        options.setdefault("test", TEST)
    for name in OPTIONS[protocol]:
        if name not in options:
            raise ValueError(f"split protocol {protocol!r} needs option {name!r}")
    _check("validation", validation, 0 <= validation < 1, "in [0, 1)")

    generator = torch.Generator().manual_seed(seed)
    links = torch.arange(len(transmitters))
    rows = groups = links if rows is None else rows
    words = [protocol]
    match protocol:
        case "official" if official is None:
            raise ValueError(f"this data has no official split; choose of {', '.join([*OPTIONS][1:])}")
        case "sparse":
            words = [f"sparse {options['train']}"]
        case "official" | "runs":
            length = options["length"]
            _check("length", length, length >= 1 and length == int(length), "a whole number of rows, at least 1")
            groups = rows // int(length)
            words = [f"runs of {length}"] if protocol == "runs" else words
        case "blocks":
            edge = options["edge"]
            _check("edge", edge, 0 < edge < math.inf, "positive [m]")
            corner = transmitters.double().amin(0)
            cubes = ((transmitters.double() - corner) / edge).floor().long()
            groups = torch.unique(cubes, dim=0, return_inverse=True)[1]
            words = [f"blocks {edge:g} m"]

    if protocol == "official":
        train, test = (part.sort().values for part in official)
    else:
        _check("test", options["test"], 0 < options["test"] < 1, "in (0, 1)")
        train, test = _hold_out(links, groups, options["test"], generator)
        words.append(f"test {options['test']:g}")
    if protocol == "sparse":
        count = options["train"]
        present = rows[train].unique()
        _check("train", count, 1 <= count <= len(present), f"in 1..{len(present)}, the rows that do not test")
        chosen = present[torch.randperm(len(present), generator=generator)[: int(count)]]
        train = train[torch.isin(rows[train], chosen)]
    train, validating = _hold_out(train, groups, validation, generator)
    if validation:
        runs = f" in runs of {length}" if protocol == "official" and length > 1 else ""
        words.append(f"validation {validation:g}{runs}")
    if validation or protocol != "official":
        words.append(f"seed {seed}")
    return Split(", ".join(words), train, validating, test)


def _hold_out(
    links: Int[Tensor, "k"], groups: Int[Tensor, "n"], fraction: float, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Parts links into those kept and those held out: random whole groups, as near to the fraction as they come."""
    if not fraction:
        return links, links[:0]
    present, sizes = torch.unique(groups[links], return_counts=True)
    if len(present) < 2:
        raise ValueError(
            f"to hold out {fraction:g} of {len(links)} links takes two groups of them or more, got {len(present)}; "
            "choose smaller runs or cubes, or fewer parts"
        )
    order = torch.randperm(len(present), generator=generator)
    surplus = sizes[order].cumsum(0)[:-1] - fraction * len(links)
    chosen = present[order[: int(surplus.abs().argmin()) + 1]]
    held = torch.isin(groups[links], chosen)
    return links[~held], links[held]


def _check(name: str, value: float, holds: bool, bounds: str) -> None:
    if not holds:
        raise ValueError(f"split option {name!r} must be {bounds}, got {value}")
