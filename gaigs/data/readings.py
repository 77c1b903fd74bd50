"""Readings of received signal strength: their bounds and receivers."""

from collections.abc import Sequence
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.antenna import Receiver
from gaigs.geometry import Pose
from gaigs.io.tables import Rows, to_numbers

LOUDEST = 0.0
"""Upper bound of readings [dBm]. Bluetooth sends at most 20 dBm and loses 30 dB over 0.3 m, so 0 and above are another
unit, a lost sign or another mark of "not heard"."""


def gateway(name: str, position: Sequence[float] | Float[Tensor, "3"]) -> Receiver:
    """A receiver without orientation at a position [m]: its axes are the world's."""
    return Receiver(name, Pose(torch.as_tensor(position), torch.eye(3)))


def to_dbm(file: Path, rows: Rows, names: Sequence[str], lowest: float, not_heard: float) -> list[list[float]]:
    """Cells of a table as readings [dBm]; a ``ValueError`` where one is neither ``not_heard`` nor in range."""
    holds = lambda value: value == not_heard or lowest <= value < LOUDEST
    expected = f"an RSSI from {lowest:g} to below {LOUDEST:g} dBm ({not_heard:g} where nothing was heard)"
    return to_numbers(file, rows, names, holds, expected)
