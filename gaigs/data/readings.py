"""Readings of received signal strength: their bounds and receivers."""

import re
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import check_carrier
from gaigs.io.tables import Rows, to_number, to_numbers
from gaigs.registry import suggest

QUIETEST, LOUDEST = -150.0, 30.0
"""Bounds of readings [dBm]; others have another unit, a lost sign, or mean "not heard"."""


def gateway(name: str, position: Sequence[float] | Float[Tensor, "3"]) -> Receiver:
    """A receiver without orientation at a position [m]: its axes are the world's."""
    return Receiver(name, Pose(torch.as_tensor(position), torch.eye(3)))


def are_one_radio(places: int, links: int, sent: int, given: bool | None = None) -> bool:
    """True if the receivers are places of one radio that moves, or of radios alike.

    One radio has 12 places or more, with less than 12 links each on average. Its transmitters have
    less than two links each on average, or are few beacons: four or more places to each. In a
    survey of access points a transmitter's place has several links: one to each access point heard.

    Args:
        places: Number of places of receivers.
        links: Number of links.
        sent: Number of places of transmitters.
        given: The user's answer, which counts; None without one.
    """
    if given is not None:
        return given
    has_few_links = links < 2 * sent
    are_beacons = 4 * sent <= places
    return 12 <= places and links < 12 * places and (has_few_links or are_beacons)


def to_dbm(
    file: Path,
    rows: Rows,
    names: Sequence[str],
    lowest: float,
    not_heard: Sequence[float],
    mend: str,
) -> list[list[float]]:
    """Cells of a table as readings [dBm], each ``not_heard`` or from ``lowest`` on.

    A ``ValueError`` for any other cell; ``mend`` says in it what to do with other values that mean
    "not heard".
    """
    cells = {}
    for line, texts in rows.items():
        cells[line] = [re.sub(r"(?i)\s*dbm$", "", text) for text in texts]

    def holds(value):
        return value in not_heard or lowest <= value <= LOUDEST

    expected = (
        f"an RSSI from {lowest:g} to {LOUDEST:g} dBm ({and_list(not_heard)} where nothing was "
        "heard)"
    )
    try:
        return to_numbers(file, cells, names, holds, expected)
    except ValueError as error:
        levels = np.array([[*map(to_number, texts)] for texts in cells.values()])
        others = [mark for mark in marks_of(levels) if mark not in not_heard]
        if not others:
            raise
        raise ValueError(f'{error}\n{and_list(others)} seem to mean "not heard": {mend}') from None


def marks_given(not_heard: float | Sequence[float]) -> list[float]:
    """The values of the option ``not_heard``, one number or several."""
    return np.ravel(not_heard).astype(float).tolist()


def match_names(names: Iterable[str], known: Sequence[str]) -> dict[str, str]:
    """The known name for each name: the same, or the only one with the same letters and digits.

    Names without a match are left out.
    """

    def plain(name):
        return re.sub(r"[\s_:-]", "", name.casefold())

    spelt = Counter(map(plain, names))
    alike = Counter(map(plain, known))
    by_letters = {plain(name): name for name in known}
    matched = {}
    for name in names:
        if name in known:
            matched[name] = name
        elif alike[plain(name)] == 1 == spelt[plain(name)]:
            matched[name] = by_letters[plain(name)]
    return matched


def suggested(name: str, others: Iterable[str]) -> str:
    """A name in quotes, with the most similar other name of the same digits, if there is one."""
    digits = re.findall(r"\d+", name)
    return suggest(name, [other for other in others if re.findall(r"\d+", other) == digits])


def and_list(numbers: Iterable[float]) -> str:
    """Ascending numbers in words: 0, 60 and 102."""
    words = [f"{number:g}" for number in sorted(numbers)]
    return " and ".join(filter(None, (", ".join(words[:-1]), *words[-1:])))


