"""The check of kind ``split``."""

from collections.abc import Callable

import torch

from gaigs.data import Links, Split
from gaigs.split import rows_of
from gaigs.testing.checks import require
from gaigs.testing.data import check_parts


def check_split(build: Callable[[int], Split], links: Links, parts_rows: bool = False) -> None:
    """Checks a split: ascending parts without a common link, whole rows, and the same parts for the
    same seed.

    Args:
        build: Function from a seed to the split; its other options make it draw links at random.
        links: Links to split.
        parts_rows: True if links of one row may come into different parts, as for parts that came
            with the data.
    """
    splits = [build(seed) for seed in range(6)]
    for split in splits:
        require(
            isinstance(split, Split),
            f"a split must be a gaigs.data.Split, got {type(split).__name__}",
        )
        require(split.name, "a split's name must be its protocol")
        check_parts(split.parts(), len(links))
        if not parts_rows:
            rows = rows_of(links)
            parts = [set(rows[part].tolist()) for part in split.parts().values()]
            require(
                sum(map(len, parts)) == len(set().union(*parts)),
                "links of one row must be in one part",
            )

    def content(split):
        return (
            split.name,
            tuple(tuple(part.tolist()) for part in split.parts().values()),
        )

    drawn = [content(split) for split in splits]
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(12345)
        again = content(build(0))
    require(again == drawn[0], "the same seed must give the same split in any random state")
    require(len({name for name, _ in drawn}) == 6, "a split's name must differ between seeds")
    require(len({parts for _, parts in drawn}) > 1, "another seed must give another split")
