"""Figures of scalar labels: predictions against labels, radio maps, errors."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy import ndarray

from gaigs.core.radio_maps import RadioMap
from gaigs.core.task.scalar import Scalar, with_unit
from gaigs.data import Links
from gaigs.report.curves import cdf
from gaigs.report.figures import TaskFigures
from gaigs.report.predictions import own_scores, scores_of_systems
from gaigs.report.radio_maps import map_pages
from gaigs.report.style import BLUE, STYLE, ask, even_pages, numbered, round_step, scaled_panels


class ScalarFigures(TaskFigures):
    """Predicted against measured values, the radio map and the distribution of errors."""

    def of_run(
        self, task: Scalar, folder: Path, links: Links, max_receivers: int = 9
    ) -> dict[str, Figure]:
        file = folder / "predictions.npz"
        errors = {name: abs(values) for name, values in own_scores(file, "error").items()}
        with np.load(file) as run:
            transmitters = run["transmitters"]
            receiver = run["receiver"]
            labels = run["labels"]
            predictions = run["prediction"]
        gateways = {antenna.name: antenna.pose.position.numpy() for antenna in links.receivers}
        # The receivers with the most test readings, in the order of the data.
        counts = np.bincount(receiver, minlength=len(gateways))
        most_readings = (-counts).argsort(kind="stable")[:max_receivers]
        shown = np.sort(most_readings)
        is_shown = np.isin(receiver, shown)
        readings = np.column_stack((transmitters[:, :2], labels))
        measured = {name: readings[receiver == index] for index, name in enumerate(gateways)}
        radio_map = RadioMap.load(folder / "radio_map.npz").only(shown)
        maps = map_pages(radio_map, gateways, measured, links.edges.numpy())
        pages = predicted_against_measured(
            labels[is_shown], predictions[is_shown], receiver[is_shown], [*gateways], task
        )
        # The largest hundredth of errors would squeeze all others.
        furthest = float(max(np.quantile(error, 0.99) for error in errors.values())) or None
        title = with_unit("|error|", task.error_unit)
        figures = {"error_cdf": cdf(errors, title, "readings", links.split.name, (0, furthest))}
        return figures | numbered("predicted_against_measured", pages) | maps

    def of_systems(
        self, task: type[Scalar], files: Mapping[str, Path], split: str
    ) -> dict[str, Figure]:
        errors = {name: abs(values) for name, values in scores_of_systems(files, "error").items()}
        # Of all readings and systems: a single system that failed would squeeze all others.
        furthest = np.quantile(np.concatenate([*errors.values()]), 0.98) or None
        title = with_unit("|error|", task.error_unit)
        return {"cdf": cdf(errors, title, "readings", split, (0, furthest))}


def predicted_against_measured(
    labels: Float[ndarray, " t"],
    predictions: Float[ndarray, " t"],
    receiver: Int[ndarray, " t"],
    names: Sequence[str],
    task: Scalar,
    max_dots: int = 400,
    max_panels: int = 9,
) -> list[Figure]:
    """Predictions against labels of test readings, a panel for each receiver, on the same axes.

    A receiver without readings has no panel.

    Args:
        labels: Labels [task.unit].
        predictions: Predictions [task.unit].
        receiver: Receiver of each reading.
        names: Names of the receivers.
        max_dots: Largest number of readings of a receiver that are drawn as separate dots; more
            readings are counted in cells.
        max_panels: Largest number of panels in a figure.
    """
    errors = np.abs(predictions - labels)
    cells = _cells(labels, predictions, receiver, task.error_unit)
    predictions = predictions.clip(*cells.limits)
    received = [*cells.counts]
    has_few = max(count.sum() for count in cells.counts.values()) <= max_dots
    colours = LogNorm(1, max(2, max(count.max() for count in cells.counts.values())))
    axis = with_unit(task.quantity, task.unit)
    figures = []
    with rc_context(STYLE):
        for page in even_pages(received, max_panels):
            labelled = f"label, {axis}"
            predicted = f"prediction, {axis}"
            figure, axes = scaled_panels(len(page), 1, 1, labelled, predicted)
            for ax, index in zip(axes, page, strict=True):
                of_receiver = receiver == index
                if has_few:
                    dots = {"color": BLUE, "markersize": 3, "alpha": 0.5, "markeredgewidth": 0}
                    ax.plot(labels[of_receiver], predictions[of_receiver], "o", **dots)
                else:
                    count = np.ma.masked_equal(cells.counts[index], 0)
                    look = {"cmap": "viridis_r", "norm": colours, "rasterized": True}
                    image = ax.pcolormesh(cells.edges, cells.edges, count, **look)
                start = cells.edges[0]
                ax.axline((start, start), slope=1, color="0.3", linewidth=0.7)
                limits = (start, cells.edges[-1])
                ax.set(xlim=limits, ylim=limits, aspect="equal")
                error = errors[of_receiver].mean()
                digits = f"{error:.2f}" if task.error_unit == "dB" else f"{error:#.3g}"
                ax.set_title(f"{names[index]}, MAE {digits} {task.error_unit}".rstrip())
                ax.grid()
                ax.set_axisbelow(True)
            if not has_few:
                size = f"{cells.width:g} {task.error_unit}".strip()
                _draw_counts(figure, axes, image, f"test readings in {size} × {size}")
            has_all = len(received) == len(names)
            note = "" if has_all else f"{len(received)} of {len(names)} receivers"
            ask(figure, "How close are predictions to test labels?", note)
            figures.append(figure)
    return figures


class _Cells(NamedTuple):
    """Squares over label and prediction, in which readings are counted."""

    width: float  # width of a square [task.unit]
    edges: Float[ndarray, " n+1"]  # edges along both axes [task.unit]
    limits: tuple[np.floating, np.floating]  # predictions beyond them are drawn at them [task.unit]
    counts: dict[int, Float[ndarray, "n n"]]  # counts (prediction, label), by receiver


def _cells(
    labels: Float[ndarray, " t"],
    predictions: Float[ndarray, " t"],
    receiver: Int[ndarray, " t"],
    error_unit: str,
) -> _Cells:
    """Numbers of readings in square cells of label and prediction.

    Cells have a round width and cover all labels. Predictions more than 20 cells outside the range
    of the labels are clipped to this limit.
    """
    # Equal labels have no range: the cell's width then suits their size, or is 1.
    span = float(np.ptp(labels)) or float(np.abs(labels).max()) or 1.0
    width = 2 if error_unit == "dB" else round_step(span, 40)
    limits = (labels.min() - 20 * width, labels.max() + 20 * width)
    # In units of a cell, so that no rounding of the cells' edges leaves a reading out.
    x = labels / width
    y = predictions.clip(*limits) / width
    lower = np.floor(min(x.min(), y.min()))
    upper = np.floor(max(x.max(), y.max())) + 1  # past a value on an edge
    edges = np.arange(lower, upper + 1)
    counts = {}
    for index in np.unique(receiver):
        of_receiver = receiver == index
        count, _, _ = np.histogram2d(x[of_receiver], y[of_receiver], (edges, edges))
        counts[int(index)] = count.T  # rows are predictions, as in an image
    return _Cells(width, width * edges, limits, counts)


def _draw_counts(figure: Figure, axes: list[Axes], image: Any, label: str) -> None:
    """Draws the colour bar of an image of counts, with round ticks."""
    bar = figure.colorbar(image, ax=axes, label=label, format="{x:g}", aspect=30, shrink=0.7)
    ticks = np.outer(10.0 ** np.arange(7), (1, 2, 5)).ravel()
    bar.set_ticks(ticks[ticks <= image.norm.vmax])
    bar.minorticks_off()
