"""Readings of received signal strength: their bounds and receivers."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from gaigs.antenna import Receiver
from gaigs.geometry import Pose
from gaigs.io.tables import Rows, to_numbers
from gaigs.query import check_carrier

QUIETEST, LOUDEST = -150.0, 30.0
"""Bounds of readings [dBm]: others are another unit, a lost sign or a mark of "not heard" such as 100."""

MARKS, ROUND = (100.0, 127.0, -200.0, -999.0), (-100.0, -105.0, -110.0, -120.0, -127.0, -128.0)
"""Usual marks of "not heard", out of these bounds and within."""


def gateway(name: str, position: Sequence[float] | Float[Tensor, "3"]) -> Receiver:
    """A receiver without orientation at a position [m]: its axes are the world's."""
    return Receiver(name, Pose(torch.as_tensor(position), torch.eye(3)))


def to_dbm(file: Path, rows: Rows, names: Sequence[str], lowest: float, not_heard: float) -> list[list[float]]:
    """Cells of a table as readings [dBm]; a ``ValueError`` where one is neither ``not_heard`` nor in range."""
    holds = lambda value: value == not_heard or lowest <= value <= LOUDEST
    expected = f"an RSSI from {lowest:g} to {LOUDEST:g} dBm ({not_heard:g} where nothing was heard)"
    return to_numbers(file, rows, names, holds, expected)


def marks_of(levels: Float[ndarray, "n k"]) -> list[float]:
    """Values among readings [dBm] that mean "not heard", a gateway a column; NaN for an empty cell.

    Out of bounds they are repeated or usual values. Within bounds they are

    - 0, or a repeated -1 or 1, 10 dB above all others;
    - of columns with two values or more, a usual value from -105 down, 5 dB below all others; -100, if it is repeated
      and more than 10 dB below them; and the lowest or a usual value with 5 % of the readings, five times those of each
      value within 5 dB, in two columns or the only one.
    """
    values, counts = np.unique(levels[np.isfinite(levels)], return_counts=True)
    outside = (values < QUIETEST) | (values > LOUDEST)
    marks = values[outside & ((counts > 1) | np.isin(values, MARKS))].tolist()
    values, counts = values[~outside], counts[~outside]
    is_usual = len(values) > 1 and (values[-1] == 0 or (abs(values[-1]) <= 1 and counts[-1] > 1))
    if is_usual and values[-2] < values[-1] - 10:
        marks.append(values[-1].item())
    lowest = values.min(initial=0)
    own = np.where((levels >= QUIETEST) & (levels <= LOUDEST), levels, np.nan)
    own = own[:, [len(np.unique(column[~np.isnan(column)])) > 1 for column in own.T]]
    values, counts = np.unique(own[~np.isnan(own)], return_counts=True)
    for value in values[np.isin(values, [*ROUND, lowest])].tolist():
        count, near = counts[values == value][0], counts[(values != value) & (np.abs(values - value) < 5)]
        is_often = count >= max(3, 0.05 * counts.sum()) and count > 5 * near.max(initial=0)
        is_apart = value in ROUND[1:] and value == lowest and not len(near)
        is_apart |= value == ROUND[0] == lowest and count > 1 and not (np.abs(values - value) <= 10).sum() > 1
        if is_apart or (is_often and (own == value).any(0).sum() >= min(2, own.shape[1])):
            marks.append(value)
    return marks


def loud_remark(levels: Iterable[float]) -> str:
    """The remark that counts levels of 0 dBm or more: many tables mean "not heard" by 0."""
    count = sum(level >= 0 for level in levels)
    return f"; {count} readings of 0 dBm or more are taken for levels" if count else ""


def carriers_of(frequency: float | None, count: int) -> Float[Tensor, " n"] | None:
    """The carrier of ``count`` readings [Hz]; None if it is unknown."""
    if frequency is None:
        return None
    check_carrier("frequency", frequency)
    return torch.full((count,), frequency, dtype=torch.float64)
