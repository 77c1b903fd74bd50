"""Received signal strength in a wide table, one place a row and one gateway a column; docs/data.md
has examples.
"""

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from gaigs.core.geometry import Frame
from gaigs.core.query import Query
from gaigs.core.task.rssi import Rssi
from gaigs.data import Links
from gaigs.data.maps import check_metres, is_utm, metres_of, to_utm
from gaigs.data.readings import (
    LOUDEST,
    QUIETEST,
    and_list,
    carriers_of,
    gateway,
    loud_remark,
    marks_given,
    marks_of,
    match_names,
    suggested,
)
from gaigs.io import FAR, tables
from gaigs.io.yaml import read_mapping, to_vector
from gaigs.registry import register

FORMS = ("{}", "{}pos", "pos{}", "{}coord", "coord{}", "position{}", "tx{}", "loc{}")
PLAIN = {axis: {form.format(axis) for form in FORMS} for axis in "xyz"}
PAIRS = (
    (PLAIN["x"], PLAIN["y"]),
    (
        {"easting", "east", "utmx", "utme", "utmeasting"},
        {"northing", "north", "utmy", "utmn", "utmnorthing"},
    ),
    ({"longitude", "lon", "long", "lng"}, {"latitude", "lat"}),
)
"""Names of the columns of x and y, of easting and northing, of longitude and latitude, in small
letters and digits.
"""

HEIGHTS, FLOORS = (
    PLAIN["z"] | {"alt", "altitude", "elevation", "height"},
    {"floor", "storey", "floorid"},
)
NAMES = {"name", "gateway", "ap", "id", "mac", "bssid", "ssid", "station", "anchor", "beacon"}

UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048, "feet": 0.3048}

WEAK = -20.0
"""Upper bound of the median of a gateway's column [dBm]; columns of larger numbers are something
else.
"""


class Columns(NamedTuple):
    """Columns of gateways, marks of "not heard", and names of gateways that heard nothing and of
    other columns.
    """

    gateways: list[int]
    marks: list[float]
    silent: list[str]
    ignored: list[str]


class Axes(NamedTuple):
    """Columns of x, of y and of the height or the floor; a column of -1 is not there."""

    x: int
    y: int
    z: int
    is_floor: bool
    is_global: bool


