"""Received signal strength in wide tables: rows are places, columns gateways (docs/data.md)."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray

from gaigs.core.geometry import Frame
from gaigs.core.query import Query
from gaigs.core.task.rssi import Rssi
from gaigs.data import Links
from gaigs.data.maps import check_metres, is_utm, to_utm
from gaigs.data.readings import and_list, carriers_of, gateway, remark_on_zeros
from gaigs.data.rssi_wide.columns import Axes, find_axes, find_gateways
from gaigs.data.rssi_wide.places import name_of_gateways, read_gateways, read_points
from gaigs.data.rssi_wide.readings import Survey, averaged, pivoted, refuse_readings
from gaigs.io import FAR, tables
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
    receiver: str | None = None,
    level: str | None = None,
) -> Links:
    """A data set from a wide table: one link for each place and each gateway received there.

    Columns are separated by commas, semicolons, tabs or bars; numbers have a decimal point or
    comma. Columns of coordinates have usual names, such as ``x``, ``easting``, ``longitude`` or
    ``altitude``, and may state a unit, as in ``x [cm]``. Gateways are the columns named in
    ``gateways``, and columns of mostly levels with a median of at most -20 dBm. Rows of one place
    are averaged in dB. Gateways have the world's axes.

    Args:
        file: The table. Levels lie in [-150, 30] dBm. Empty cells and NaN were not received.
        gateways: Table of ``name,x,y,z``, or YAML of ``name: [x, y, z]``, in the coordinates of the
            places. Places of other gateways are estimated from the training links.
        coordinates: Columns of x, y and optionally z or floor; longitude and easting come first.
            None: columns with usual names.
        ignore: Columns that are not gateways.
        not_heard: Values that mean "not heard"; None: the result of
            ``gaigs.data.readings.marks_of``.
        height: Height of all places and gateways without one, and of floor 0 [m].
        storey: Height of a storey [m], for a column ``floor``.
        epsg: Code of the coordinate system, such as 32632; x and y are in its unit. None: WGS 84
            for degrees, no system for metres. Coordinates of other systems than UTM are converted
            to UTM, which needs ``gaigs[maps]``.
        frequency: Carrier [Hz]; None if it is unknown or changes from reading to reading.
        receiver: Column of the gateways' names, for a table with a reading a line; needs ``level``.
        level: Column of the readings of such a table [dBm].

    Raises:
        FileNotFoundError: The file does not exist.
        ImportError: Coordinates are to be converted, and pyproj is not installed.
        ValueError: A file has a defect; the message names file, line, column and value.
    """
    options = coordinates, ignore, not_heard, height, storey, epsg, frequency, receiver, level
    return from_table(_read_table(file), gateways, *options)


def from_table(
    table: tables.Table,
    gateways: str | Path | Mapping | tables.Table | None = None,
    coordinates: list[str] | None = None,
    ignore: list[str] | None = None,
    not_heard: float | list[float] | None = None,
    height: float = 1.0,
    storey: float = 3.0,
    epsg: int | None = None,
    frequency: float | None = None,
    receiver: str | None = None,
    level: str | None = None,
    levels: Sequence[str] = (),
) -> Links:
    """A data set from a wide table in memory; ``read`` does the same for a file.

    Args:
        table: Table with a row for each place and a column for each gateway.
        gateways: As for ``read``, or a mapping of names to [x, y, z], or a table in memory.
        levels: Columns that are gateways whatever their numbers look like.
    """
    axes = find_axes(table, coordinates)
    others: list[str] = []  # columns of a long table that are not used
    if receiver is not None or level is not None:
        table, axes, others = pivoted(table, axes, receiver, level)
        levels = table.names[len(axes.columns) :]
    points = read_points(table, axes, height, storey, epsg)
    placed, unused = read_gateways(gateways, table, axes, height, storey, epsg)
    columns = find_gateways(table, axes, {*placed, *levels}, ignore or [], not_heard)
    refuse_readings(table, columns)
    is_placed = ~np.isnan(points).any(1)
    count = int(is_placed.sum())
    if not count:
        raise ValueError(f"{table.file}: expected rows with coordinates, got none")
    # Places and gateways are converted together, to one frame.
    points_and_gateways = np.array([*points[is_placed], *placed.values()])
    world = _to_world(table, axes, points_and_gateways, count, epsg, name_of_gateways(gateways))
    stands = dict(zip(placed, world.points[count:].tolist(), strict=True))

    readings = table.numbers[is_placed][:, columns.gateways]  # (rows, gateways)
    received = ~(np.isnan(readings) | np.isin(readings, columns.marks))
    survey = averaged(world.points[:count], readings, received)
    rows, receivers = survey.counts.nonzero()
    measured = len(np.unique(rows))
    if measured < 2:
        raise ValueError(
            f"{table.file}: expected levels at two places or more, got {measured}; see "
            "data.not_heard"
        )
    names = [table.names[columns.gateways[k]] for k in np.unique(receivers)]
    silent = [table.names[k] for k in columns.gateways if table.names[k] not in names]
    remarks = [
        f"{len(rows)} readings of {measured} places at {len(names)} gateways",
        *_remarks_on_readings(survey, received, columns.marks, columns.silent + silent),
    ]
    if placed:
        remarks += _remarks_on_gateways(name_of_gateways(gateways), names, stands, unused)
    if count < len(points):
        remarks.append(f"{len(points) - count} rows without coordinates are left out")
    remarks += [*_remarks_on_heights(axes, placed, height, storey), world.remark]
    if columns.ignored or others:
        remarks.append(f"columns ignored: {tables.shortened(columns.ignored + others)}")

    positions = [stands.get(name) for name in names]
    links = _to_links(survey, names, positions, frequency)
    text = "; ".join(filter(None, remarks)) + remark_on_zeros(links.labels.tolist())
    return replace(links, frame=world.frame, remarks=text)


def _to_links(
    survey: Survey,
    names: Sequence[str],
    positions: Sequence[Sequence[float] | None],
    frequency: float | None,
) -> Links:
    """Links of the gateways that have a reading.

    Args:
        names: Names of these gateways, in the order of their columns.
        positions: Position of each of them [m]; None if unknown.
    """
    rows, columns = survey.counts.nonzero()  # place and gateway of each link
    receivers = np.unique(columns, return_inverse=True)[1]  # numbers among gateways with a reading
    nowhere = [0.0, 0.0, 0.0]  # until the training links estimate it
    uncertainties = [math.inf if position is None else 0.0 for position in positions]
    places = torch.from_numpy(survey.places).float()[rows]
    pairs = zip(names, positions, strict=True)
    return Links(
        query=Query(places, torch.from_numpy(receivers), carriers_of(frequency, len(rows))),
        receivers=tuple(gateway(name, position or nowhere) for name, position in pairs),
        labels=torch.from_numpy(survey.means[survey.counts > 0]).float(),
        task=Rssi(),
        rows=torch.from_numpy(rows),
        uncertainties=torch.tensor(uncertainties),
        noises=survey.noises,
    )


def _read_table(file: str | Path) -> tables.Table:
    """The wide table of a file; a ``ValueError`` for one with a reading in each line."""
    path = tables.find_file(file, "a table of readings")
    table = tables.read_table(path, "a heading x,y,ap1,ap2,... and one place a line")
    if {"tx_x", "rx_x"} <= {name.lower() for name in table.names}:
        raise ValueError(
            f"{table.file}, line 1: a table of a reading a line, with tx_x and rx_x; take "
            "data=rssi_csv"
        )
    return table


def _remarks_on_readings(
    survey: Survey,
    received: Bool[ndarray, "rows g"],
    marks: Sequence[float],
    silent: Sequence[str],
) -> list[str]:
    """Remarks on readings that were averaged, and on cells and ``silent`` gateways left out."""
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
    """Remarks on heights that come from options, as the table or the gateways have none."""
    if axes.z < 0:
        return [f"all places are {height:g} m high (data.height)"]
    if axes.is_floor:
        return [f"heights are those of floors, {storey:g} m each (data.storey)"]
    # The gateways' file may have no height.
    at_height = [name for name, place in placed.items() if place[2] == height]
    if not at_height:
        return []
    return [f"gateways that are {height:g} m high (data.height): {tables.shortened(at_height)}"]


def _remarks_on_gateways(
    file: str, names: Sequence[str], stands: Mapping, unused: Sequence[str]
) -> list[str]:
    """Remarks on gateways that the file lacks, and on its ``unused`` gateways without a column."""
    remarks = []
    unplaced = [name for name in names if name not in stands]
    if unplaced:
        remarks.append(f"gateways without a place in {file}: {tables.shortened(unplaced)}")
    if unused:
        remarks.append(f"gateways of {file} without a column: {tables.shortened(unused)}")
    return remarks


class World(NamedTuple):
    """Points in the world frame, and the frame's place on a map."""

    points: Float[ndarray, "n 3"]  # places, then gateways [m]
    frame: Frame | None  # the frame's place on a map; None if unknown
    remark: str  # on the origin; empty if points stay as they are


def _to_world(
    table: tables.Table,
    axes: Axes,
    points: Float[ndarray, "n 3"],
    count: int,
    epsg: int | None,
    gateways: str,
) -> World:
    """Points in the world frame, near its origin.

    Degrees are converted to UTM. The origin moves to the lowest place if coordinates are of a map
    or too large. A ``ValueError`` for coordinates that seem to be degrees, or far apart.

    Args:
        points: Coordinates of ``count`` places, then of gateways, which are changed in place.
        gateways: Name of the gateways' file, for messages.
    """
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
        check_metres(gateways, points[count:], "convert them to the coordinates of the places")
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
