"""The page and the figure of the agreement between labels."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure

from gaigs.core.task import Task
from gaigs.io.files import write_text
from gaigs.report.style import COLUMN, LINES, STYLE, save
from gaigs.report.table import markdown


class Cell(NamedTuple):
    """Pairs of labels of similar distance and separation.

    Attributes:
        distance: Distance of their places, from and to below [m]; 0 and 0 for one place.
        separation: Measurements between them, from and to.
        pairs: Number of pairs.
        compared: Number of pairs whose labels were compared.
        quantiles: 10th percentile, median and 90th percentile of the score.
    """

    distance: tuple[float, float]
    separation: tuple[int, float]
    pairs: int
    compared: int
    quantiles: tuple[float, float, float]


def write(
    folder: Path,
    task: Task,
    cells: Sequence[Cell],
    rows: Mapping[str, Mapping],
    split: str,
    remarks: Sequence[str],
) -> str:
    """Writes ``agreement.md`` and ``agreement.png``, and returns the page; ``rows`` are metrics by
    predictor.
    """
    score, titles = task.pair_score, {name: metric.title for name, metric in task.metrics().items()}
    at = {(cell.distance, cell.separation): cell for cell in cells}
    distances, columns = (
        dict.fromkeys(cell.distance for cell in cells),
        sorted({cell.separation for cell in cells}),
    )

    def text(cell: Cell | None) -> str:
        if cell is None:
            return ""
        low, median, high = (_number(value, score) for value in cell.quantiles)
        return f"{median} ({low} to {high}), {cell.pairs:,}"

    lines = [["distance [m]", *map(_separation, columns)]]
    lines += [
        [_distance(row), *(text(at.get((row, column))) for column in columns)] for row in distances
    ]
    about = f"Median {score} of two labels, 10th to 90th percentile, and number of pairs"
    by = "by the distance of their places and by how many measurements apart they are"
    parts = [f"{about}, {by}:\n\n{markdown(lines)}"]
    if rows:
        lines = [
            [name, *(_number(row[key], title) for key, title in titles.items())]
            for name, row in rows.items()
        ]
        lines = [["predicted by", *titles.values()], *lines]
        parts.append(f"What that lets expect on split {split}:\n\n{markdown(lines)}")
    compared = [cell.compared for cell in cells if cell.compared < cell.pairs]
    drawn = (
        [f"of a cell with more, {max(compared):,} random pairs are compared"] if compared else []
    )
    parts.append("".join(f"- {remark}\n" for remark in [*remarks, *drawn]))
    page = "\n".join(parts)
    write_text(folder / "agreement.md", page)
    save(figure(score, cells), folder / "agreement.png")
    return page


def figure(score: str, cells: Sequence[Cell]) -> Figure:
    """Median and 10th to 90th percentile against distance, one line for each separation."""
    distances = list(dict.fromkeys(cell.distance for cell in cells))
    columns = sorted({cell.separation for cell in cells})
    with rc_context(STYLE):
        figure = Figure(figsize=(COLUMN, 2.9), layout="constrained")
        ax = figure.subplots()
        for number, column in enumerate(columns):
            own = [cell for cell in cells if cell.separation == column]
            shift = 0.14 * (number - (len(columns) - 1) / 2)
            x = [distances.index(cell.distance) + shift for cell in own]
            low, median, high = np.array([cell.quantiles for cell in own]).T
            (colour, dash), marker = LINES[number % len(LINES)], "os^Dv"[number % 5]
            look = {
                "color": colour,
                "linestyle": dash,
                "marker": marker,
                "markersize": 3.5,
                "elinewidth": 0.6,
            }
            ax.errorbar(x, median, [median - low, high - median], label=_separation(column), **look)
        ax.set(xlabel="distance of the places [m]", ylabel=f"{score} of two labels")
        ax.set_xticks(
            range(len(distances)),
            [_distance(distance) for distance in distances],
            rotation=40,
            ha="right",
        )
        ax.grid(axis="y")
        figure.legend(loc="outside upper center", ncols=2, title="measurements apart")
    return figure


def _number(value: float, title: str) -> str:
    return f"{value:z.{2 if title.endswith(']') else 3}f}"


def _distance(bounds: tuple[float, float]) -> str:
    low, high = bounds
    if not high:
        return "same place"
    return f"under {high:g}" if not low else f"{low:g} to {high:g}"


def _separation(bounds: tuple[int, float]) -> str:
    low, high = bounds
    if math.isinf(high):
        return f"over {low - 1:,}" if low else "any"
    return f"{low:,} to {high:,}" if low else f"within {high:,}"