@register("data", "rssi_wide", task="rssi", split="random")
def read(
    file: str | Path,
    gateways: str | Path | None = None,
    coordinates: list[str] | None = None,
    ignore: list[str] | None = None,
    not_heard: float | list[float] | None = None,
    height: float = 1.0,
    storey: float = 3.0,
    epsg: int | None = None,
    frequency: float | None = None,
) -> Links:
    """A data set from a wide table: one link for each gateway that a place hears.

    Columns are separated by commas, semicolons, tabs or bars, numbers have a decimal point or
    comma. Coordinates are found by the names ``x``, ``y``, ``z``, ``easting``, ``northing``,
    ``longitude``, ``latitude``, ``altitude`` and the like, with a unit as in ``x [cm]``. Gateways
    are the columns of ``gateways``, and all others that mostly hold levels with a median of at most
    -20 dBm. Rows of one place are averaged in dB. Gateways look along the world's axes.

    Args:
        file: The table. Levels lie in [-150, 30] dBm. Empty cells and NaN were not heard.
        gateways: Table of ``name,x,y,z``, or YAML of ``name: [x, y, z]``, in the coordinates of the
            places. Gateways that it does not have, or all if it is None, get their place from the
            training links.
        coordinates: Columns of x, y and optionally z or floor; longitude and easting come first.
            None: by their names.
        ignore: Columns that are no gateways.
        not_heard: Values that mean "not heard"; None: those that ``gaigs.data.readings.marks_of``
            finds.
        height: Height of all places and gateways without one, and of floor 0 [m].
        storey: Height of a storey [m], for a column ``floor``.
        epsg: System of the coordinates, e.g. 32632 or 3857, in whose unit x and y are; None: WGS 84
            for degrees, none for metres. Coordinates of another system than UTM are converted to
            it, which takes ``gaigs[maps]``.
        frequency: Carrier [Hz]; None if it is unknown or changes from reading to reading.

    Raises:
        FileNotFoundError: The file does not exist.
        ImportError: Coordinates are to be converted, and pyproj is not installed.
        ValueError: A file has a defect; the message names file, line, column and value.
    """
    table = tables.read_table(
        tables.find_file(file, "a table of readings"),
        "a heading x,y,ap1,ap2,... and one place a line",
    )
    if {"tx_x", "rx_x"} <= {name.lower() for name in table.names}:
        raise ValueError(
            f"{table.file}, line 1: a table of a reading a line, with tx_x and rx_x; take data=rssi_csv"
        )
    axes = _find_axes(table, coordinates)
    points = _read_points(table, axes, height, storey, epsg)
    placed: dict[str, list[float]] = {}
    unused: list[str] = []
    if gateways is not None:
        placed, unused = _read_gateways(
            tables.find_file(gateways, "a table of gateways"), table, axes, height, storey, epsg
        )
    columns = _find_gateways(table, axes, placed, ignore or [], not_heard)
    is_placed = ~np.isnan(points).any(1)
    if not is_placed.any():
        raise ValueError(f"{table.file}: expected rows with coordinates, got none")
    everything = np.array([*points[is_placed], *placed.values()])
    everything, frame, moved = _to_world(
        table, axes, everything, int(is_placed.sum()), epsg, gateways
    )
    stands = dict(zip(placed, everything[is_placed.sum() :].tolist(), strict=True))

    levels = table.numbers[is_placed][:, columns.gateways]
    heard = ~(np.isnan(levels) | np.isin(levels, columns.marks))
    places, numbers = tables.number_places(everything[: len(levels)].tolist())
    which = numbers.numpy()
    counts, sums = np.zeros((2, len(places), len(columns.gateways)))
    np.add.at(counts, which, heard)
    np.add.at(sums, which, np.where(heard, levels, 0))
    means = sums / counts.clip(1)
    rows, receivers = counts.nonzero()
    if (some := len(np.unique(rows))) < 2:
        raise ValueError(
            f"{table.file}: expected levels at two places or more, got {some}; see data.not_heard"
        )
    present, receivers = np.unique(receivers, return_inverse=True)
    names = [table.names[columns.gateways[k]] for k in present]
    repeats, noises, scatter = int(heard.sum()) - len(rows), None, 0.0
    if repeats:
        scatter = math.sqrt(np.square(np.where(heard, levels - means[which], 0)).sum() / repeats)
        noises = torch.from_numpy(scatter / np.sqrt(counts[counts > 0])).float()

    silent = columns.silent + [
        table.names[k] for k in columns.gateways if table.names[k] not in names
    ]
    marks = and_list(columns.marks)
    unplaced = [name for name in names if name not in stands]
    unit = ""
    if placed and not moved:
        own = [k for k, name in enumerate(names) if name in stands]
        known = np.where(counts > 0, means, np.nan)[:, present[own]]
        unit = _unit_of_gateways(np.array(places), known, np.array([stands[names[k]] for k in own]))
    # The file may have no height of theirs.
    level = [
        name
        for name, place in placed.items()
        if axes.z >= 0 and not axes.is_floor and place[2] == height
    ]
    empty = len(places) - some
    remarks = [
        f"{len(rows)} readings of {some} places at {len(names)} gateways",
        f"{int((~heard).sum())} cells were not heard: {marks or 'empty ones'}{marks and ', or empty'}",
        repeats
        and f"repeated readings of one place, of {len(levels)} rows, are averaged, and scatter by {scatter:.2g} dB",
        empty and f"{empty} places hear nothing, and are left out",
        silent and f"gateways that heard nothing are left out: {tables.shortened(silent)}",
        placed
        and unplaced
        and f"gateways without a place in {Path(gateways).name}: {tables.shortened(unplaced)}",
        unit
        and f"gateways of {Path(gateways).name} are probably in {unit}: name the unit in its heading, as x [{unit}]",
        unused
        and f"gateways of {Path(gateways).name} without a column: {tables.shortened(unused)}",
        not is_placed.all() and f"{int((~is_placed).sum())} rows without coordinates are left out",
        axes.z < 0 and f"all places are {height:g} m high (data.height)",
        level and f"gateways that are {height:g} m high (data.height): {tables.shortened(level)}",
        axes.is_floor and f"heights are those of floors, {storey:g} m each (data.storey)",
        moved,
        columns.ignored and f"columns ignored: {tables.shortened(columns.ignored)}",
    ]
    labels = torch.from_numpy(means[counts > 0]).float()
    return Links(
        query=Query(
            torch.tensor(places)[rows],
            torch.from_numpy(receivers),
            carriers_of(frequency, len(rows)),
        ),
        receivers=tuple(gateway(name, stands.get(name, [0.0, 0.0, 0.0])) for name in names),
        labels=labels,
        task=Rssi(),
        rows=torch.from_numpy(rows),
        frame=frame,
        uncertainties=torch.tensor([0.0 if name in stands else math.inf for name in names]),
        noises=noises,
        remarks="; ".join(filter(None, remarks)) + loud_remark(labels.tolist()),
    )


