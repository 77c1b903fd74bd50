"""Text files of data sets: what is wrong is collected with its file, line and value, and listed by one error."""

import csv
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

SHOWN = 10
"""Defects that an error lists one by one."""

FAR = 1e5
"""No coordinate reaches it [m]: float32 tells places apart by 8 mm there, and by half a metre at UTM's northings."""

NEAR = "positions within 1e5 m of the origin on each axis (subtract a common origin from all)"


def find_folder(root: str | Path) -> Path:
    """The folder of a data set.

    Raises:
        FileNotFoundError: There is none.
    """
    root = Path(root).expanduser()
    if not root.is_dir():
        raise FileNotFoundError(f"{root} must be the folder of a data set, and is none; set the data's root")
    return root


def refuse(place: Path, defects: Sequence[str]) -> None:
    """Raises a ``ValueError`` that lists the defects, if there are any."""
    if defects:
        more = [f"... and {len(defects) - SHOWN} more"] if len(defects) > SHOWN else []
        count = "1 defect" if len(defects) == 1 else f"{len(defects)} defects"
        raise ValueError("\n  ".join([f"{place} has {count}:", *defects[:SHOWN], *more]))


def read_lines(file: Path, expected: str, defects: list[str]) -> list[str]:
    """Lines of a text file without the blank ones at its end."""
    try:
        text = file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = "missing" if isinstance(error, FileNotFoundError) else f"unreadable ({error})"
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
        (cells,) = csv.reader([line], skipinitialspace=True)
    except csv.Error:  # a cell of 100,000 characters: no table of ours
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
        return to_numbers(place, names, cells, lambda value: abs(value) < FAR, NEAR, defects)
    return to_numbers(place, names, cells, math.isfinite, "a finite number", defects)


def to_number(cell: str) -> float:
    """What a cell says, not a number where it says none."""
    try:
        return float(cell)
    except ValueError:
        return math.nan


def number_places(points: Sequence[Sequence[float]]) -> tuple[list[tuple], Tensor]:
    """The distinct points in the order in which they appear, and which of them each one is."""
    numbers: dict[tuple, int] = {}
    index = [numbers.setdefault(tuple(point), len(numbers)) for point in points]
    return [*numbers], torch.tensor(index)