def marks_of(levels: Float[ndarray, "n k"]) -> list[float]:
    """Values among readings [dBm] that mean "not heard", a gateway a column; NaN for an empty cell.

    Values outside the range of levels are such marks if they are repeated or usual, as 100. Values
    within the range are

    - 0 and repeated values from -1 up, three at most, more than 10 dB above all others;
    - of columns with two values or more, a usual value from -105 down, 5 dB below all others, or 10
      dB if it is not repeated; -100, if it is repeated and more than 10 dB below them; and the
      lowest or a usual value with 5 % of the readings, five times those of each value within 5 dB,
      in two columns or the only one;
    - the lowest values, three at most, more than 10 dB below all others, each of them three times
      and in two columns that have higher levels.
    """
    values, counts = np.unique(levels[np.isfinite(levels)], return_counts=True)
    outside = (values < QUIETEST) | (values > LOUDEST)
    usual = (100.0, 127.0, -200.0, -999.0)
    marks = values[outside & ((counts > 1) | np.isin(values, usual))].tolist()
    values, counts = values[~outside], counts[~outside]
    # Loud marks: 0, and repeated values, far above all levels.
    loud = values >= -1
    if 0 < loud.sum() <= min(3, len(values) - 1) and values[loud][0] > values[~loud][-1] + 10:
        marks += values[loud & ((counts > 1) | (values == 0))].tolist()
    lowest = float(values.min(initial=0))
    inside = np.where((levels >= QUIETEST) & (levels <= LOUDEST), levels, np.nan)
    has_several = [len(np.unique(column[~np.isnan(column)])) > 1 for column in inside.T]
    inside = inside[:, has_several]  # a column of one value tells nothing
    marks += _usual_marks(inside, lowest)
    return marks + _lowest_marks(inside, marks)


def _usual_marks(levels: Float[ndarray, "n k"], lowest: float) -> list[float]:
    """Marks among usual values and the ``lowest`` one: far from other levels, or more frequent."""
    usual = (-100.0, -105.0, -110.0, -120.0, -127.0, -128.0)  # marks of "not heard" [dBm]
    values, counts = np.unique(levels[~np.isnan(levels)], return_counts=True)
    marks = []
    for value in values[np.isin(values, [*usual, lowest])].tolist():
        count = counts[values == value][0]
        near = counts[(values != value) & (np.abs(values - value) < 5)]
        is_often = count >= max(3, 0.05 * counts.sum()) and count > 5 * near.max(initial=0)
        is_alone = (np.abs(values - value) <= 10).sum() == 1
        is_apart = False
        if value == lowest == usual[0]:
            is_apart = count > 1 and is_alone
        elif value == lowest and value in usual:
            is_apart = not len(near) and (count > 1 or is_alone)
        columns = (levels == value).any(0).sum()
        if is_apart or (is_often and columns >= min(2, levels.shape[1])):
            marks.append(value)
    return marks


def _lowest_marks(levels: Float[ndarray, "n k"], marks: Sequence[float]) -> list[float]:
    """The lowest values, at most three, that stand more than 10 dB below all others."""
    values = np.unique(levels[~np.isnan(levels)])
    gaps = np.flatnonzero(np.diff(values[:4]) > 10)
    if not len(gaps):
        return []
    last = gaps[-1]
    lowest = []
    for value in values[: last + 1].tolist():
        # A mark stands beside true levels in several columns. A column of low values alone is a
        # weak receiver's.
        mixed = (levels == value).any(0) & (levels > values[last]).any(0)  # (k,)
        if value not in marks and (levels == value).sum() >= 3 and mixed.sum() >= 2:
            lowest.append(value)
    return lowest


def remark_on_zeros(levels: Iterable[float]) -> str:
    """The remark that counts levels of 0 dBm or more: many tables mean "not heard" by 0."""
    count = sum(level >= 0 for level in levels)
    return f"; {count} readings of 0 dBm or more are taken for levels" if count else ""


def carriers_of(frequency: float | None, count: int) -> Float[Tensor, " n"] | None:
    """The carrier of ``count`` readings [Hz]; None if it is unknown."""
    if frequency is None:
        return None
    check_carrier("frequency", frequency)
    return torch.full((count,), frequency, dtype=torch.float64)
