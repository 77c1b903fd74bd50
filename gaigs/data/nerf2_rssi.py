"""Received signal strength in the folder layout of NeRF²; docs/data.md describes the files."""

import math
import re
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gaigs.data import Links, Parts
from gaigs.geometry import Pose
from gaigs.io.tables import (
    find_folder,
    has_file,
    read_lines,
    read_points,
    refuse,
    to_cells,
    to_columns,
    to_index,
    to_number,
    to_numbers,
)
from gaigs.io.yaml import read_mapping, to_position
from gaigs.query import Query
from gaigs.registry import register
from gaigs.scene import Receiver
from gaigs.task.rssi import Rssi

NOT_HEARD = -100.0
"""What stands for a reading that was not heard [dBm]."""

LOUDEST = 0.0
"""No reading reaches it [dBm]: over 0.3 m alone, 2.4 GHz loses 30 dB, more than the 20 dBm that Bluetooth may send. So
0 and above are other units, a lost sign or other marks of "not heard"."""

POSITIONS, READINGS, LAYOUT = "gateway_position.yml", "gateway_rssi.csv", "layout.csv"
INDICES = ("train_index.txt", "test_index.txt")


@register("data", "nerf2_rssi")
def read(root: str | Path) -> Links:
    """A data set from its folder, which is only read: one link for each reading that a gateway heard.

    Readings of -100 dBm were not heard; they, and gateways that heard nothing, are left out and counted in the remarks.
    Gateways look along the world's axes. The readings of one measurement share a row.

    Args:
        root: Folder with ``tx_pos.csv``, ``gateway_rssi.csv``, ``gateway_position.yml``, for the official split
            ``train_index.txt`` and ``test_index.txt``, and where there is one ``layout.csv``.

    Raises:
        FileNotFoundError: There is no such folder.
        ValueError: Something is wrong with the files; the message lists the defects by file, line and value.

    Source: NeRF², https://github.com/XPengZhao/NeRF2.
    """
    root = find_folder(root)
    defects: list[str] = []
    positions = read_points(root / "tx_pos.csv", "xyz", "x,y,z [m] of one measurement a line", defects)
    gateways = _read_gateways(root, defects)
    names, readings = _read_readings(root, gateways, defects)
    if positions and readings and len(positions) != len(readings):
        defects.append(f"{READINGS}: expected {len(positions)} rows of readings as in tx_pos.csv, got {len(readings)}")
    walls = read_walls(root / LAYOUT, defects) if has_file(root / LAYOUT) else torch.zeros(0, 2, 3)
    refuse(root, defects)

    dbm = torch.tensor(readings, dtype=torch.float64)
    heard = dbm > NOT_HEARD
    rows, columns = heard.nonzero(as_tuple=True)
    present, receivers = columns.unique(return_inverse=True)
    remarks = (
        f"{len(rows)} readings of {len(dbm)} rows at {len(present)} gateways; "
        f"{int((~heard).sum())} of {NOT_HEARD:g} dBm were not heard and are left out"
    )
    silent = [name for k, name in enumerate(names) if k not in present]
    if silent:
        remarks += f", and so are the gateways that heard nothing: {', '.join(silent)}"
    return Links(
        query=Query(torch.tensor(positions)[rows], receivers),
        receivers=tuple(gateway(names[k], gateways[names[k]][1]) for k in present.tolist()),
        labels=dbm[heard].float(),
        task=Rssi(),
        rows=rows,
        official=partial(_read_official, root, heard, names),
        edges=walls,
        remarks=remarks,
    )


def gateway(name: str, position: Sequence[float]) -> Receiver:
    """A receiver without orientation: its axes are the world's."""
    return Receiver(name, Pose(torch.tensor(position), torch.eye(3)))


def read_walls(file: Path, defects: list[str]) -> Float[Tensor, "k 2 3"]:
    """Walls of a floor plan, at z = 0 [m]: segments from each vertex x,y of the file to the next."""
    vertices = read_points(file, "xy", "consecutive wall vertices x,y [m], one a line", defects)
    if len(vertices) == 1:
        defects.append(f"{file.name}: expected two wall vertices or more, got 1")
    if defects or not vertices:
        return torch.zeros(0, 2, 3)
    corners = torch.nn.functional.pad(torch.tensor(vertices), (0, 1))
    return torch.stack((corners[:-1], corners[1:]), 1)


