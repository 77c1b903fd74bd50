"""Received signal strength in one table; docs/data.md describes its columns."""

import math
from pathlib import Path

import numpy as np
import torch

from gaigs.core.query import Query
from gaigs.core.task.rssi import Rssi
from gaigs.data import Links
from gaigs.data.readings import (
    and_list,
    are_one_radio,
    carriers_of,
    gateway,
    marks_given,
    remark_on_zeros,
    to_dbm,
)
from gaigs.io import tables
from gaigs.io.files import write_text
from gaigs.registry import register

ENDS = {"tx": "transmitter", "rx": "receiver"}
COLUMNS = (*(f"{end}_{axis}" for end in ENDS for axis in "xyz"), "rss_dbm")
"""Positions of transmitter and receiver [m], and the reading [dBm]."""

QUIETEST = -200.0
"""Lower bound of readings [dBm]: thermal noise alone is -174 dBm in 1 Hz."""


@register("data", "rssi_csv", task="rssi", split="random")
def read(
    file: str | Path,
    layout: str | Path | None = None,
    fixed: str | None = None,
    not_heard: float | list[float] = -100.0,
    frequency: float | None = None,
    one_radio: bool | None = None,
) -> Links:
    """A data set from a table with one reading in each line: a link for each received reading.

    Places of the fixed end become the receivers, ``rx1`` ... or ``tx1`` ... in the order of their
    first appearance, with the world's axes. Places of the moving end become the transmitters, since
    attenuation is equal in both directions. The readings of a transmitter place share a row.
    Readings of ``not_heard``, and fixed places with no other readings, are left out; the remarks
    count them. There is no official split.

    Args:
        file: Table with the columns ``tx_x``, ``tx_y``, ``tx_z``, ``rx_x``, ``rx_y``, ``rx_z`` [m]
            and ``rss_dbm`` in any order, in upper or lower case; the remarks name other columns.
        layout: File of wall vertices x,y [m], as ``layout.csv`` of ``nerf2_rssi``; None for no
            walls.
        fixed: Fixed end, ``tx`` or ``rx``. None: the end with fewer places; in a tie the receiver.
        not_heard: Value, or values, of readings that were not received [dBm]; all others are within
            [-200, 30].
        frequency: Carrier [Hz]; None if it is unknown or changes from reading to reading.
        one_radio: True if all fixed places are of one radio, with one gain. None: ``are_one_radio``
            decides.

    Raises:
        FileNotFoundError: The file does not exist.
        ValueError: An option is out of range, or a file has a defect; the message names file, line
            and value.
    """
    if fixed not in (None, *ENDS):
        raise ValueError(
            f"fixed must be tx or rx, or null for the end with fewer places, got {fixed!r}"
        )
    file = tables.find_file(file, "a table of readings")
    marks = marks_given(not_heard)
    if not marks or not all(map(math.isfinite, marks)):
        raise ValueError(
            f"not_heard must be finite numbers [dBm], got {not_heard!r}; write such numbers in the "
            "file"
        )
    points, dbm, ignored = _read_table(file, marks)
    walls = torch.zeros(0, 2, 3) if layout is None else tables.read_walls(Path(layout).expanduser())

    # Distinct places of each end, and the number of the place of each reading.
    numbered = {end: tables.number_places(points[end]) for end in ENDS}
    if fixed is None:
        fixed = "rx" if len(numbered["rx"][0]) <= len(numbered["tx"][0]) else "tx"
    moving = "tx" if fixed == "rx" else "rx"
    places, place_numbers = numbered[fixed]
    received = torch.tensor([value not in marks for value in dbm])
    present, receivers = place_numbers[received].unique(return_inverse=True)
    transmitters = torch.tensor(points[moving])[received]
    one_radio = are_one_radio(
        len(present), len(transmitters), len(transmitters.unique(dim=0)), one_radio
    )
    state = "moving" if one_radio else "fixed"
    remarks = (
        f"{len(transmitters)} readings of a moving {ENDS[moving]} at {len(present)} places of a "
        f"{state} {ENDS[fixed]}; {int((~received).sum())} of {and_list(marks)} dBm were not heard "
        "and are left out"
    )
    silent = [f"{fixed}{k + 1}" for k in range(len(places)) if k not in present]
    if silent:
        remarks += f", and so are the places that nothing was heard at: {', '.join(silent)}"
    below = sum(value < min(marks) < 0 for value in dbm)
    if below:
        remarks += f"; {below} readings below {min(marks):g} dBm are taken for levels"
    remarks += remark_on_zeros(value for value in dbm if value not in marks)
    if ignored:
        remarks += f"; columns ignored: {', '.join(ignored)}"
    return Links(
        query=Query(transmitters, receivers, carriers_of(frequency, len(receivers))),
        receivers=tuple(gateway(f"{fixed}{k + 1}", places[k]) for k in present.tolist()),
        labels=torch.tensor(dbm)[received],
        task=Rssi(),
        rows=numbered[moving][1][received],
        edges=walls,
        one_radio=one_radio,
        remarks=remarks,
    )


def write(folder: str | Path, links: Links) -> None:
    """Writes readings as ``room.csv`` in a folder, for ``read``."""
    receivers = np.array([receiver.pose.position.numpy() for receiver in links.receivers])
    index = links.query.receivers.numpy()
    transmitters = links.query.transmitters.numpy()
    table = np.column_stack((transmitters, receivers[index], links.labels.numpy()))
    rows = []
    for row in table:
        rows.append(",".join(f"{value:.9g}" for value in row))  # nine digits give the same float32
    write_text(Path(folder) / "room.csv", "\n".join((",".join(COLUMNS), *rows)) + "\n")


def _read_table(file: Path, marks: list[float]) -> tuple[dict[str, list], list[float], list[str]]:
    """Positions of both ends by their name [m], readings [dBm], and the names of other columns."""
    lines = tables.read_lines(file, f"a heading with {','.join(COLUMNS)}")
    delimiter = tables.find_delimiter(lines)
    written = tables.split_cells(lines[0], delimiter)
    names = [name.lower() for name in written]
    if not any(name in COLUMNS for name in names):
        raise ValueError(
            f"{file}, line 1: expected columns {','.join(COLUMNS)}, got {tables.quote(lines[0])}; "
            "a table with a place a row and a gateway a column takes data=rssi_wide"
        )
    for name in COLUMNS:
        count = names.count(name)
        if count != 1:
            raise ValueError(
                f"{file}, line 1: expected one column {name}, got {count} in "
                f"{tables.quote(lines[0])}"
            )
    columns = [names.index(name) for name in COLUMNS]
    ends = {}
    levels = {}
    for number, cells in tables.split_rows(file, lines, names, 1, delimiter).items():
        chosen = [cells[column] for column in columns]
        ends[number] = chosen[:6]
        levels[number] = chosen[6:]
    positions = tables.to_coordinates(file, ends, COLUMNS)
    mend = "list them in data.not_heard"
    readings = to_dbm(file, levels, COLUMNS[6:], QUIETEST, marks, mend)
    dbm = [value for (value,) in readings]
    if all(value in marks for value in dbm):
        raise ValueError(
            f"{file}: expected a reading that was heard, got none but {and_list(marks)} dBm"
        )
    points = {"tx": [row[:3] for row in positions], "rx": [row[3:] for row in positions]}
    return points, dbm, [name for name in written if name.lower() not in COLUMNS]