def _plain(name: str) -> tuple[str, float | None]:
    """The name of a column in small letters and digits without its unit, and the unit [m]; None if
    it has none.
    """
    match = re.fullmatch(
        r"(.*?)[\s_]*[\[(]?\s*(mm|cm|km|m|ft|feet|deg|°)?\s*[\])]?", name.strip().lower()
    )
    return re.sub(r"[\W_]", "", match[1]), UNITS.get(match[2])


def _units(table: tables.Table, axes: Axes, epsg: int | None) -> list[float]:
    """Factors of x, y and z to metres, or of x and y to the unit of the system; a ``ValueError`` in
    a conflict.
    """
    columns = [axes.x, axes.y, axes.z if axes.z >= 0 else axes.x]
    found = [_plain(table.names[column])[1] for column in columns]
    metres = 1.0 if epsg is None else metres_of(epsg)
    for k, unit in enumerate(found[:2]):
        if unit is None or metres == 1.0:
            continue
        if metres is None or abs(unit - metres) > 1e-5:
            kind = "degrees" if metres is None else f"units of {metres:.6g} m"
            raise ValueError(
                f"{table.file}, line 1: column {table.names[columns[k]]} is in units of {unit:g} m, "
                f"and data.epsg={epsg} in {kind}\nmend the heading, or name the system of these coordinates"
            )
        found[k] = 1.0
    if axes.is_floor:
        found[2] = 1.0
    return [1.0 if unit is None else unit for unit in found]


