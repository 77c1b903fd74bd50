"""Received signal strength in a table, a place a row and a gateway a column (docs/data.md)."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from torch import Tensor

from gaigs.core.geometry import Frame
from gaigs.core.query import Query
from gaigs.core.task.rssi import Rssi
from gaigs.data import Links
from gaigs.data.maps import check_metres, is_utm, to_utm
from gaigs.data.readings import and_list, carriers_of, gateway, loud_remark, match_names, suggested
from gaigs.data.rssi_wide.columns import (
    NAMES,
    UNITS,
    Axes,
    find_axes,
    find_gateways,
    plain_name,
    refuse_cells,
    units_of,
)
from gaigs.io import FAR, tables
from gaigs.io.yaml import read_mapping, to_vector
from gaigs.registry import register


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
        file: The table. Levels lie in [-150, 30] dBm. Empty cells and NaN were not received.
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
    table = _read_table(file)
    axes = find_axes(table, coordinates)
    points = _read_points(table, axes, height, storey, epsg)
    placed, unused = _read_gateways(gateways, table, axes, height, storey, epsg)
    columns = find_gateways(table, axes, placed, ignore or [], not_heard)
    is_placed = ~np.isnan(points).any(1)
    count = int(is_placed.sum())
    if not count:
        raise ValueError(f"{table.file}: expected rows with coordinates, got none")
    everything = np.array([*points[is_placed], *placed.values()])
    world = _to_world(table, axes, everything, count, epsg, gateways)
    stands = dict(zip(placed, world.points[count:].tolist(), strict=True))

    levels = table.numbers[is_placed][:, columns.gateways]  # (rows, gateways)
    received = ~(np.isnan(levels) | np.isin(levels, columns.marks))
    survey = _averaged(world.points[:count], levels, received)
    rows, receivers = survey.counts.nonzero()
    measured = _count_places(rows, table.file)
    present, receivers = np.unique(receivers, return_inverse=True)
    names = [table.names[columns.gateways[k]] for k in present]
    unit = ""
    if placed and not world.remark:
        unit = _unit_of_gateways(survey, dict(zip(names, present.tolist(), strict=True)), stands)

    silent = [table.names[k] for k in columns.gateways if table.names[k] not in names]
    remarks = [
        f"{len(rows)} readings of {measured} places at {len(names)} gateways",
        *_remarks_on_readings(survey, received, columns.marks, columns.silent + silent),
    ]
    if placed:
        remarks += _remarks_on_gateways(Path(gateways).name, names, stands, unit, unused)
    if count < len(points):
        remarks.append(f"{len(points) - count} rows without coordinates are left out")
    remarks += [*_remarks_on_heights(axes, placed, height, storey), world.remark]
    if columns.ignored:
        remarks.append(f"columns ignored: {tables.shortened(columns.ignored)}")

    labels = torch.from_numpy(survey.means[survey.counts > 0]).float()
    places = torch.from_numpy(survey.places).float()[rows]
    return Links(
        query=Query(places, torch.from_numpy(receivers), carriers_of(frequency, len(rows))),
        receivers=tuple(gateway(name, stands.get(name, [0.0, 0.0, 0.0])) for name in names),
        labels=labels,
        task=Rssi(),
        rows=torch.from_numpy(rows),
        frame=world.frame,
        uncertainties=torch.tensor([0.0 if name in stands else math.inf for name in names]),
        noises=survey.noises,
        remarks="; ".join(filter(None, remarks)) + loud_remark(labels.tolist()),
    )


def _read_table(file: str | Path) -> tables.Table:
    """The table of readings; a ``ValueError`` for a table with a reading a line."""
    path = tables.find_file(file, "a table of readings")
    table = tables.read_table(path, "a heading x,y,ap1,ap2,... and one place a line")
    if {"tx_x", "rx_x"} <= {name.lower() for name in table.names}:
        raise ValueError(
            f"{table.file}, line 1: a table of a reading a line, with tx_x and rx_x; take "
            "data=rssi_csv"
        )
    return table


def _count_places(rows: Int[ndarray, " n"], file: Path) -> int:
    """Number of places with a reading; a ``ValueError`` if it is below two."""
    count = len(np.unique(rows))
    if count < 2:
        raise ValueError(
            f"{file}: expected levels at two places or more, got {count}; see data.not_heard"
        )
    return count


def _remarks_on_readings(
    survey: "Survey",
    received: Bool[ndarray, "rows g"],
    marks: Sequence[float],
    silent: Sequence[str],
) -> list[str]:
    """Remarks on readings that were averaged or left out."""
    how = f"{and_list(marks)}, or empty" if marks else "empty ones"
    remarks = [f"{int((~received).sum())} cells were not heard: {how}"]
    if survey.repeats:
        remarks.append(
            f"repeated readings of one place, of {len(received)} rows, are averaged, and scatter "
            f"by {survey.scatter:.2g} dB"
        )
    empty = int((survey.counts == 0).all(1).sum())
    if empty:
        remarks.append(f"{empty} places hear nothing, and are left out")
    if silent:
        remarks.append(f"gateways that heard nothing are left out: {tables.shortened(silent)}")
    return remarks


def _remarks_on_heights(axes: Axes, placed: Mapping, height: float, storey: float) -> list[str]:
    """Remarks on heights that options gave."""
    if axes.z < 0:
        return [f"all places are {height:g} m high (data.height)"]
    if axes.is_floor:
        return [f"heights are those of floors, {storey:g} m each (data.storey)"]
    # The gateways' file may have no height.
    level = [name for name, place in placed.items() if place[2] == height]
    if not level:
        return []
    return [f"gateways that are {height:g} m high (data.height): {tables.shortened(level)}"]


def _remarks_on_gateways(
    file: str, names: Sequence[str], stands: Mapping, unit: str, unused: Sequence[str]
) -> list[str]:
    """Remarks on the file of gateways: those that it lacks, its unit, those without a column."""
    remarks = []
    unplaced = [name for name in names if name not in stands]
    if unplaced:
        remarks.append(f"gateways without a place in {file}: {tables.shortened(unplaced)}")
    if unit:
        remarks.append(
            f"gateways of {file} are probably in {unit}: name the unit in its heading, as "
            f"x [{unit}]"
        )
    if unused:
        remarks.append(f"gateways of {file} without a column: {tables.shortened(unused)}")
    return remarks


class Survey(NamedTuple):
    """Readings averaged at each place.

    Attributes:
        places: Different places [m].
        counts: Number of readings at each place and gateway.
        means: Their means [dBm]; 0 without a reading.
        repeats: Number of readings beyond the first of a place.
        scatter: Standard deviation of repeated readings [dB].
        noises: Standard deviation of each mean [dB]; None without repetitions.
    """

    places: Float[ndarray, "p 3"]
    counts: Float[ndarray, "p g"]
    means: Float[ndarray, "p g"]
    repeats: int
    scatter: float
    noises: Float[Tensor, " n"] | None


def _averaged(
    points: Float[ndarray, "rows 3"],
    levels: Float[ndarray, "rows g"],
    received: Bool[ndarray, "rows g"],
) -> Survey:
    """Means of the received levels of each place."""
    places, numbers = tables.number_places(points.tolist())
    which = numbers.numpy()
    counts = np.zeros((len(places), levels.shape[1]))
    sums = np.zeros_like(counts)
    np.add.at(counts, which, received)
    np.add.at(sums, which, np.where(received, levels, 0))
    means = sums / counts.clip(1)
    repeats = int(received.sum()) - int((counts > 0).sum())
    if not repeats:
        return Survey(np.array(places), counts, means, 0, 0.0, None)
    errors = np.where(received, levels - means[which], 0)
    scatter = math.sqrt(np.square(errors).sum() / repeats)
    noises = torch.from_numpy(scatter / np.sqrt(counts[counts > 0])).float()
    return Survey(np.array(places), counts, means, repeats, scatter, noises)


def _read_points(
    table: tables.Table, axes: Axes, height: float, storey: float, epsg: int | None
) -> Float[ndarray, "rows 3"]:
    """Coordinates of all rows; NaN where they are empty."""
    columns = [axes.x, axes.y, *([axes.z] if axes.z >= 0 else [])]
    points = table.numbers[:, columns]
    refuse_cells(table, columns, np.isinf(points), "a finite number")
    points = points * units_of(table, axes, epsg)[: len(columns)]
    if axes.z < 0:
        return np.column_stack((points, np.full(len(points), height)))
    if axes.is_floor:
        points[:, 2] = height + storey * points[:, 2]
    return points


def _read_gateways(
    given: str | Path | None,
    table: tables.Table,
    axes: Axes,
    height: float,
    storey: float,
    epsg: int | None,
) -> tuple[dict[str, list[float]], list[str]]:
    """Coordinates of a file's gateways by the table's names, and its gateways without a column."""
    if given is None:
        return {}, []
    file = tables.find_file(given, "a table of gateways")
    if file.suffix.lower() in (".yml", ".yaml"):
        places = {}
        units = units_of(table, axes, epsg)
        for name, value in read_mapping(file, "each gateway's name: [x, y, z]").items():
            count = 2 if isinstance(value, list) and len(value) == 2 else 3
            vector = to_vector(f"{file}: {name}", value, "xyz"[:count])
            place = [unit * x for unit, x in zip(units, vector, strict=False)]
            if axes.is_floor:
                place[2:] = [height + storey * floor for floor in place[2:]]
            places[name] = [*place, height][:3]
    else:
        other = tables.read_table(file, "a heading name,x,y,z and one gateway a line")
        other_axes = find_axes(other)
        if other_axes.is_global != axes.is_global:
            raise ValueError(
                f"{file}, line 1: expected the coordinates of {table.file.name}, got other ones"
            )
        plain = [plain_name(name)[0] for name in other.names]
        column = next((k for k, name in enumerate(plain) if name in NAMES), None)
        if column is None:
            raise ValueError(
                f"{file}, line 1: expected a column name, got "
                f"{tables.quote(', '.join(other.names))}"
            )
        points = _read_points(other, other_axes, height, storey, epsg)
        missing = {row + 2: "none" for row in np.isnan(points).any(1).nonzero()[0].tolist()}
        tables.refuse(file, missing, "coordinates of each gateway")
        names = [tables.split_cells(line, other.delimiter)[column] for line in other.lines[1:]]
        repeated = {}
        for row, name in enumerate(names):
            if name in names[:row]:
                repeated[row + 2] = tables.quote(name)
        tables.refuse(file, repeated, "each gateway once")
        places = dict(zip(names, points.tolist(), strict=True))
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


def _unit_of_gateways(
    survey: "Survey", columns: Mapping[str, int], stands: Mapping[str, Sequence[float]]
) -> str:
    """The unit, cm or mm, in which far gateways explain the levels by distance; or ""."""
    known = [name for name in columns if name in stands]
    means = np.where(survey.counts > 0, survey.means, np.nan)
    levels = means[:, [columns[name] for name in known]]  # (n, k)
    positions = np.array([stands[name] for name in known])  # (k, 3)
    places = survey.places
    extent = np.ptp(places[:, :2], axis=0).max()
    if np.ptp(positions[:, :2], axis=0).max() <= 30 * extent:
        return ""
    # Correlations of levels with log distances within gateways. A false unit puts gateways so far
    # away that distances hardly differ.
    falls = {"": 0.5}
    for unit in ("cm", "mm"):
        apart = np.linalg.norm(places[:, None] - UNITS[unit] * positions, axis=2).clip(
            0.1
        )  # (n, k)
        x = np.where(np.isnan(levels), np.nan, np.log10(apart))
        x = x - np.nanmean(x, 0)
        y = levels - np.nanmean(levels, 0)
        norms = np.sqrt(np.nansum(x**2) * np.nansum(y**2))
        falls[unit] = -np.nansum(x * y) / max(norms, 1e-9)
    return max(falls, key=falls.__getitem__)


class World(NamedTuple):
    """Places and gateways in the world frame [m], the frame's place on a map, and a remark."""

    points: Float[ndarray, "n 3"]
    frame: Frame | None
    remark: str


