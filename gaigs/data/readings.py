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
    """A receiver at a position [m] with the world's axes."""
    return Receiver(name, Pose(torch.as_tensor(position), torch.eye(3)))


def are_one_radio(places: int, links: int, sent: int, given: bool | None = None) -> bool:
    """True if the receivers are places of one moving radio, or identical radios.

    Without an answer of the user this is a guess. It is true for at least 12 receiver places with
    fewer than 12 links each on average, if transmitter places have fewer than two links each on
    average, or are a few beacons: one for four receiver places or more. In a survey of access
    points, by contrast, each transmitter place has a link to every access point in range.

    Args:
        places: Number of places of receivers.
        links: Number of links.
        sent: Number of places of transmitters.
        given: The user's answer, which is returned; None without an answer.
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
    """Cells of a table as readings [dBm].

    Args:
        file: File of the table, for errors.
        rows: Cells of each line; a unit dBm in a cell is dropped.
        names: Names of the columns.
        lowest: Lowest valid reading [dBm].
        not_heard: Values that mean "not heard", also outside the bounds [dBm].
        mend: Advice in the error if other values seem to mean "not heard".

    Raises:
        ValueError: A cell is neither a valid reading nor a value of ``not_heard``.
    """
    cells = {}
    for line, texts in rows.items():
        cells[line] = [re.sub(r"(?i)\s*dbm$", "", text) for text in texts]

    def is_valid(value: float) -> bool:
        return value in not_heard or lowest <= value <= LOUDEST

    expected = (
        f"an RSSI from {lowest:g} to {LOUDEST:g} dBm ({and_list(not_heard)} where nothing was "
        "heard)"
    )
    try:
        return to_numbers(file, cells, names, is_valid, expected)
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

    Names without a match are dropped.
    """

    def plain(name: str) -> str:
        return re.sub(r"[\s_:-]", "", name.casefold())

    # Only a spelling that occurs once among the names and once among the known ones is a match.
    spelt = Counter(map(plain, names))
    known_spelt = Counter(map(plain, known))
    by_letters = {plain(name): name for name in known}
    matched = {}
    for name in names:
        if name in known:
            matched[name] = name
        elif known_spelt[plain(name)] == 1 == spelt[plain(name)]:
            matched[name] = by_letters[plain(name)]
    return matched


def suggested(name: str, others: Iterable[str]) -> str:
    """A name in quotes, with the most similar other name with the same digits, if any."""
    digits = re.findall(r"\d+", name)
    return suggest(name, [other for other in others if re.findall(r"\d+", other) == digits])


def and_list(numbers: Iterable[float]) -> str:
    """Numbers in ascending order as text, such as ``0, 60 and 102``; empty without numbers."""
    words = [f"{number:g}" for number in sorted(numbers)]
    if len(words) < 2:
        return "".join(words)
    return f"{', '.join(words[:-1])} and {words[-1]}"


def marks_of(levels: Float[ndarray, "n k"]) -> list[float]:
    """Values among readings [dBm] that mean "not heard" (marks), with a gateway in each column.

    Empty cells are NaN. A value outside the range of levels is a mark if it is repeated, or a usual
    mark such as 100. A value within the range is a mark in these cases:

    - it is 0, or repeated and -1 or more; at most three such values are more than 10 dB above all
      others;
    - it is a usual mark of -105 or less, in columns with two values or more; it is 5 dB below all
      others, or 10 dB if not repeated;
    - it is -100, repeated, and more than 10 dB below all others;
    - it is the lowest value, or a usual mark; it has 5 % of the readings, and five times the count
      of each value within 5 dB, in two columns or the only one;
    - it is one of at most three values more than 10 dB below all others; it occurs three times, in
      two columns with higher levels.
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
    inside = inside[:, has_several]  # a column of one value is no evidence
    marks += _usual_marks(inside, lowest)
    return marks + _lowest_marks(inside, marks)


def _usual_marks(levels: Float[ndarray, "n k"], lowest: float) -> list[float]:
    """Values that mean "not heard", as in ``marks_of``: usual marks, or the ``lowest`` value.

    Such a value is apart from all others, or much more frequent than its neighbours.

    Args:
        levels: Readings, without columns of one value [dBm].
        lowest: Lowest value among all readings, also of other columns [dBm].
    """
    usual = (-100.0, -105.0, -110.0, -120.0, -127.0, -128.0)  # marks of "not heard" [dBm]
    values, counts = np.unique(levels[~np.isnan(levels)], return_counts=True)
    marks = []
    for value in values[np.isin(values, [*usual, lowest])].tolist():
        count = counts[values == value][0]
        near = counts[(values != value) & (np.abs(values - value) < 5)]  # within 5 dB
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
    """Marks by the last case of ``marks_of``: lowest values, more than 10 dB below all others.

    Args:
        levels: Readings, without columns of one value [dBm].
        marks: Marks by the other cases, which are left out of the result.
    """
    values = np.unique(levels[~np.isnan(levels)])
    gaps = np.flatnonzero(np.diff(values[:4]) > 10)  # at most three values are below a gap
    if not len(gaps):
        return []
    last = gaps[-1]  # number of the highest value below the gap
    lowest = []
    for value in values[: last + 1].tolist():
        # A mark occurs with true levels in several columns. A column of only low values is a
        # weak receiver's.
        is_mixed = (levels == value).any(0) & (levels > values[last]).any(0)  # (k,)
        if value not in marks and (levels == value).sum() >= 3 and is_mixed.sum() >= 2:
            lowest.append(value)
    return lowest


def remark_on_zeros(levels: Iterable[float]) -> str:
    """The remark that counts levels of 0 dBm or more: many tables mean "not heard" by 0."""
    count = sum(level >= 0 for level in levels)
    return f"; {count} readings of 0 dBm or more are taken for levels" if count else ""


def carriers_of(frequency: float | None, count: int) -> Float[Tensor, " n"] | None:
    """The carrier of ``count`` readings [Hz]; None if unknown."""
    if frequency is None:
        return None
    check_carrier("frequency", frequency)
    return torch.full((count,), frequency, dtype=torch.float64)
