"""Coordinates of a table's rows, and of gateways from a file, a mapping or a table."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gaigs.data.readings import match_names, suggested
from gaigs.data.rssi_wide.columns import (
    NAMES,
    Axes,
    find_axes,
    plain_name,
    refuse_cells,
    units_of,
)
from gaigs.io import tables
from gaigs.io.yaml import read_mapping, to_vector


def name_of_gateways(gateways: str | Path | Mapping | tables.Table | None) -> str:
    """Word for the source of gateways in messages: their file, or ``receivers`` in memory."""
    return Path(gateways).name if isinstance(gateways, str | Path) else "receivers"


def read_points(
    table: tables.Table, axes: Axes, height: float, storey: float, epsg: int | None
) -> Float[ndarray, "rows 3"]:
    """Coordinates of all rows: metres, or the unit of the system ``epsg``; NaN for empty cells.

    Args:
        height: Height of rows without one, and of floor 0 [m].
        storey: Height of a storey [m].
        epsg: Code of the coordinate system; None if unknown.
    """
    columns = axes.columns
    if len({*columns}) < len(columns):
        names = [table.names[column] for column in columns]
        raise ValueError(f"data.coordinates must be different columns, got {names}")
    points = table.numbers[:, columns]
    refuse_cells(table, columns, np.isinf(points), "a finite number")
    points = points * units_of(table, axes, epsg)[: len(columns)]
    if axes.z < 0:
        return np.column_stack((points, np.full(len(points), height)))
    if axes.is_floor:
        points[:, 2] = height + storey * points[:, 2]
    return points


def read_gateways(
    given: str | Path | Mapping | tables.Table | None,
    table: tables.Table,
    axes: Axes,
    height: float,
    storey: float,
    epsg: int | None,
) -> tuple[dict[str, list[float]], list[str]]:
    """Coordinates of gateways by the table's columns, and the names of gateways without a column.

    Args:
        given: File of gateways, or the gateways in memory; None: no gateway has a given place.
        table: Table of readings, whose coordinates are in the columns ``axes``.

    Raises:
        ValueError: No gateway has a column, or the file or mapping has a defect.
    """
    if given is None:
        return {}, []
    file: Path = Path(name_of_gateways(given))  # for messages
    if isinstance(given, str | Path):
        file = tables.find_file(given, "a table of gateways")
        if file.suffix.lower() in (".yml", ".yaml"):
            given = read_mapping(file, "each gateway's name: [x, y, z]")
        else:
            given = tables.read_table(file, "a heading name,x,y,z and one gateway a line")
    if isinstance(given, Mapping):
        places = _mapped_gateways(file, given, units_of(table, axes, epsg), axes, height, storey)
    else:
        places = _listed_gateways(given, table, axes, height, storey, epsg)
    columns = [name for k, name in enumerate(table.names) if k not in axes[:3]]
    matched = match_names(places, columns)
    if not matched:
        raise ValueError(
            f"{file}: none of its gateways is a column of {table.file.name}: "
            f"{tables.shortened([*places])}\nthe columns are {tables.shortened(columns)}"
        )
    placed = {column: places[name] for name, column in matched.items()}
    others = [name for name in columns if name not in placed]
    return placed, [suggested(name, others) for name in places if name not in matched]


def _mapped_gateways(
    file: Path,
    given: Mapping[str, object],
    units: Sequence[float],
    axes: Axes,
    height: float,
    storey: float,
) -> dict[str, list[float]]:
    """Coordinates of gateways by their names, from lists of x, y and optionally z.

    Args:
        units: Factors of x, y and z to metres.
        axes: Columns of the table; if it has floors, z of a gateway is a floor, too.
        height: Height of gateways without z, and of floor 0 [m].
        storey: Height of a storey [m].
    """
    places = {}
    for name, value in given.items():
        # The error of any other value asks for x, y and z.
        count = 2 if isinstance(value, list) and len(value) == 2 else 3
        vector = to_vector(f"{file}: {name}", value, "xyz"[:count])
        place = [unit * x for unit, x in zip(units, vector, strict=False)]  # z may be missing
        if len(place) < 3:
            place.append(height)
        elif axes.is_floor:
            place[2] = height + storey * place[2]
        places[name] = place
    return places


def _listed_gateways(
    given: tables.Table,
    table: tables.Table,
    axes: Axes,
    height: float,
    storey: float,
    epsg: int | None,
) -> dict[str, list[float]]:
    """Coordinates of gateways by their names, from a table with a row for each gateway."""
    given_axes = find_axes(given)
    if given_axes.is_global != axes.is_global:
        raise ValueError(
            f"{given.heading}: expected the coordinates of {table.file.name}, got other ones"
        )
    plain = [plain_name(name)[0] for name in given.names]
    column = next((k for k, name in enumerate(plain) if name in NAMES), None)
    if column is None:
        raise ValueError(
            f"{given.heading}: expected a column name, got {tables.quote(', '.join(given.names))}"
        )
    points = read_points(given, given_axes, height, storey, epsg)
    missing = np.isnan(points).any(1).nonzero()[0].tolist()
    given.refuse(dict.fromkeys(missing, "none"), "coordinates of each gateway")
    names = [given.text(row, column) for row in range(len(points))]
    repeated = {}
    for row, name in enumerate(names):
        if name in names[:row]:
            repeated[row] = tables.quote(name)
    given.refuse(repeated, "each gateway once")
    return dict(zip(names, points.tolist(), strict=True))
