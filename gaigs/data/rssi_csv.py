"""Received signal strength from one table; docs/data.md describes its columns."""

import math
from pathlib import Path

import torch

from gaigs.data import Links
from gaigs.data.nerf2_rssi import LOUDEST, gateway, read_walls, to_dbm
from gaigs.io.tables import find_file, number_places, read_lines, refuse, to_cells, to_columns, to_coordinates
from gaigs.query import Query
from gaigs.registry import register
from gaigs.task.rssi import Rssi

ENDS = ("tx", "rx")
COLUMNS = (*(f"{end}_{axis}" for end in ENDS for axis in "xyz"), "rss_dbm")
"""Positions of transmitter and receiver [m], and the reading [dBm]."""

FIXED = 64
"""Places that the end which stands still may have, each a receiver of its own."""

QUIETEST = -200.0
"""No level lies below it [dBm]: thermal noise alone is -174 dBm in 1 Hz."""


@register("data", "rssi_csv")
def read(
    file: str | Path,
    layout: str | Path | None = None,
    fixed: str | None = None,
    not_heard: float = -100.0,
) -> Links:
    """A data set from a table with a heading, one reading a line: one link for each reading that was heard.

    Unless told, the end with fewer places is the fixed one, the receiver's in a tie. Its places become the receivers,
    ``rx1`` ... or ``tx1`` ... in the order in which they appear, and look along the world's axes; the other end moves
    and gives the transmitters. A fixed transmitter with a moving receiver is thus read as the reverse, which
    reciprocity allows: a channel attenuates alike either way, so where an antenna's gain is the same for sending and
    hearing, the reading is what the fixed end would hear if the moving one sent with the fixed one's power.

    Readings of ``not_heard`` were not heard; they, and fixed places that nothing was heard at, are left out and counted
    in the remarks, which also count levels below it. The readings of one place of the moving end share a row. There is
    no official split.

    Args:
        file: Has the columns ``tx_x``, ``tx_y``, ``tx_z``, ``rx_x``, ``rx_y``, ``rx_z`` [m] and ``rss_dbm`` in any
            order and in any case; others are ignored, and named in the remarks.
        layout: File of wall vertices x,y [m], as ``layout.csv`` of ``nerf2_rssi``; none unless given.
        fixed: The end that stands still, ``tx`` or ``rx``.
        not_heard: What stands for a reading that was not heard [dBm]; all others lie in [-200, 0).

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: ``fixed`` or ``not_heard`` is none of these, the fixed end has more than 64 places, or something is
            wrong with the files; the message lists the defects by file, line and value.
    """
    if fixed not in (None, *ENDS):
        raise ValueError(f"fixed must be tx or rx, or null for the end with fewer places, got {fixed!r}")
    if not isinstance(not_heard, int | float) or not math.isfinite(not_heard):
        raise ValueError(f"not_heard must be a finite number [dBm], got {not_heard!r}; write such a number in the file")
    file = find_file(file, "a table of readings")
    defects: list[str] = []
    points, dbm, ignored = _read_table(file, not_heard, defects)
    walls = torch.zeros(0, 2, 3) if layout is None else read_walls(Path(layout).expanduser(), defects)
    refuse(file, defects)

    numbered = {end: number_places(points[end]) for end in ENDS}
    tx, rx = (len(numbered[end][0]) for end in ENDS)
    counts = f"{FIXED} places at most, got {tx} of the transmitter and {rx} of the receiver"
    if min(tx, rx) > FIXED:
        raise ValueError(
            f"{file}: one end must stand at {counts}: both ends move; keep the readings of a few places of one end"
        )
    fixed = fixed or ("rx" if rx <= tx else "tx")
    moving = "tx" if fixed == "rx" else "rx"
    places, at = numbered[fixed]
    if len(places) > FIXED:
        raise ValueError(f"{file}: with fixed={fixed} this end must stand at {counts}; set fixed={moving} or null")
    heard = torch.tensor([value != not_heard for value in dbm])
    present, receivers = at[heard].unique(return_inverse=True)
    transmitters = torch.tensor(points[moving])[heard]
    words = {"tx": "transmitter", "rx": "receiver"}
    remarks = (
        f"{len(transmitters)} readings of a moving {words[moving]} at {len(present)} places of a fixed {words[fixed]}; "
        f"{int((~heard).sum())} of {not_heard:g} dBm were not heard and are left out"
    )
    silent = [f"{fixed}{k + 1}" for k in range(len(places)) if k not in present]
    if silent:
        remarks += f", and so are the places that nothing was heard at: {', '.join(silent)}"
    if below := sum(value < not_heard < LOUDEST for value in dbm):
        remarks += f"; {below} readings below {not_heard:g} dBm are taken for levels"
    if ignored:
        remarks += f"; columns ignored: {', '.join(ignored)}"
    return Links(
        query=Query(transmitters, receivers),
        receivers=tuple(gateway(f"{fixed}{k + 1}", places[k]) for k in present.tolist()),
        labels=torch.tensor(dbm)[heard],
        task=Rssi(),
        rows=numbered[moving][1][heard],
        edges=walls,
        remarks=remarks,
    )


def _read_table(file: Path, not_heard: float, defects: list[str]) -> tuple[dict[str, list], list[float], list[str]]:
    """Positions of either end [m], readings [dBm], and the columns that are none of ours."""
    lines = read_lines(file, f"a heading with {','.join(COLUMNS)}", defects)
    written = to_cells(lines[0]) if lines else []
    names = [name.lower() for name in written]
    points, dbm = {end: [] for end in ENDS}, []
    has_semicolons = bool(lines) and ";" in lines[0]
    if has_semicolons:
        defects.append(f"{file.name}, line 1: columns are separated by commas, got semicolons in {lines[0]!r}")
    for name in COLUMNS:
        if lines and not has_semicolons and names.count(name) != 1:
            defects.append(f"{file.name}, line 1: expected one column {name}, got {names.count(name)} in {lines[0]!r}")
    if len(lines) == 1:
        defects.append(f"{file.name}: no readings below the heading")
    if defects:
        return points, dbm, []
    at = [names.index(name) for name in COLUMNS]
    for number, line in enumerate(lines[1:], 2):
        place = f"{file.name}, line {number}"
        cells = to_columns(place, line, names, defects)
        if not cells:
            continue
        cells = [cells[k] for k in at]
        coordinates = to_coordinates(place, COLUMNS, cells[:6], defects)
        points["tx"].append(coordinates[:3])
        points["rx"].append(coordinates[3:])
        dbm += to_dbm(place, COLUMNS[6:], cells[6:], QUIETEST, not_heard, defects)
    if not defects and all(value == not_heard for value in dbm):
        defects.append(f"{file.name}: expected a reading that was heard, got none but {not_heard:g} dBm")
    return points, dbm, [name for name in written if name.lower() not in COLUMNS]
