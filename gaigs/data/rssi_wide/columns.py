"""Columns of a wide table: coordinates with their units, gateways, codes of "not heard"."""

import re
from collections.abc import Collection, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from gaigs.data.maps import metres_of
from gaigs.data.readings import LOUDEST, QUIETEST, and_list, marks_given, marks_of
from gaigs.io import tables

AXIS_NAMES = {
    axis: {axis, f"{axis}pos", f"pos{axis}", f"{axis}coord", f"coord{axis}", f"position{axis}",
           f"tx{axis}", f"loc{axis}"}
    for axis in "xyz"
}  # fmt: skip
PAIRS = (
    (AXIS_NAMES["x"], AXIS_NAMES["y"]),
    (
        {"easting", "east", "utmx", "utme", "utmeasting"},
        {"northing", "north", "utmy", "utmn", "utmnorthing"},
    ),
    ({"longitude", "lon", "long", "lng"}, {"latitude", "lat"}),
)
"""Names of columns of x and y, easting and northing, longitude and latitude, in small letters."""

HEIGHTS = AXIS_NAMES["z"] | {"alt", "altitude", "elevation", "height"}
FLOORS = {"floor", "storey", "floorid"}
NAMES = {"name", "gateway", "ap", "id", "mac", "bssid", "ssid", "station", "anchor", "beacon"}

WEAK = -20.0
"""Upper bound of the median of a gateway's column [dBm]; larger numbers are something else."""


class Columns(NamedTuple):
    """Columns of gateways and facts of the other columns."""

    gateways: list[int]  # numbers of the gateways' columns
    marks: list[float]  # values that mean "not heard"
    silent: list[str]  # names of gateways that received nothing
    ignored: list[str]  # names of other columns


class Axes(NamedTuple):
    """Numbers of the columns that hold coordinates."""

    x: int
    y: int
    z: int  # column of the height or the floor; -1 without one
    is_floor: bool  # True if z numbers floors
    is_global: bool  # True if x and y are longitude and latitude

    @property
    def columns(self) -> list[int]:
        """Columns of x, y and, if there is one, z."""
        return [column for column in self[:3] if column >= 0]


def plain_name(name: str) -> tuple[str, float | None]:
    """Name of a heading, in lower-case letters and digits, and its unit [m].

    "X [cm]" gives ("x", 0.01). The unit is None if it is missing or not a length.
    """
    metres = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "km": 1e3, "ft": 0.3048, "feet": 0.3048}
    unit = r"[\s_]*[\[(]?\s*(mm|cm|km|m|ft|feet|deg|°)?\s*[\])]?"
    match = re.fullmatch(rf"(?s)(.*?){unit}", name.strip().lower())
    return re.sub(r"[\W_]", "", match[1]), metres.get(match[2])


def units_of(table: tables.Table, axes: Axes, epsg: int | None) -> list[float]:
    """Factors of x, y and z, from the units in their headings to metres.

    If the unit of the coordinate system ``epsg`` is not the metre, x and y stay in this unit.

    Raises:
        ValueError: A heading has another unit than such a system.
    """
    # Without z, its place is filled by x.
    columns = [axes.x, axes.y, axes.z if axes.z >= 0 else axes.x]
    units = [plain_name(table.names[column])[1] for column in columns]
    metres = 1.0 if epsg is None else metres_of(epsg)
    for k, unit in enumerate(units[:2]):
        if unit is None or metres == 1.0:
            continue
        if metres is None or abs(unit - metres) > 1e-5:
            kind = "degrees" if metres is None else f"units of {metres:.6g} m"
            raise ValueError(
                f"{table.heading}: column {table.names[columns[k]]} is in units of {unit:g} "
                f"m, and data.epsg={epsg} in {kind}\n"
                "mend the heading, or name the system of these coordinates"
            )
        units[k] = 1.0  # in the system's unit already
    if axes.is_floor:
        units[2] = 1.0
    return [1.0 if unit is None else unit for unit in units]


def find_axes(table: tables.Table, coordinates: Sequence[str] | None = None) -> Axes:
    """The columns of coordinates: the ``coordinates`` named, else those with usual names.

    Raises:
        ValueError: Columns are missing or ambiguous, or the latitude comes first.
    """
    plain = [plain_name(name)[0] for name in table.names]
    has_unit = [plain_name(name)[1] is not None for name in table.names]
    longitudes, latitudes = PAIRS[2]
    if coordinates is not None:
        if len(coordinates) not in (2, 3):
            raise ValueError(
                f"data.coordinates must be the columns of x, y and optionally z, got {coordinates}"
            )
        x, y, *height = [table.column(name) for name in coordinates]
        z = height[0] if height else -1
        if plain[x] in latitudes and plain[y] in longitudes:
            raise ValueError(f"data.coordinates must have the longitude first, got {coordinates}")
        is_floor = z >= 0 and plain[z] in FLOORS
        return Axes(x, y, z, is_floor, plain[x] in longitudes and not has_unit[x])

    def columns_of(names: Collection[str]) -> list[int]:
        return [k for k, name in enumerate(plain) if name in names]

    here = table.heading
    for first, second in PAIRS:
        xs = columns_of(first)
        ys = columns_of(second)
        if not (xs and ys):
            continue
        heights = columns_of(HEIGHTS)
        zs = heights or columns_of(FLOORS)
        for columns in (xs, ys, zs):
            if len(columns) > 1:
                doubled = ", ".join(table.names[k] for k in columns)
                raise ValueError(
                    f"{here}: several columns of one coordinate, {doubled}; choose by "
                    "data.coordinates"
                )
        is_global = first is longitudes and not has_unit[xs[0]]
        z = zs[0] if zs else -1
        return Axes(xs[0], ys[0], z, bool(zs) and not heights, is_global)
    # A column such as "(1.0, 2.0)" has all coordinates in one cell.
    joined = [name for k, name in enumerate(table.names) if tables.numbers_in(table.text(0, k))]
    hint = ""
    if joined:
        hint = f"; column {joined[0]} holds several numbers: give each its column"
    raise ValueError(
        f"{here}: expected columns x and y, easting and northing, or longitude and latitude, got "
        f"{tables.quote(', '.join(table.names))}; name them by data.coordinates=[x,y]{hint}"
    )


