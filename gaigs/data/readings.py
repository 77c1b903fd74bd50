"""Received signal strength: what its readers share."""

from collections.abc import Sequence
from pathlib import Path

import torch

from gaigs.antenna import Receiver
from gaigs.geometry import Pose
from gaigs.io.tables import Rows, to_numbers

LOUDEST = 0.0
"""Upper bound of readings [dBm]. Over 0.3 m alone 2.4 GHz loses 30 dB, more than the 20 dBm that Bluetooth may send, so
0 and above are other units, a lost sign or other marks of "not heard"."""


def gateway(name: str, position: Sequence[float]) -> Receiver:
    """A receiver without orientation at a position [m]: its axes are the world's."""
    return Receiver(name, Pose(torch.as_tensor(position), torch.eye(3)))


def to_dbm(file: Path, rows: Rows, names: Sequence[str], lowest: float, not_heard: float) -> list[list[float]]:
    """Cells of a table as readings [dBm]; a ``ValueError`` where one is neither ``not_heard`` nor in range."""
    holds = lambda value: value == not_heard or lowest <= value < LOUDEST
    expected = f"an RSSI from {lowest:g} to below {LOUDEST:g} dBm ({not_heard:g} where nothing was heard)"
    return to_numbers(file, rows, names, holds, expected)
