"""Text files of data sets: lines, tables of numbers, points and index files.

Errors state file, line and content.
"""

import codecs
import csv
import difflib
import functools
import math
import os
import re
import reprlib
import sys
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from gaigs.io import FAR, WITHIN
from gaigs.io.files import LOCK, atomic_write

Rows = Mapping[int, Sequence[str]]
"""Cells of each line of a table, by the line's number from 1."""

NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
"""A decimal number; ``float`` also accepts 1_0, digits of other scripts and infinities."""


def quote(value: object) -> str:
    """A value for errors: printable and short."""
    # Few entries of a list are shown: aliases of YAML multiply.
    text = repr(value) if isinstance(value, str) else reprlib.repr(value)
    return text if len(text) <= 100 else f"{text[:100]} ..."


def shortened(names: Sequence[str], most: int = 10) -> str:
    """Names joined by commas: the first ``most`` of them, then the number of the others."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def find_folder(root: str | Path) -> Path:
    """The folder of a data set; a ``FileNotFoundError`` if it does not exist."""
    root = Path(os.path.expanduser(root))
    # Path.is_dir raises where a name is too long or a folder is closed.
    if not os.path.isdir(root):
        raise FileNotFoundError(
            f"{root} must be the folder of a data set, and is no folder; set the data's root"
        )
    return root


def find_file(file: str | Path, content: str, option: str = "the data's file") -> Path:
    """The file of an option; a ``FileNotFoundError`` if it does not exist."""
    file = Path(os.path.expanduser(file))
    if not os.path.isfile(file):
        raise FileNotFoundError(f"{file} must be {content}, and is no file; set {option}")
    return file


def has_file(file: Path) -> bool:
    """True if a folder has an optional file; a broken link counts, and fails on reading."""
    return os.path.lexists(file)


def check_empty(folder: Path) -> None:
    """Raises a ``FileExistsError`` unless a folder is missing, or empty but for a lock."""
    if folder.exists() and (not folder.is_dir() or {*os.listdir(folder)} - {LOCK}):
        raise FileExistsError(f"{folder} must be an empty folder or missing; choose another name")


def read_lines(file: Path, content: str) -> list[str]:
    """Lines of a text file without blank lines at its end; a ``ValueError`` for an empty file.

    The encoding is UTF-8, UTF-16 with a byte order mark, or otherwise Windows-1252, which has the
    letters of Latin-1.
    """
    if not os.path.isfile(file):  # reading a pipe would block
        state = "no file, but a folder, a device or a broken link" if has_file(file) else "missing"
        raise ValueError(f"{file}: {state}; expected {content}")
    stored = file.read_bytes()
    try:
        text = stored.decode("utf-8-sig")
    except UnicodeDecodeError:
        is_wide = stored.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        text = stored.decode("utf-16" if is_wide else "cp1252", errors="replace")
    lines = text.rstrip().splitlines()
    if not lines:
        raise ValueError(f"{file}: empty; expected {content}")
    return lines


def refuse(file: Path, wrong: Mapping[int, str], expected: str, unit: str = "line") -> None:
    """Raises a ``ValueError`` that names the first wrong line and counts the others.

    Args:
        wrong: Contents of the wrong lines by number; if empty, nothing is raised.
        unit: Word for a line, ``row`` in a data frame.
    """
    if not wrong:
        return
    number, got = next(iter(wrong.items()))
    count = len(wrong) - 1
    others = {0: "", 1: f" and 1 other {unit}"}.get(count, f" and {count} other {unit}s")
    raise ValueError(f"{file}, {unit} {number}{others}: expected {expected}, got {got}")


def read_points(file: Path, names: Sequence[str], content: str) -> list[list[float]]:
    """Coordinates [m], one point in each line; the first line may name the columns."""
    lines = read_lines(file, content)
    delimiter = find_delimiter(lines)
    header = [cell.lower() for cell in split_cells(lines[0], delimiter)]
    if not {*names} <= {*header}:
        return to_coordinates(file, split_rows(file, lines, names, 0, delimiter), names)
    if len(lines) == 1:
        raise ValueError(f"{file}: no positions below the header")
    columns = [header.index(name) for name in names]
    points = {}
    for line, cells in split_rows(file, lines, header, 1, delimiter).items():
        points[line] = [cells[column] for column in columns]
    return to_coordinates(file, points, names)


def read_walls(file: Path) -> Float[Tensor, "k 2 3"]:
    """Walls of a floor plan, at z = 0 [m]: segments between consecutive vertices x,y of a file."""
    vertices = read_points(file, "xy", "consecutive wall vertices x,y [m], one a line")
    if len(vertices) == 1:
        raise ValueError(f"{file}: expected two wall vertices or more, got 1")
    corners = torch.nn.functional.pad(torch.tensor(vertices), (0, 1))
    return torch.stack((corners[:-1], corners[1:]), 1)


SEPARATORS = {"\t": "tabs", ";": "semicolons", "|": "bars", ",": "commas", " ": "blanks"}
"""Marks between the cells of a line, the most certain ones first."""


def find_delimiter(lines: Sequence[str]) -> str:
    """The character that cuts the first three lines into equally many cells, or else a comma."""
    for mark in SEPARATORS:
        counts = {len(split_cells(line, mark)) for line in lines[:3]}
        if len(counts) == 1 and counts != {1}:
            return mark
    return ","


def split_cells(line: str, delimiter: str = ",") -> list[str]:
    """Cells of a line, without the blanks around them."""
    if delimiter == " ":
        return line.split()
    try:
        if '"' in line:  # csv appends blanks behind a quoted cell to it
            line = re.sub(rf"(?<=\")[ \t]+(?={re.escape(delimiter)}|$)", "", line)
        (cells,) = csv.reader(
            [line], delimiter=delimiter, skipinitialspace=delimiter != "\t", strict=True
        )
    except csv.Error:  # a quote inside a cell or without its end, or a cell of 100,000 characters
        cells = []
    return [cell.strip() for cell in cells] or [line]


def split_rows(
    file: Path, lines: Sequence[str], names: Sequence[str], skip: int, delimiter: str
) -> dict[int, list[str]]:
    """Cells of each line after the first ``skip``, one for each of ``names``.

    Raises a ``ValueError`` for a line with another number of cells. Unless the delimiter is a
    comma, commas are decimal points.
    """
    rows: dict[int, list[str]] = {}
    wrong: dict[int, str] = {}
    for number, line in enumerate(lines[skip:], skip + 1):
        cells = split_cells(line, delimiter)
        rows[number] = cells if delimiter == "," else [cell.replace(",", ".") for cell in cells]
        if len(cells) != len(names):
            wrong[number] = miscounted(line, cells, len(names))
    refuse(file, wrong, f"{len(names)} columns {quote(delimiter.join(names))}")
    return rows


def miscounted(line: str, cells: Sequence[str], count: int) -> str:
    """End of a message for a line without ``count`` cells: their number, the line, the reason."""
    # Separators that would give the right number of cells.
    fitting = [word for mark, word in SEPARATORS.items() if len(split_cells(line, mark)) == count]
    reason = f"; columns separated by {fitting[0]}?" if fitting else ""
    if len(cells) > count and all(re.fullmatch(r"[+-]?\d+", cell) for cell in cells):
        reason = "; decimal commas? write points, or semicolons between columns"
    return f"{len(cells)}: {quote(line)}{reason}"


def numbers_in(cell: str) -> list[float]:
    """The numbers of a cell such as ``[-60; -61]``; empty unless it has two or more of them."""
    numbers = [to_number(part) for part in re.split(r"[;|/\s]+", cell.strip("[]() "))]
    return numbers if len(numbers) > 1 and not any(map(math.isnan, numbers)) else []


def described(cell: str) -> str:
    """A wrong cell in quotes for errors, with the reason if it is obvious."""
    if numbers_in(cell):
        return f"{quote(cell)}, several numbers,"
    if re.fullmatch(r"[+-]?\d+,\d+", cell):
        return f"{quote(cell)}, with a decimal comma,"
    return quote(cell)


class Table(NamedTuple):
    """A table of numbers with named columns."""

    file: Path  # file, or a word for a table in memory
    names: list[str]  # names of the columns
    # Numbers, NaN for an empty cell and infinity for another text.
    numbers: Float[ndarray, "rows columns"]
    text: Callable[[int, int], str]  # text of a cell by its row and column
    unit: str = "line"  # word for a row in messages
    first: int = 2  # number of the first row in messages

    @property
    def heading(self) -> str:
        """The location of the column names, for messages."""
        return f"{self.file}, line 1" if self.unit == "line" else str(self.file)

    def refuse(self, wrong: Mapping[int, str], expected: str) -> None:
        """Raises the ``ValueError`` of ``refuse`` for wrong cells by row number."""
        numbered = {self.first + row: cell for row, cell in wrong.items()}
        refuse(self.file, numbered, expected, self.unit)

    def cell(self, row: int, column: int) -> str:
        """The text of a cell with its column, for messages."""
        return f"{described(self.text(row, column))} in column {self.names[column]}"

    def column(self, name: str) -> int:
        """The number of a column; a ``ValueError`` for an unknown name."""
        if name not in self.names:
            near = difflib.get_close_matches(name, self.names, n=1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            got = f"{shortened(self.names)}{hint}"
            raise ValueError(f"{self.heading}: expected a column {quote(name)}, got {got}")
        return self.names.index(name)


def write_table(file: Path, rows: Iterable[Sequence]) -> None:
    """Writes rows as a CSV table, the heading first; ``inert`` changes texts for spreadsheets."""
    with atomic_write(file) as part, part.open("w", encoding="utf-8", newline="") as opened:
        writer = csv.writer(opened, lineterminator="\n")
        for row in rows:
            writer.writerow([inert(cell) if isinstance(cell, str) else cell for cell in row])


def inert(text: str) -> str:
    """A text that no spreadsheet reads as a formula.

    A text that starts with =, +, -, @, a tab or a return gets an apostrophe in front. Apostrophes
    that it already has are skipped in this test, so ``original`` is unique. Numbers are unchanged.
    """
    starts = text.lstrip("'").startswith(("=", "+", "-", "@", "\t", "\r"))
    return f"'{text}" if starts and text != "-inf" and math.isnan(to_number(text)) else text


def original(text: str) -> str:
    """The text to which ``inert`` added an apostrophe; other texts are unchanged."""
    return text[1:] if text.startswith("'") and inert(text[1:]) == text else text


def read_table(file: Path, content: str) -> Table:
    """A table with a heading, its cells separated by tabs, semicolons, bars, commas or blanks."""
    lines = read_lines(file, content)
    delimiter = find_delimiter(lines)
    names = split_cells(lines[0], delimiter)
    for name in names:
        if not name.isprintable():
            raise ValueError(f"{file}, line 1: expected names of columns, got {quote(name)}")
        count = names.count(name)
        if name and count > 1:
            got = f"{quote(name)} {count} times"
            raise ValueError(f"{file}, line 1: expected each column once, got {got}")
    number = functools.cache(functools.partial(to_level, has_commas=delimiter != ","))
    rows: list[ndarray] = []
    wrong: dict[int, str] = {}
    for line, text in enumerate(lines[1:], 2):
        cells = split_cells(text, delimiter)
        rows.append(np.array([number(cell) for cell in cells]))
        if len(cells) != len(names):
            wrong[line] = miscounted(text, cells, len(names))
    refuse(file, wrong, f"{len(names)} columns {quote(delimiter.join(names))}")
    if not rows:
        raise ValueError(f"{file}: no rows below the heading")

    def text_of(row: int, column: int) -> str:
        return split_cells(lines[row + 1], delimiter)[column]

    return Table(file, names, np.stack(rows), text_of)


def to_level(cell: str, has_commas: bool = False) -> float:
    """The number in a cell, NaN for an empty cell, infinity for another text.

    Args:
        has_commas: True if commas are decimal points.
    """
    text = re.sub(r"(?i)\s*dbm$", "", cell)
    value = to_number(text.replace(",", ".") if has_commas else text)
    empty = ("", "nan", "na", "n/a", "null", "none", "-inf", "-")
    is_text = math.isnan(value) and text.strip().lower() not in empty
    return math.inf if is_text else value


def to_numbers(
    file: Path, rows: Rows, names: Sequence[str], holds: Callable[[float], bool], expected: str
) -> list[list[float]]:
    """Cells of a table as numbers, NaN for other texts.

    Raises a ``ValueError`` with the first invalid cell of each wrong line; ``holds`` is true for a
    valid number.
    """
    numbers: list[list[float]] = []
    wrong: dict[int, str] = {}
    for line, cells in rows.items():
        values = [to_number(cell) for cell in cells]
        numbers.append(values)
        bad = next((k for k, value in enumerate(values) if not holds(value)), None)
        if bad is not None:
            wrong[line] = f"{described(cells[bad])} in column {names[bad]}"
    refuse(file, wrong, expected)
    return numbers


def to_coordinates(file: Path, rows: Rows, names: Sequence[str]) -> list[list[float]]:
    """Cells of a table as coordinates [m]; a ``ValueError`` for infinite or too large ones."""
    to_numbers(file, rows, names, math.isfinite, "a finite number")
    return to_numbers(file, rows, names, lambda value: abs(value) < FAR, WITHIN)


def to_number(cell: str) -> float:
    """The number in a cell; NaN for any other text."""
    plain = cell.strip().replace("−", "-")
    return float(plain) if NUMBER.fullmatch(plain) else math.nan


def to_index(text: str) -> int | None:
    """A whole number from 0 in decimal digits; None for any other text.

    A number of 19 digits or more becomes the largest index, which no list has.
    """
    if not (text.isascii() and text.isdecimal()):
        return None
    digits = text.lstrip("0")
    # Python converts at most 4300 digits.
    return int(digits or "0") if len(digits) < 19 else sys.maxsize


def read_parts(
    root: Path, parse: Callable[[str], Hashable | None], expected: str
) -> tuple[list, list]:
    """Distinct entries of ``train_index.txt`` and ``test_index.txt``, one in each line.

    Args:
        parse: Function from a line to its entry; None for an invalid line.
        expected: Expected content of a line, for errors.
    """
    places: dict[Hashable, str] = {}
    parts = []
    for file in (root / "train_index.txt", root / "test_index.txt"):
        lines = dict(enumerate(read_lines(file, expected), 1))
        entries = {number: parse(line.strip()) for number, line in lines.items()}
        wrong = [number for number, entry in entries.items() if entry is None]
        refuse(file, {number: quote(lines[number]) for number in wrong}, expected)
        repeated = {}
        for number, entry in entries.items():
            place = f"{file.name}, line {number}"
            if places.setdefault(entry, place) != place:
                repeated[number] = f"{quote(lines[number])}, which is in {places[entry]} already"
        refuse(file, repeated, "each entry once")
        parts.append([*entries.values()])
    return parts[0], parts[1]


def number_places(points: Sequence[Sequence[float]]) -> tuple[list[tuple], Tensor]:
    """Distinct points, in the order of their first appearance, and the number of each point."""
    numbers: dict[tuple, int] = {}
    index = [numbers.setdefault(tuple(point), len(numbers)) for point in points]
    return [*numbers], torch.tensor(index)