def _to_world(
    table: tables.Table,
    axes: Axes,
    points: Float[ndarray, "n 3"],
    count: int,
    epsg: int | None,
    gateways: str | Path | None,
) -> World:
    """Places (the first ``count``) and gateways in the world frame."""
    largest = np.abs(points[:count]).max(0)
    x, y = table.names[axes.x], table.names[axes.y]
    if epsg is None and axes.is_global and largest[0] <= 180:
        if largest[1] > 90:
            row = int(np.abs(points[:count, 1]).argmax())
            raise ValueError(
                f"{table.file}: expected latitudes within 90 degrees in column {y}, got "
                f"{points[row, 1]:g}; if longitudes are there, set data.coordinates; if metres "
                "are, name the columns x and y"
            )
        epsg = 4326
    if epsg == 4326:
        around = (points[:count, 0] - points[0, 0] + 180) % 360  # longitudes may pass 180 degrees
        spans = np.ptp(around), np.ptp(points[:count, 1])
        if spans[0] > 10 or spans[1] > 1:  # 100 km are 0.9 degrees of latitude
            raise ValueError(
                f"{table.file}: columns {x} and {y} span {spans[0]:.3g} and {spans[1]:.3g} "
                "degrees, beyond 100 km; if they are metres, name them x and y, without data.epsg"
            )
    if epsg is None or is_utm(epsg):
        mend = f"set data.epsg=4326 and data.coordinates=[{x},{y}], longitude first"
        check_metres(f"{table.file}: columns {x} and {y}", points[:count], mend)
        check_metres(f"{gateways}", points[count:], "convert them to the coordinates of the places")
    utm = None
    frame = None
    remark = ""
    if epsg is not None:
        points[:, :2], utm = to_utm(points[:, :2], epsg)
    if epsg is not None or largest[:2].max() >= FAR:
        origin = np.floor(points[:count, :2].min(0))
        points[:, :2] -= origin
        system = f"EPSG:{utm}" if utm else "the table's coordinates, whose system data.epsg names"
        remark = f"the world's origin is ({origin[0]:.0f}, {origin[1]:.0f}) in {system}"
        if utm:
            frame = Frame(utm, *origin.tolist())
    far = np.abs(points).max(1) >= FAR
    if far.any():
        file = table.file if far[:count].any() else gateways
        place = ", ".join(f"{coordinate:g}" for coordinate in points[far][0])
        raise ValueError(
            f"{file}: expected places within 100 km of each other, got one at ({place}) m; in mm "
            "or cm?"
        )
    return World(points, frame, remark)