def _find_axes(table: tables.Table, coordinates: Sequence[str] | None = None) -> Axes:
    """The columns of coordinates, by the names given or by usual ones."""
    plain = [_plain(name)[0] for name in table.names]
    here = f"{table.file}, line 1"
    if coordinates is not None:
        if len(coordinates) not in (2, 3):
            raise ValueError(
                f"data.coordinates must be the columns of x, y and optionally z, got {coordinates}"
            )
        x, y, z = [table.column(name) for name in coordinates] + [-1] * (3 - len(coordinates))
        if plain[x] in PAIRS[2][1] and plain[y] in PAIRS[2][0]:
            raise ValueError(f"data.coordinates must have the longitude first, got {coordinates}")
        return Axes(
            x,
            y,
            z,
            plain[z] in FLOORS and z >= 0,
            plain[x] in PAIRS[2][0] and not _plain(table.names[x])[1],
        )
    found = lambda names: [k for k, name in enumerate(plain) if name in names]
    for pair in PAIRS:
        x, y = map(found, pair)
        heights = found(HEIGHTS) or found(FLOORS)
        if not (x and y):
            continue
        for columns in (x, y, heights):
            if len(columns) > 1:
                doubled = ", ".join(table.names[k] for k in columns)
                raise ValueError(
                    f"{here}: several columns of one coordinate, {doubled}; choose by data.coordinates"
                )
        z = heights[0] if heights else -1
        is_global = pair is PAIRS[2] and not _plain(table.names[x[0]])[1]
        return Axes(x[0], y[0], z, z >= 0 and not found(HEIGHTS), is_global)
    both = [name for k, name in enumerate(table.names) if tables.numbers_in(table.text(0, k))]
    hint = f"; column {both[0]} holds several numbers: give each its column" if both else ""
    raise ValueError(
        f"{here}: expected columns x and y, easting and northing, or longitude and latitude, got "
        f"{tables.quote(', '.join(table.names))}; name them by data.coordinates=[x,y]{hint}"
    )


def _read_points(
    table: tables.Table, axes: Axes, height: float, storey: float, epsg: int | None
) -> Float[ndarray, "rows 3"]:
    """Coordinates of all rows; NaN where they are empty."""
    columns = [axes.x, axes.y, *([axes.z] if axes.z >= 0 else [])]
    own = table.numbers[:, columns]
    wrong = np.isinf(own)
    bad = {
        row + 2: table.cell(row, columns[int(wrong[row].argmax())])
        for row in wrong.any(1).nonzero()[0].tolist()
    }
    tables.refuse(table.file, bad, "a finite number")
    own = own * _units(table, axes, epsg)[: len(columns)]
    if axes.z < 0:
        own = np.column_stack((own, np.full(len(own), height)))
    elif axes.is_floor:
        own[:, 2] = height + storey * own[:, 2]
    return own


def _read_gateways(
    file: Path, table: tables.Table, axes: Axes, height: float, storey: float, epsg: int | None
) -> tuple[dict[str, list[float]], list[str]]:
    """Coordinates of the gateways of a file by the names of the table's columns, and the file's
    other gateways.
    """
    if file.suffix.lower() in (".yml", ".yaml"):
        found, units = {}, _units(table, axes, epsg)
        for name, value in read_mapping(file, "each gateway's name: [x, y, z]").items():
            count = 2 if isinstance(value, list) and len(value) == 2 else 3
            vector = to_vector(f"{file}: {name}", value, "xyz"[:count])
            place = [unit * x for unit, x in zip(units, vector, strict=False)]
            if axes.is_floor:
                place[2:] = [height + storey * floor for floor in place[2:]]
            found[name] = [*place, height][:3]
    else:
        other = tables.read_table(file, "a heading name,x,y,z and one gateway a line")
        own = _find_axes(other)
        if own.is_global != axes.is_global:
            raise ValueError(
                f"{file}, line 1: expected the coordinates of {table.file.name}, got other ones"
            )
        plain = [_plain(name)[0] for name in other.names]
        column = next((k for k, name in enumerate(plain) if name in NAMES), None)
        if column is None:
            raise ValueError(
                f"{file}, line 1: expected a column name, got {tables.quote(', '.join(other.names))}"
            )
        points = _read_points(other, own, height, storey, epsg)
        missing = {row + 2: "none" for row in np.isnan(points).any(1).nonzero()[0].tolist()}
        tables.refuse(file, missing, "coordinates of each gateway")
        names = [tables.split_cells(line, other.delimiter)[column] for line in other.lines[1:]]
        repeated = {
            row + 2: tables.quote(name) for row, name in enumerate(names) if name in names[:row]
        }
        tables.refuse(file, repeated, "each gateway once")
        found = dict(zip(names, points.tolist(), strict=True))
    columns = [name for k, name in enumerate(table.names) if k not in axes[:3]]
    matched = match_names(found, columns)
    if not matched:
        raise ValueError(
            f"{file}: none of its gateways is a column of {table.file.name}: {tables.shortened([*found])}\n"
            f"the columns are {tables.shortened(columns)}"
        )
    placed = {own: found[name] for name, own in matched.items()}
    others = [name for name in columns if name not in placed]
    return placed, [suggested(name, others) for name in found if name not in matched]


