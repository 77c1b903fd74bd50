"""Received signal strength in the folder layout of NeRF²; docs/data.md describes the files."""

import math
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Bool
from torch import Tensor

from gaigs.core.query import Query
from gaigs.core.task.rssi import Rssi
from gaigs.data import Links, Parts
from gaigs.data.readings import (
    carriers_of,
    gateway,
    match_names,
    remark_on_zeros,
    suggested,
    to_dbm,
)
from gaigs.io import tables
from gaigs.io.yaml import read_mapping, to_position
from gaigs.registry import register

NOT_HEARD = -100.0
"""Value of readings that were not received [dBm]."""


@register("data", "nerf2_rssi", task="rssi", split="official_runs")
def read(root: str | Path, frequency: float | None = None) -> Links:
    """A data set from its folder: one link for each reading that a gateway received.

    A reading of -100 dBm means "not received". Such readings, and gateways without other readings,
    are left out; the remarks count them. Gateways look along the world's axes. The readings of one
    measurement share a row.

    Args:
        root: Folder with ``tx_pos.csv``, ``gateway_rssi.csv``, ``gateway_position.yml``, for the
            official split ``train_index.txt`` and ``test_index.txt``, and optionally
            ``layout.csv``.
        frequency: Carrier [Hz]; None if it is unknown or changes from reading to reading.

    Raises:
        FileNotFoundError: The folder does not exist.
        ValueError: A file has a defect; the message names file, line and value.

    Source: NeRF², https://github.com/XPengZhao/NeRF2.
    """
    root = tables.find_folder(root)
    positions = tables.read_points(
        root / "tx_pos.csv", "xyz", "x,y,z [m] of one measurement a line"
    )
    file = root / "gateway_position.yml"
    gateways = {}
    for name, value in read_mapping(file, "each gateway's name: [x, y, z] [m]").items():
        gateways[name] = to_position(f"{file}: {name}", value)
    names, readings = _read_readings(root / "gateway_rssi.csv", [*gateways])
    if len(positions) != len(readings):
        raise ValueError(
            f"{root}: tx_pos.csv has {len(positions)} positions, gateway_rssi.csv {len(readings)} "
            "rows"
        )
    layout = root / "layout.csv"
    walls = tables.read_walls(layout) if tables.has_file(layout) else torch.zeros(0, 2, 3)

    dbm = torch.tensor(readings, dtype=torch.float64)  # (rows, gateways)
    received = dbm > NOT_HEARD
    rows, columns = received.nonzero(as_tuple=True)
    present, receivers = columns.unique(return_inverse=True)
    remarks = (
        f"{len(rows)} readings of {len(dbm)} rows at {len(present)} gateways; "
        f"{int((~received).sum())} of {NOT_HEARD:g} dBm were not heard and are left out"
    )
    silent = [name for k, name in enumerate(names) if k not in present]
    if silent:
        remarks += f", and so are the gateways that heard nothing: {', '.join(silent)}"
    remarks += remark_on_zeros(dbm[received].tolist())
    return Links(
        query=Query(torch.tensor(positions)[rows], receivers, carriers_of(frequency, len(rows))),
        receivers=tuple(gateway(names[k], gateways[names[k]]) for k in present.tolist()),
        labels=dbm[received].float(),
        task=Rssi(),
        rows=rows,
        official=partial(_read_official, root, received, names),
        edges=walls,
        remarks=remarks,
    )


def _read_readings(file: Path, gateways: Sequence[str]) -> tuple[list[str], list[list[float]]]:
    """The gateway of each column, and the readings [dBm] of each row.

    Without a heading, columns are in the order of ``gateways``.
    """
    lines = tables.read_lines(file, "an RSSI [dBm] of each gateway, one measurement a line")
    delimiter = tables.find_delimiter(lines)
    first = tables.split_cells(lines[0], delimiter)
    has_no_number = all(math.isnan(tables.to_number(cell)) for cell in first)
    has_heading = has_no_number or any(cell in gateways for cell in first)
    names = [*gateways]
    if has_heading:
        matched = match_names(first, gateways)
        names = [matched.get(cell, cell) for cell in first]
    for name in names:
        if name not in gateways:
            near = suggested(name, [other for other in gateways if other not in names])
            raise ValueError(
                f"{file}, line 1: column {near} has no position in gateway_position.yml"
            )
    for name in gateways:
        if names.count(name) != 1:
            raise ValueError(
                f"{file}, line 1: expected one column {tables.quote(name)}, got {names.count(name)}"
            )
    rows = tables.split_rows(file, lines, names, int(has_heading), delimiter)
    readings = to_dbm(file, rows, names, NOT_HEARD, [NOT_HEARD], f"write {NOT_HEARD:g}")
    if all(value == NOT_HEARD for row in readings for value in row):
        raise ValueError(
            f"{file}: expected readings above {NOT_HEARD:g} dBm, got none; no gateway heard "
            "anything"
        )
    return names, readings


def _read_official(
    root: Path, received: Bool[Tensor, "rows gateways"], names: Sequence[str]
) -> Parts:
    """Training and test links from index files, which list rows, or pairs of row and gateway.

    Args:
        root: Folder of the index files.
        received: True for each reading that was received; links are these readings, row by row.
        names: Gateway of each column.
    """
    columns = {name: k for k, name in enumerate(names)}
    # A gateway has its column's number as a second name, unless names are numbers.
    if not any(name.isdecimal() for name in names):
        columns |= {str(k): k for k in range(len(names))}

    def parse(line: str) -> tuple[int | None, ...] | None:
        """The row, or row and column, of a line; None for an unknown one."""
        row, *column = re.split(r"\s*,\s*|\s+", line, maxsplit=1)
        entry = tables.to_index(row), *(columns.get(name) for name in column)
        return None if None in entry or entry[0] >= len(received) else entry

    expected = f"a row in 0..{len(received) - 1}, or a row and a gateway"
    parts = tables.read_parts(root, parse, expected)
    lengths = {len(entry) for entry in (*parts[0], *parts[1])}
    if len(lengths) > 1:
        raise ValueError(
            f"{root}: index files must list rows, or pairs of row and gateway, got both"
        )
    indices = []
    for name, part in zip(("train", "test"), parts, strict=True):
        listed = torch.zeros_like(received)
        for entry in part:
            listed[entry] = True
        index = listed[received].nonzero()[:, 0]  # links are received readings, row by row
        if not len(index):
            raise ValueError(
                f"{root}/{name}_index.txt: expected a reading that was heard, got none"
            )
        indices.append(index)
    return indices[0], indices[1]