def to_dbm(
    place: str, names: Sequence[str], cells: Sequence[str], lowest: float, not_heard: float, defects: list[str]
) -> list[float]:
    """Cells of a line as readings [dBm], from the lowest that may stand there to below 0, or what was not heard."""
    expected = f"an RSSI from {lowest:g} to below {LOUDEST:g} dBm ({not_heard:g} where nothing was heard)"
    return to_numbers(
        place, names, cells, lambda value: value == not_heard or lowest <= value < LOUDEST, expected, defects
    )


def _read_gateways(root: Path, defects: list[str]) -> dict[str, tuple[int, list[float]]]:
    """Line and position [m] of each gateway."""
    entries = read_mapping(root / POSITIONS, "each gateway's name: [x, y, z] [m]", defects)
    return {
        name: (entry.line, to_position(f"{POSITIONS}, line {entry.line}: {name}", entry, defects))
        for name, entry in entries.items()
    }


def _read_readings(root: Path, gateways: Mapping, defects: list[str]) -> tuple[list[str], list[list[float]]]:
    """The gateway of each column, and the readings [dBm] of each row."""
    lines = read_lines(root / READINGS, "an RSSI [dBm] of each gateway, one measurement a line", defects)
    if not lines:
        return [], []
    first = to_cells(lines[0])  # names, or numbers already
    header = any(cell in gateways for cell in first) or all(math.isnan(to_number(cell)) for cell in first)
    names = first if header else [*gateways] or [str(k) for k in range(len(first))]
    if header and gateways:
        place = f"{READINGS}, line 1"
        have = ", ".join(gateways)
        for k, name in enumerate(names):
            if name in names[:k]:
                defects.append(f"{place}: column {name!r} stands there twice")
            elif name not in gateways:
                defects.append(f"{place}: column {name!r} has no position in {POSITIONS}, which has {have}")
        for name, (line, _) in gateways.items():
            if name not in names:
                defects.append(f"{POSITIONS}, line {line}: {name} has no column in {READINGS}")
    if header and len(lines) == 1:
        defects.append(f"{READINGS}: no readings below the header")
    readings = []
    for number, line in [*enumerate(lines, 1)][header:]:
        place = f"{READINGS}, line {number}"
        cells = to_columns(place, line, names, defects)
        readings.append(to_dbm(place, names, cells, NOT_HEARD, NOT_HEARD, defects) if cells else [])
    if readings and all(value == NOT_HEARD for row in readings for value in row):
        defects.append(f"{READINGS}: expected readings above {NOT_HEARD:g} dBm, got none; no gateway heard anything")
    return names, readings


def _read_official(root: Path, heard: Bool[Tensor, "rows gateways"], names: Sequence[str]) -> Parts:
    """Training and test links of the index files, which list rows, or pairs of row and gateway.

    Raises:
        ValueError: Something is wrong with the files; the message lists the defects by file, line and value.
    """
    defects: list[str] = []
    # A gateway is named by its column's number unless numbers are names.
    columns = {} if any(name.isdecimal() for name in names) else {str(k): k for k in range(len(names))}
    columns |= {name: k for k, name in enumerate(names)}
    expected = {None: "a row from 0, or a row and a gateway", False: "one row from 0", True: "a row and a gateway"}
    paired, seen, parts = None, {}, []
    for file in INDICES:
        before, listed = len(defects), torch.zeros_like(heard)
        for number, line in enumerate(read_lines(root / file, f"{expected[None]}, on each line", defects), 1):
            place = f"{file}, line {number}"
            row, *column = re.split(r"\s*,\s*|\s+", line.strip(), maxsplit=1)
            index = to_index(row)
            paired = bool(column) if paired is None and index is not None else paired
            if index is None or bool(column) != paired:
                defects.append(f"{place}: expected {expected[paired]}, got {line!r}")
                continue
            entry = (index, *(columns.get(name) for name in column))
            if index >= len(heard):
                defects.append(f"{place}: expected a row in 0..{len(heard) - 1}, got {row}")
            elif None in entry:
                defects.append(f"{place}: expected a gateway by name or column from 0, got {column[0]!r}")
            elif entry in seen:
                defects.append(f"{place}: {line.strip()!r} stands in {seen[entry]} already")
            else:
                seen[entry] = place
                listed[entry] = True
        # Links are the readings that were heard, row by row.
        parts.append(listed[heard].nonzero()[:, 0])
        if len(defects) == before and not len(parts[-1]):
            defects.append(f"{file}: expected a reading that was heard, got none but {NOT_HEARD:g} in {READINGS}")
    refuse(root, defects)
    return parts[0], parts[1]