def _unit_of_gateways(
    places: Float[ndarray, "n 3"], levels: Float[ndarray, "n k"], stands: Float[ndarray, "k 3"]
) -> str:
    """The unit, cm or mm, in which gateways far beyond the places [m] explain the levels by
    distance; or "".
    """
    spans = [np.ptp(points[:, :2], axis=0).max() for points in (places, stands)]
    if spans[1] <= 30 * spans[0]:
        return ""
    falls = {
        "": 0.5
    }  # least correlation of falling levels with distances within gateways; far ones have none
    for unit in ("cm", "mm"):
        apart = np.linalg.norm(places[:, None] - UNITS[unit] * stands, axis=2).clip(0.1)  # (n, k)
        x = np.where(np.isnan(levels), np.nan, np.log10(apart))
        x, y = x - np.nanmean(x, 0), levels - np.nanmean(levels, 0)
        falls[unit] = -np.nansum(x * y) / max(np.sqrt(np.nansum(x**2) * np.nansum(y**2)), 1e-9)
    return max(falls, key=falls.__getitem__)


def _find_gateways(
    table: tables.Table,
    axes: Axes,
    placed: Mapping,
    ignore: Sequence[str],
    not_heard: float | list[float] | None,
) -> Columns:
    """The columns of gateways, and the marks of "not heard" in them."""
    reserved = {axes.x, axes.y, axes.z, *(table.column(name) for name in ignore)}
    coordinate = HEIGHTS.union(*PAIRS[0], *PAIRS[1], *PAIRS[2])
    free = [k for k in range(len(table.names)) if k not in reserved]
    distinct = [np.unique(own[np.isfinite(own)]) for own in table.numbers.T]
    weak = [((own >= QUIETEST) & (own <= WEAK)).sum() >= max(1, len(own) / 2) for own in distinct]
    likely = [k for k in free if weak[k] or table.names[k] in placed]
    likely = [
        k for k in likely if table.names[k] in placed or _plain(table.names[k])[0] not in coordinate
    ]
    pooled = table.numbers[:, likely]
    if not_heard is None:
        marks = marks_of(pooled)
    else:
        marks = marks_given(not_heard)
    gateways, silent, ignored_columns = [], [], []
    for k in free:
        own = table.numbers[:, k]
        own = own[~(np.isnan(own) | np.isin(own, marks))]
        within = (own >= QUIETEST) & (own <= LOUDEST)
        if not len(own):
            silent.append(table.names[k])
        elif table.names[k] in placed or (
            k in likely and within.mean() >= 0.5 and np.median(own[within]) <= WEAK
        ):
            gateways.append(k)
        else:
            ignored_columns.append(k)
    for k in ignored_columns:
        for row in np.flatnonzero(np.isinf(table.numbers[:, k]))[:1].tolist():
            levels = tables.numbers_in(table.text(row, k))
            if levels and QUIETEST <= min(levels) <= max(levels) <= WEAK:
                cell = table.cell(row, k)
                raise ValueError(
                    f"{table.file}, line {row + 2}: expected one level [dBm] a cell, got {cell}, or set data.ignore"
                )
    powers = [table.names[k] for k in ignored_columns if _are_powers(table.numbers[:, k])]
    if not gateways and powers:
        raise ValueError(
            f"{table.file}: expected levels [dBm], got powers in W or mW in {tables.shortened(powers)}\n"
            "write 10 log10(P / 1 mW)"
        )
    if not gateways:
        raise ValueError(
            f"{table.file}: expected columns of levels [dBm], a gateway each, got none in "
            f"{tables.quote(', '.join(table.names))}; write levels with their sign, or name gateways by data.gateways"
        )
    own = table.numbers[:, gateways]
    wrong = ~(np.isnan(own) | np.isin(own, marks) | ((own >= QUIETEST) & (own <= LOUDEST)))
    bad = {
        row + 2: table.cell(row, gateways[int(wrong[row].argmax())])
        for row in wrong.any(1).nonzero()[0].tolist()
    }
    marked = and_list(marks) or "an empty cell"
    tables.refuse(
        table.file,
        bad,
        f"a level from {QUIETEST:g} to {LOUDEST:g} dBm ({marked} where nothing was heard)",
    )
    ignored = [table.names[k] for k in ignored_columns]
    ignored = [f"{name} (powers in W or mW?)" if name in powers else name for name in ignored]
    return Columns(
        gateways, marks, *([name for name in names if name] for names in (silent, ignored))
    )


