"""The table and the figure of how far two labels agree."""

import csv
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.markup import escape
from rich.table import Table

from gaigs.io.files import atomic_write, write_text
from gaigs.report.style import COLUMN, DPI, LINES, STYLE
from gaigs.report.table import markdown


class Cell(NamedTuple):
    """Pairs of labels that are alike far apart.

    Attributes:
        distance: Of their places, from and to below [m]; 0 and 0 for one and the same place.
        separation: In measurements, from and to.
        pairs: How many there are.
        compared: Of how many the labels were compared.
        quantiles: 10th percentile, median and 90th percentile of the score.
    """

    distance: tuple[float, float]
    separation: tuple[int, float]
    pairs: int
    compared: int
    quantiles: tuple[float, float, float]


def write(
    folder: Path,
    score: str,
    titles: Mapping[str, str],
    cells: Sequence[Cell],
    rows: Mapping[str, Mapping[str, float]],
    split: str,
    remarks: Sequence[str],
) -> Group:
    """Writes ``agreement.md``, ``agreement.csv`` and ``agreement.png``.

    Args:
        folder: Gets the files.
        score: What the agreement of two labels is called, with its unit.
        titles: Of the metrics, by name.
        cells: By rows.
        rows: Metrics on the split's test links, by what predicts them; may be empty.
        split: Its name.
        remarks: What else a reader has to know.

    Returns:
        The tables for a terminal.

    Raises:
        OSError: A file cannot be written.
    """
    distances = list(dict.fromkeys(cell.distance for cell in cells))
    columns = sorted({cell.separation for cell in cells})
    at = {(cell.distance, cell.separation): cell for cell in cells}
    digits = 2 if score.endswith("]") else 3
    interval = lambda cell: f"{cell.quantiles[0]:z.{digits}f} to {cell.quantiles[2]:z.{digits}f}"
    median = lambda cell: f"{cell.quantiles[1]:z.{digits}f}"
    filled = lambda tell: [["" if (c := at.get((d, s))) is None else tell(c) for s in columns] for d in distances]

    about = f"Median {score} of two labels, 10th to 90th percentile, and number of pairs"
    heads = ["distance [m]", *map(_apart, columns)]
    inline = filled(lambda cell: f"{median(cell)} ({interval(cell)}), {cell.pairs:,}")
    parts = [f"{about}, by the distance of their places and by how many measurements apart they are:"]
    parts.append(markdown([heads, *([_distance(d), *line] for d, line in zip(distances, inline, strict=True))]))
    scored = [[name, *(_number(row[key], title) for key, title in titles.items())] for name, row in rows.items()]
    if rows:
        parts += [f"What that lets expect on split {split}:", markdown([["predicted by", *titles.values()], *scored])]
    compared = [cell.compared for cell in cells if cell.compared < cell.pairs]
    drawn = [f"of a cell with more, {max(compared):,} random pairs are compared"] if compared else []
    remarks = [*remarks, *drawn]
    parts = [part.rstrip("\n") for part in parts]
    parts.append("\n".join(f"- {remark}" for remark in remarks))
    write_text(folder / "agreement.md", "\n\n".join(parts) + "\n")
    _write_csv(folder / "agreement.csv", cells)
    with atomic_write(folder / "agreement.png") as part:
        figure(score, cells).savefig(part, dpi=DPI)

    table = Table(title=escape(about), title_justify="left", box=SIMPLE_HEAD, leading=1)
    for head in heads:
        table.add_column(escape(head), justify="right")
    stacked = filled(lambda cell: f"{median(cell)}\n{interval(cell).replace(' to ', '..')}\n{cell.pairs:,}")
    for distance, line in zip(distances, stacked, strict=True):
        table.add_row(_distance(distance), *line)
    shown = [table]
    if rows:
        second = Table(title=escape(f"What that lets expect on split {split}"), title_justify="left", box=SIMPLE_HEAD)
        second.add_column("predicted by", no_wrap=True)
        for title in titles.values():
            second.add_column(escape(title.replace(" ", "\n")), justify="right")
        for line in scored:
            second.add_row(*map(escape, line))
        shown.append(second)
    return Group(*shown, *map(escape, remarks))


def figure(score: str, cells: Sequence[Cell]):
    """Median and 10th to 90th percentile against distance, one line for each separation.

    Args:
        score: What the agreement of two labels is called, with its unit.
        cells: By rows.
    """
    from matplotlib import rc_context  # slow to import
    from matplotlib.figure import Figure

    distances = list(dict.fromkeys(cell.distance for cell in cells))
    columns = sorted({cell.separation for cell in cells})
    with rc_context(STYLE):
        figure = Figure(figsize=(COLUMN, 2.9), layout="constrained")
        ax = figure.subplots()
        for number, column in enumerate(columns):
            mine = [cell for cell in cells if cell.separation == column]
            shift = 0.14 * (number - (len(columns) - 1) / 2)
            x = [distances.index(cell.distance) + shift for cell in mine]
            low, middle, high = zip(*(cell.quantiles for cell in mine), strict=True)
            errors = (
                [m - a for m, a in zip(middle, low, strict=True)],
                [b - m for m, b in zip(middle, high, strict=True)],
            )
            (colour, dash), marker = LINES[number % len(LINES)], "os^Dv"[number % 5]
            look = {"color": colour, "linestyle": dash, "marker": marker, "markersize": 3.5, "elinewidth": 0.6}
            ax.errorbar(x, middle, errors, label=_apart(column), **look)
        ax.set(xlabel="distance of the places [m]", ylabel=f"{score} of two labels")
        ax.set_xticks(range(len(distances)), [_distance(distance) for distance in distances], rotation=40, ha="right")
        ax.grid(axis="y")
        figure.legend(loc="outside upper center", ncols=2, title="measurements apart")
    return figure


def _write_csv(path: Path, cells: Sequence[Cell]) -> None:
    """A line for each cell; what has no end is left out."""
    names = "distance_from_m", "distance_below_m", "separation_from", "separation_to", "pairs", "compared"
    with atomic_write(path) as part, open(part, "w", newline="", encoding="utf-8") as file:
        lines = csv.writer(file)
        lines.writerow((*names, "p10", "median", "p90"))
        for cell in cells:
            bounds = ("" if math.isinf(value) else value for value in (*cell.distance, *cell.separation))
            lines.writerow((*bounds, cell.pairs, cell.compared, *(f"{value:.6g}" for value in cell.quantiles)))


def _number(value: float, title: str) -> str:
    """A metric as text: hundredths of what has a unit, else thousandths."""
    return f"{value:z.{2 if title.endswith(']') else 3}f}"


def _distance(bounds: tuple[float, float]) -> str:
    """A row's head."""
    low, high = bounds
    if not high:
        return "same place"
    return f"under {high:g}" if not low else f"{low:g} to {high:g}"


def _apart(bounds: tuple[int, float]) -> str:
    """A column's head."""
    low, high = bounds
    if math.isinf(high):
        return f"over {low - 1:,}" if low else "any"
    return f"{low:,} to {high:,}" if low else f"within {high:,}"
