"""The check of kind ``split``."""

from collections.abc import Callable

import torch

from gaigs.data import Links, Split
from gaigs.split import rows_of
from gaigs.testing.checks import require
from gaigs.testing.data import check_parts


def check_split(build: Callable[[int], Split], links: Links, parts_rows: bool = False) -> None:
    """A split: parts that ascend and share no link, rows that are never parted, and a seed that alone decides.

    Args:
        build: Splits the links with a seed. Its other options are such that links are drawn at random, for the test or
            to validate.
        links: Those that it splits.
        parts_rows: Whether links of one row may come into different parts, as for parts that came with the data.

    Raises:
        AssertionError: It breaks the contract of ``gaigs.split``.
    """
    split = build(0)
    require(isinstance(split, Split), f"a split must be a gaigs.data.Split, got {type(split).__name__}")
    require(isinstance(split.name, str) and bool(split.name), "a split must say its protocol as its name")
    check_parts(split.parts(), len(links))
    if not parts_rows:
        rows = rows_of(links)
        parts = [set(rows[part].tolist()) for part in split.parts().values()]
        require(sum(map(len, parts)) == len(set().union(*parts)), "links of one row must come into one part")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(12345)
        _require_same(build(0), split, "the same seed must give the same split, whatever was drawn before")
    others = [build(seed) for seed in range(1, 6)]
    for other in others:
        check_parts(other.parts(), len(links))
    drawn = {tuple(tuple(part.tolist()) for part in other.parts().values()) for other in (split, *others)}
    require(len(drawn) > 1, "another seed must give another split")
    require(len({other.name for other in (split, *others)}) == 6, "a split's name must tell seeds apart")


def _require_same(split: Split, other: Split, rule: str) -> None:
    pairs = zip(split.parts().values(), other.parts().values(), strict=True)
    require(split.name == other.name and all(torch.equal(*pair) for pair in pairs), rule)
