"""Data frames of pandas, polars, pyarrow and others, and mappings of columns, as tables."""

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gaigs.io.tables import Table, quote, to_level


def is_frame(value: object) -> bool:
    """True for a mapping of columns, and for the frames and tables of data frame libraries."""
    if isinstance(value, Mapping):
        return True
    has_columns = hasattr(value, "columns") or hasattr(value, "column_names")
    if has_columns:
        return hasattr(value, "__getitem__")
    return _is_exchanged(value) and not hasattr(value, "__array__")  # no single column


def _is_exchanged(value: object) -> bool:
    """True for a frame with Arrow's stream or the data frame interchange protocol."""
    return hasattr(value, "__arrow_c_stream__") or hasattr(value, "__dataframe__")


def read_frame(frame: Any, name: str = "data frame") -> Table:
    """A data frame as a table; named levels of an index become columns.

    Args:
        name: Word for the frame in messages.

    Raises:
        ImportError: The frame's library needs pyarrow, which is not installed.
        ValueError: The frame has no rows, two columns of one name, or columns of different lengths.
    """
    names, columns = _read_columns(frame, name)
    for text in names:
        if names.count(text) > 1:
            count = names.count(text)
            raise ValueError(f"{name}: expected each column once, got {quote(text)} {count} times")
    lengths = {len(column) for column in columns}
    if len(lengths) != 1 or 0 in lengths:
        raise ValueError(f"{name}: expected rows and columns of one length, got {sorted(lengths)}")

    def text_of(row: int, column: int) -> str:
        return _text(columns[column][row])

    numbers = np.column_stack([_numbers(column) for column in columns])
    return Table(Path(name), names, numbers, text_of, unit="row", first=0)


def _read_columns(frame: Any, name: str) -> tuple[list[str], list[ndarray]]:
    """Names of a frame's columns, and the columns; an empty list if two have the same name."""
    if not isinstance(frame, Mapping) and not hasattr(frame, "column_names"):
        # In pandas a pivoted table has its places in the index, which becomes columns again.
        index = getattr(getattr(frame, "index", None), "names", [])
        levels = [level for level in index if level is not None and level not in frame.columns]
        frame = frame.reset_index(level=levels) if levels else frame
    keys = _keys(frame)
    # Columns that numpy cannot read go through pyarrow.
    if keys and not isinstance(frame, Mapping) and not hasattr(frame[keys[0]], "__array__"):
        keys = []
    # A frame that lists no columns may have some; an empty list has none to convert.
    is_empty = len(getattr(frame, "columns", "?")) == 0
    if not keys and _is_exchanged(frame) and not is_empty:
        frame = _by_pyarrow(frame)
        keys = _keys(frame)
    names = [str(key) for key in keys]
    if len({*names}) < len(names):
        return names, []
    columns = [np.asarray(frame[key]) for key in keys]
    for text, column in zip(names, columns, strict=True):
        if column.ndim != 1:
            raise ValueError(
                f"{name}: expected one value a row in column {quote(text)}, got {column.shape}"
            )
    return names, columns


def _keys(frame: Any) -> list:
    """Keys of a frame's columns, of any type; empty if the frame has no list of them."""
    if isinstance(frame, Mapping):
        return [*frame]
    if hasattr(frame, "column_names") and not callable(frame.column_names):
        return [*frame.column_names]
    return [*getattr(frame, "columns", [])]


def _by_pyarrow(frame: Any) -> Any:
    """A frame for which ``_is_exchanged`` is true, as a table of pyarrow."""
    try:
        import pyarrow
        from pyarrow import interchange
    except ImportError:
        raise ImportError(
            f"data frames of {type(frame).__module__} are read by pyarrow: pip install pyarrow"
        ) from None
    if hasattr(frame, "__arrow_c_stream__"):
        return pyarrow.table(frame)
    return interchange.from_dataframe(frame)


def _numbers(column: ndarray) -> Float[ndarray, " n"]:
    """Numbers of a column, NaN for a missing number and infinity for a text."""
    if column.dtype.kind in "iuf":
        numbers = column.astype(np.float64)
        numbers[numbers == -np.inf] = np.nan  # the level of no power
        return numbers
    if column.dtype.kind not in "OUT":
        return np.full(len(column), np.inf)  # dates, truth values and other kinds
    number = functools.cache(to_level)
    return np.array([number(_text(cell)) for cell in column], dtype=np.float64)


def _text(cell: object) -> str:
    """The text of a cell; empty if it is missing."""
    text = str(cell)
    return "" if text in ("None", "nan", "<NA>", "NaT") else text
