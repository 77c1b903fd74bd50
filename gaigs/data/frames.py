"""Links of a data frame of levels, by the reader of wide tables."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from gaigs.data import Links, divide
from gaigs.data.arrays import from_arrays, split_configuration
from gaigs.data.rssi_csv import COLUMNS
from gaigs.data.rssi_wide import from_table
from gaigs.data.rssi_wide.columns import FLOORS, HEIGHTS, plain_name
from gaigs.io.frames import is_frame, read_frame
from gaigs.io.tables import Table


def from_frame(
    frame: Any,
    x: str | int | None = None,
    y: str | int | None = None,
    z: str | int | None = None,
    receivers: Any = None,
    receiver: str | int | Sequence[str | int] | None = None,
    level: str | int | None = None,
    ignore: str | Sequence[str] = (),
    not_heard: float | Sequence[float] | None = None,
    height: float = 1.0,
    storey: float = 3.0,
    epsg: int | None = None,
    frequency: float | None = None,
    split: str | Mapping | None = None,
    **options: Any,
) -> Links:
    """Links of a data frame of levels [dBm], with their split.

    The frame is from pandas, polars, pyarrow, or another library with the PyCapsule or the
    interchange protocol; or it is a mapping of columns. A wide frame has a row for each place and a
    column for each receiver. A long frame has a row for each reading, and needs ``receiver`` and
    ``level``. If both ends move, each row also has the receiver's place: in the columns of
    ``receiver``, or in columns named as in ``rssi_csv``. Other columns and cells are read as by
    ``gaigs.data.rssi_wide.read``. NaN and None were not received.

    Args:
        frame: The data frame.
        x, y: Columns of the coordinates, or of longitude and latitude. The unit is the metre unless
            their names state another. None: columns with usual names.
        z: Column of the height, or of the floor if it is named so. None: the column with a usual
            name; without one, heights are ``height``.
        receivers: Positions by name, as a mapping to [x, y, z] or [x, y], or a data frame with
            columns ``name``, ``x``, ``y`` and optionally ``z``; missing positions are estimated
            from the training links. Or a list of the columns that are receivers. None: all columns
            that mostly hold low levels.
        receiver: Column of the receivers' names in a long frame; or the two or three columns of the
            receiver's place [m].
        level: Column of the readings in a long frame [dBm].
        ignore, not_heard, height, storey, epsg, frequency: As for ``gaigs.data.rssi_wide.read``.
        split: Name of a registered split, whose options are in ``options``; None: ``random``.

    Raises:
        ImportError: A package that the frame or its coordinates need is not installed.
        ValueError: A column is missing, or a cell is wrong; the message names row, column and
            value.

    Example:
        >>> survey = {"x": [1, 2, 1, 2], "y": [1, 1, 2, 2]}  # or a DataFrame
        >>> survey |= {"door": [-40, -45, -50, -55], "hall": [-52, None, -41, -44]}  # [dBm]
        >>> links = gaigs.links(survey, receivers={"door": [0, 0, 2], "hall": [3, 3, 2]})
        >>> len(links), [receiver.name for receiver in links.receivers]
        (7, ['door', 'hall'])
    """
    config = split_configuration("data frames", from_frame, split, options)
    table = read_frame(frame)
    # A frame with the columns of ``rssi_csv`` has both ends of each link.
    if {*COLUMNS} <= {*table.names} and receiver is level is x is None:
        x, y, z, *receiver, level = COLUMNS
    # Several columns hold the receiver's place: both ends move.
    if isinstance(receiver, Sequence) and not isinstance(receiver, str):
        place = [x or "x", y or "y", z]
        moving = _places_of(table, [name for name in place if name is not None])
        levels = table.numbers[:, table.column(str(level))]
        marks = np.ravel([] if not_heard is None else not_heard)
        return from_arrays(
            "rssi",
            moving,
            np.where(np.isin(levels, marks), np.nan, levels),
            _places_of(table, receiver),
            frequency=frequency,
            split=config,
            height=height,
        )
    try:
        links = from_table(
            table,
            coordinates=_coordinates(table, x, y, z),
            not_heard=not_heard if not_heard is None else np.ravel(not_heard).tolist(),
            height=height,
            storey=storey,
            epsg=epsg,
            frequency=frequency,
            receiver=None if receiver is None else str(receiver),
            level=None if level is None else str(level),
            **_columns(table, receivers, _listed(ignore), receiver is not None),
        )
        links = divide(links, config)
    except ValueError as error:
        raise ValueError(_in_python(str(error))) from None
    return replace(links, remarks=_in_python(links.remarks))


def _places_of(table: Table, names: Sequence) -> Float[np.ndarray, "n d"]:
    """Positions of one end of the links [m], from the named column of each coordinate."""
    columns = [table.column(str(name)) for name in names]
    return table.numbers[:, columns]


def _columns(table: Table, receivers: Any, ignore: list[str], is_long: bool) -> dict[str, Any]:
    """Options of ``from_table`` for receivers by a mapping, a data frame or a list of columns.

    Args:
        ignore: Columns that the user excludes.
        is_long: True for a frame with a row for each reading.

    Raises:
        ValueError: A listed name is no column.
    """
    if isinstance(receivers, Mapping) and not {"name", "x", "y"} <= {*receivers}:
        placed = {}  # positions as texts, as a file of gateways has them
        for name, position in receivers.items():
            if position is not None:
                placed[str(name)] = [*map(str, np.ravel(position).tolist())]
        levels = [] if is_long else [str(name) for name in receivers if str(name) in table.names]
        return {"gateways": placed or None, "levels": levels, "ignore": ignore}
    if is_frame(receivers):
        return {"gateways": read_frame(receivers, "receivers"), "ignore": ignore}
    names = [] if receivers is None else _listed(receivers)
    if names and is_long:
        raise ValueError(
            f"{table.heading}: receivers must be positions by name where column receiver names "
            f"them, got {receivers!r}; choose rows in the frame"
        )
    for name in names:
        table.column(name)
    others = [name for name in table.names if names and name not in names]
    return {"levels": names, "ignore": ignore + others}


def _listed(names: str | Sequence) -> list[str]:
    """One name or several as a list of texts."""
    return [names] if isinstance(names, str) else [str(name) for name in names]


def _coordinates(table: Table, x: Any, y: Any, z: Any) -> list[str] | None:
    """Names of the columns of x, y and, if there is one, of the height or floor.

    None if no column is given, so that ``from_table`` finds all of them by usual names.
    """
    if x is y is z is None:
        return None
    heights = [] if z is None else [str(z)]
    # A height comes before a floor.
    for kinds in (HEIGHTS, FLOORS):
        if not heights:
            heights = [name for name in table.names if plain_name(name)[0] in kinds][:1]
    return ["x" if x is None else str(x), "y" if y is None else str(y), *heights]


def _in_python(text: str) -> str:
    """A message with Python's keywords in place of command-line options ``data.key=value``."""
    text = re.sub(r"data\.coordinates(=\[x,y\])?", "x=, y= and z=", text)
    text = text.replace("data.gateways", "receivers")
    return re.sub(r"data\.(\w+)=\[?(\w+)\]?", r"\1='\2'", text).replace("data.", "")