def _are_powers(column: Float[ndarray, " n"]) -> bool:
    """True if numbers are positive, below 0.01, and spread over a factor of 3, as powers in W or
    mW.
    """
    own = column[np.isfinite(column) & (column != 0)]
    return bool(len(own) > 2 and own.min() > 0 and own.max() < 1e-2 and own.max() > 3 * own.min())


def _to_world(
    table: tables.Table,
    axes: Axes,
    points: Float[ndarray, "n 3"],
    count: int,
    epsg: int | None,
    gateways: str | Path | None,
) -> tuple[Float[ndarray, "n 3"], Frame | None, str]:
    """Places (the first ``count``) and gateways in the world frame [m], the place of this frame,
    and a remark.
    """
    largest = np.abs(points[:count]).max(0)
    names = table.names[axes.x], table.names[axes.y]
    if epsg is None and axes.is_global and largest[0] <= 180:
        if largest[1] > 90:
            row = int(np.abs(points[:count, 1]).argmax())
            raise ValueError(
                f"{table.file}: expected latitudes within 90 degrees in column {names[1]}, got {points[row, 1]:g}; if "
                "longitudes are there, set data.coordinates; if metres are, name the columns x and y"
            )
        epsg = 4326
    if epsg == 4326:
        around = (points[:count, 0] - points[0, 0] + 180) % 360  # longitudes may pass 180 degrees
        spans = np.ptp(around), np.ptp(points[:count, 1])
        if spans[0] > 10 or spans[1] > 1:  # 100 km are 0.9 degrees of latitude
            raise ValueError(
                f"{table.file}: columns {names[0]} and {names[1]} span {spans[0]:.3g} and {spans[1]:.3g} degrees, "
                "beyond 100 km; if they are metres, name them x and y, without data.epsg"
            )
    if epsg is None or is_utm(epsg):
        mend = f"set data.epsg=4326 and data.coordinates=[{names[0]},{names[1]}], longitude first"
        check_metres(f"{table.file}: columns {names[0]} and {names[1]}", points[:count], mend)
        check_metres(f"{gateways}", points[count:], "convert them to the coordinates of the places")
    utm, remark = None, ""
    if epsg is not None:
        points[:, :2], utm = to_utm(points[:, :2], epsg)
    if epsg is not None or largest[:2].max() >= FAR:
        origin = np.floor(points[:count, :2].min(0))
        points[:, :2] -= origin
        system = f"EPSG:{utm}" if utm else "the table's coordinates, whose system data.epsg names"
        remark = f"the world's origin is ({origin[0]:.0f}, {origin[1]:.0f}) in {system}"
    far = np.abs(points).max(1) >= FAR
    if far.any():
        file = table.file if far[:count].any() else gateways
        found = ", ".join(f"{x:g}" for x in points[far][0])
        raise ValueError(
            f"{file}: expected places within 100 km of each other, got one at ({found}) m; in mm or cm?"
        )
    return points, Frame(utm, *origin.tolist()) if utm else None, remark