def refuse_cells(
    table: tables.Table, columns: Sequence[int], wrong: Bool[ndarray, "rows c"], expected: str
) -> None:
    """Raises a ``ValueError`` for wrong cells; nothing is raised if all are right.

    Args:
        columns: Columns of the table that were checked.
        wrong: True for each wrong cell of these columns.
        expected: What a cell must be, for the error.
    """
    # The first wrong cell of each row.
    cells = {}
    for row in np.flatnonzero(wrong.any(1)).tolist():
        cells[row] = table.cell(row, columns[int(wrong[row].argmax())])
    table.refuse(cells, expected)


def find_gateways(
    table: tables.Table,
    axes: Axes,
    placed: Collection[str],
    ignore: Sequence[str],
    not_heard: float | list[float] | None,
) -> Columns:
    """The columns of gateways, and the values that mean "not heard" in them.

    A gateway is a column of mostly low levels, or a column in ``placed``. Columns without a level
    are dropped.

    Args:
        placed: Names of columns that are gateways in any case, such as those with a given place.
        ignore: Names of columns that are no gateways.
        not_heard: Values that mean "not heard" [dBm]; None: ``marks_of`` finds them.

    Raises:
        ValueError: There is no gateway, or a cell of a gateway is not a level.
    """
    reserved = {axes.x, axes.y, axes.z, *(table.column(name) for name in ignore)}
    free = [k for k in range(len(table.names)) if k not in reserved]
    # Codes of "not heard" are sought in columns that may be gateways.
    likely = [k for k in free if table.names[k] in placed or _is_weak(table, k)]
    marks = marks_of(table.numbers[:, likely]) if not_heard is None else marks_given(not_heard)
    gateways: list[int] = []
    silent: list[str] = []
    others: list[int] = []
    for k in free:
        numbers = table.numbers[:, k]
        levels = numbers[~(np.isnan(numbers) | np.isin(numbers, marks))]
        within = levels[(levels >= QUIETEST) & (levels <= LOUDEST)]
        is_gateway = table.names[k] in placed
        if k in likely and len(levels):
            is_gateway |= len(within) / len(levels) >= 0.5 and np.median(within) <= WEAK
        if not len(levels):
            silent.append(table.names[k])
        elif is_gateway:
            gateways.append(k)
        else:
            others.append(k)
    _refuse_lists(table, others)
    powers = [table.names[k] for k in others if _are_powers(table.numbers[:, k])]
    if not gateways and powers:
        raise ValueError(
            f"{table.file}: expected levels [dBm], got powers in W or mW in "
            f"{tables.shortened(powers)}\nwrite 10 log10(P / 1 mW)"
        )
    if not gateways:
        raise ValueError(
            f"{table.file}: expected columns of levels [dBm], a gateway each, got none in "
            f"{tables.quote(', '.join(table.names))}; write levels with their sign, or name "
            "gateways by data.gateways"
        )
    levels = table.numbers[:, gateways]
    is_level = (levels >= QUIETEST) & (levels <= LOUDEST)
    marked = and_list(marks) or "an empty cell"
    refuse_cells(
        table,
        gateways,
        ~(np.isnan(levels) | np.isin(levels, marks) | is_level),
        f"a level from {QUIETEST:g} to {LOUDEST:g} dBm ({marked} where nothing was heard)",
    )
    ignored = []
    for k in others:
        name = table.names[k]
        ignored.append(f"{name} (powers in W or mW?)" if name in powers else name)
    # A column without a name, such as of pandas's index, is not worth a remark.
    return Columns(gateways, marks, [*filter(None, silent)], [*filter(None, ignored)])


def _is_weak(table: tables.Table, column: int) -> bool:
    """True if half of a column's distinct numbers are low levels, and no coordinate by its name."""
    if plain_name(table.names[column])[0] in HEIGHTS.union(*PAIRS[0], *PAIRS[1], *PAIRS[2]):
        return False
    numbers = table.numbers[:, column]
    distinct = np.unique(numbers[np.isfinite(numbers)])
    weak = (distinct >= QUIETEST) & (distinct <= WEAK)
    return bool(weak.sum() >= max(1, len(distinct) / 2))


def _refuse_lists(table: tables.Table, columns: Sequence[int]) -> None:
    """Raises a ``ValueError`` if a cell of these columns holds several levels."""
    for k in columns:
        texts = np.flatnonzero(np.isinf(table.numbers[:, k]))  # rows whose cell is no number
        if not len(texts):
            continue
        row = int(texts[0])
        levels = tables.numbers_in(table.text(row, k))
        if levels and QUIETEST <= min(levels) <= max(levels) <= WEAK:
            got = f"{table.cell(row, k)}, or set data.ignore"
            table.refuse({row: got}, "one level [dBm] a cell")


def _are_powers(column: Float[ndarray, " n"]) -> bool:
    """True if numbers are positive, below 0.01, and spread over a factor of 3, as powers are."""
    numbers = column[np.isfinite(column) & (column != 0)]
    if len(numbers) < 3:
        return False
    low, high = numbers.min(), numbers.max()
    return bool(low > 0 and high < 1e-2 and high > 3 * low)
