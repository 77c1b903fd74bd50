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
from gaigs.report.style import COLUMN, LINES, STYLE, ask, new_figure, save
from gaigs.report.table import markdown


class Cell(NamedTuple):
    """Pairs of labels with similar distances between places and similar separations in time."""

    # Distance of their places, from and to below [m]; 0 and 0 for one place.
    distance: tuple[float, float]
    separation: tuple[int, float]  # measurements between them, from and to
    pairs: int  # number of pairs
    compared: int  # number of pairs whose labels were compared
    # 10th percentile, median and 90th percentile of the score.
    quantiles: tuple[float, float, float]

    def text(self, score: str) -> str:
        """The cell as shown in a table: median, percentiles and number of pairs."""
        low, median, high = (_number(value, score) for value in self.quantiles)
        return f"{median} ({low} to {high}), {self.pairs:,}"


def write(
    folder: Path,
    task: Task,
    cells: Sequence[Cell],
    rows: Mapping[str, Mapping],
    split: str,
    remarks: Sequence[str],
) -> str:
    """Writes ``agreement.md`` and ``agreement.png``, and returns the page."""
    score = task.pair_score
    parts = [
        f"Median {score} of two labels, 10th to 90th percentile, and number of pairs, "
        "by the distance of their places and by how many measurements apart they are:\n\n"
        f"{markdown(table_of_cells(cells, score))}"
    ]
    if rows:
        titles = {name: metric.title for name, metric in task.metrics().items()}
        lines = [["predicted by", *titles.values()]]
        for name, row in rows.items():
            numbers = [_number(row[key], title) for key, title in titles.items()]
            lines.append([name, *numbers])
        parts.append(f"What that lets expect on split {split}:\n\n{markdown(lines)}")
    compared = [cell.compared for cell in cells if cell.compared < cell.pairs]
    if compared:
        drawn = f"of a cell with more, {max(compared):,} random pairs are compared"
        remarks = [*remarks, drawn]
    parts.append("".join(f"- {remark}\n" for remark in remarks))
    page = "\n".join(parts)
    write_text(folder / "agreement.md", page)
    save(figure(score, cells), folder / "agreement.png")
    return page


def table_of_cells(cells: Sequence[Cell], score: str) -> list[list[str]]:
    """Rows of a table with its heading: distances of places down, separations across."""
    texts = {(cell.distance, cell.separation): cell.text(score) for cell in cells}
    separations = sorted({cell.separation for cell in cells})
    lines = [["distance [m]", *map(_separation, separations)]]
    for distance in dict.fromkeys(cell.distance for cell in cells):  # each once, in their order
        row = [texts.get((distance, separation), "") for separation in separations]
        lines.append([_distance(distance), *row])
    return lines


def figure(score: str, cells: Sequence[Cell]) -> Figure:
    """Median and 10th to 90th percentile against distance, a line for each range of separations."""
    distances = list(dict.fromkeys(cell.distance for cell in cells))
    separations = sorted({cell.separation for cell in cells})
    with rc_context(STYLE):
        figure = new_figure(COLUMN, 3.15)
        ax = figure.subplots()
        for number, separation in enumerate(separations):
            members = [cell for cell in cells if cell.separation == separation]
            shift = 0.14 * (number - (len(separations) - 1) / 2)  # lines beside each other
            x = [distances.index(cell.distance) + shift for cell in members]
            low, median, high = np.array([cell.quantiles for cell in members]).T
            colour, dash = LINES[number % len(LINES)]
            ax.errorbar(
                x,
                median,
                [median - low, high - median],
                label=_separation(separation),
                color=colour,
                linestyle=dash,
                marker="os^Dv"[number % 5],
                markersize=3.5,
                elinewidth=0.6,
            )
        ax.set(xlabel="distance of the places [m]", ylabel=f"{score} of two labels")
        labels = [_distance(distance) for distance in distances]
        ax.set_xticks(range(len(distances)), labels, rotation=40, ha="right")
        ax.grid(axis="y")
        figure.legend(loc="outside lower center", ncols=2, title="measurements apart")
        ask(figure, "How far do near labels agree?")
    return figure


def _number(value: float, title: str) -> str:
    """A score with two decimals if its title ends with a unit, else with three."""
    return f"{value:z.{2 if title.endswith(']') else 3}f}"


def _distance(bounds: tuple[float, float]) -> str:
    """The label of a row of distances; bounds [m], 0 and 0 for pairs at one place."""
    low, high = bounds
    if not high:
        return "same place"
    return f"under {high:g}" if not low else f"{low:g} to {high:g}"


def _separation(bounds: tuple[int, float]) -> str:
    """The label of a column of separations; bounds [measurements], both included.

    The last column has no upper bound: "at least low" reads "over low - 1", which ends the column
    before.
    """
    low, high = bounds
    if math.isinf(high):
        return f"over {low - 1:,}" if low else "any"
    return f"{low:,} to {high:,}" if low else f"within {high:,}"
