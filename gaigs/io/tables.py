"""Text files of data sets: what is wrong is collected with its file, line and value, and listed by one error."""

import csv
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from gaigs.geometry import FAR, WITHIN

SHOWN = 10
"""Defects that an error lists one by one."""

LONGEST = 400
"""Characters of a defect that an error shows."""

BESIDE_QUOTE = re.compile(r"(?<=\")[ \t]+(?=,|$)")
"""Blanks behind a quoted cell."""

NUMBER = re.compile(r"[+-]?(\d+(\.\d*)?|\.\d+)(e[+-]?\d+)?", re.ASCII | re.IGNORECASE)
"""A number as it is written: ``float`` takes 1_0, the digits of other scripts and infinities too."""


def find_folder(root: str | Path) -> Path:
    """The folder of a data set.

    Raises:
        FileNotFoundError: There is none.
    """
    root = Path(os.path.expanduser(root))
    if not os.path.isdir(root):  # Path.is_dir raises where a name is too long or a folder is closed
        raise FileNotFoundError(f"{root} must be the folder of a data set, and is none; set the data's root")
    return root


def find_file(file: str | Path, content: str) -> Path:
    """The file of a data set that is one file.

    Raises:
        FileNotFoundError: There is none.
    """
    file = Path(os.path.expanduser(file))
    if not os.path.isfile(file):
        raise FileNotFoundError(f"{file} must be {content}, and is no file; set the data's file")
    return file


def has_file(file: Path) -> bool:
    """Whether a folder has an optional file. One that cannot be read, as a link to nothing, is there too."""
    return os.path.lexists(file)


def refuse(place: Path, defects: Sequence[str]) -> None:
    """Raises a ``ValueError`` that lists the defects, if there are any."""
    if defects:
        shown = [defect if len(defect) <= LONGEST else f"{defect[:LONGEST]} ..." for defect in defects[:SHOWN]]
        shown = ["".join(c if c.isprintable() else ascii(c)[1:-1] for c in defect) for defect in shown]
        more = [f"... and {len(defects) - SHOWN} more"] if len(defects) > SHOWN else []
        count = "1 defect" if len(defects) == 1 else f"{len(defects)} defects"
        raise ValueError("\n  ".join([f"{place} has {count}:", *shown, *more]))


def read_lines(file: Path, expected: str, defects: list[str]) -> list[str]:
    """Lines of a text file without the blank ones at its end."""
    text, reason = "", None
    if not has_file(file):
        reason = "missing"
    elif not os.path.isfile(file):  # a pipe would be waited for
        reason = "no file, but a folder, a device or a link to nothing"
    else:
        try:
            text = file.read_text(encoding="utf-8-sig")
        except (OSError, UnicodeDecodeError) as error:
            reason = f"unreadable ({error})"
    if reason:
        defects.append(f"{file.name}: {reason}; expected {expected}")
        return []
    lines = text.rstrip().splitlines()
    if not lines:
        defects.append(f"{file.name}: empty; expected {expected}")
    return lines


def read_points(file: Path, names: Sequence[str], expected: str, defects: list[str]) -> list[list[float]]:
    """Coordinates, one point a line; a first line of their names may head them."""
    lines = read_lines(file, expected, defects)
    header = bool(lines) and [cell.lower() for cell in to_cells(lines[0])] == [*names]
    if header and len(lines) == 1:
        defects.append(f"{file.name}: no positions below the header")
    points = []
    for number, line in [*enumerate(lines, 1)][header:]:
        place = f"{file.name}, line {number}"
        cells = to_columns(place, line, names, defects)
        points.append(to_coordinates(place, names, cells, defects) if cells else [])
    return points


def to_cells(line: str) -> list[str]:
    """Cells of a line with commas, without the blanks around them."""
    try:
        # Only blanks may stand beside quotes: what else does, csv would join to what they hold.
        (cells,) = csv.reader([BESIDE_QUOTE.sub("", line)], skipinitialspace=True, strict=True)
    except csv.Error:  # a quote inside a cell or without its end, or a cell of 100,000 characters: no table of ours
        cells = []
    return [cell.strip() for cell in cells] or [line]


def to_columns(place: str, line: str, names: Sequence[str], defects: list[str]) -> list[str]:
    """Cells of a line, one for each name; none, and a defect, where their number is another."""
    cells = to_cells(line)
    if len(cells) == len(names):
        return cells
    defects.append(f"{place}: expected {len(names)} columns {','.join(names)}, got {len(cells)}: {line!r}")
    return []


def to_numbers(
    place: str,
    names: Sequence[str],
    cells: Sequence[str],
    holds: Callable[[float], bool],
    expected: str,
    defects: list[str],
) -> list[float]:
    """Cells of a line as numbers, each of which must hold; all that do not are one defect."""
    values = [to_number(cell) for cell in cells]
    wrong = [k for k, value in enumerate(values) if not holds(value)]
    if wrong:
        columns = f"column{'s' if len(wrong) > 1 else ''} {', '.join(names[k] for k in wrong)}"
        defects.append(f"{place}, {columns}: expected {expected}, got {', '.join(repr(cells[k]) for k in wrong)}")
    return values


def to_coordinates(place: str, names: Sequence[str], cells: Sequence[str], defects: list[str]) -> list[float]:
    """Cells of a line as coordinates [m], finite and near enough for float32."""
    if all(math.isfinite(to_number(cell)) for cell in cells):
        return to_numbers(place, names, cells, lambda value: abs(value) < FAR, WITHIN, defects)
    return to_numbers(place, names, cells, math.isfinite, "a finite number", defects)


def to_number(cell: str) -> float:
    """What a cell says, not a number where it says none."""
    return float(cell) if NUMBER.fullmatch(cell.strip()) else math.nan


def to_index(text: str) -> int | None:
    """A whole number from 0 in decimal digits; None where there is none."""
    if not (text.isascii() and text.isdecimal()):
        return None
    digits = text.lstrip("0")
    return int(digits or "0") if len(digits) < 19 else sys.maxsize  # Python takes no thousands of digits


def number_places(points: Sequence[Sequence[float]]) -> tuple[list[tuple], Tensor]:
    """The distinct points in the order in which they appear, and which of them each one is."""
    numbers: dict[tuple, int] = {}
    index = [numbers.setdefault(tuple(point), len(numbers)) for point in points]
    return [*numbers], torch.tensor(index)
