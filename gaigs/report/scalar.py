"""Figures of one real number a link: predicted against measured values, radio maps, the
distribution of errors.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import ceil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Int
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke
from numpy import ndarray

from gaigs.core.radio_maps import RadioMap
from gaigs.core.task.scalar import Scalar, with_unit
from gaigs.data import Links
from gaigs.report.curves import cdf
from gaigs.report.figures import TaskFigures
from gaigs.report.predictions import own_scores, scores_of_systems
from gaigs.report.style import BLUE, GREY, ORANGE, PAGE, STYLE, panels, round_step


class ScalarFigures(TaskFigures):
    """Predicted against measured values, the radio map and the distribution of errors."""

    def of_run(
        self, task: Scalar, folder: Path, links: Links, max_receivers: int = 12
    ) -> dict[str, Figure]:
        file = folder / "predictions.npz"
        errors = {name: abs(values) for name, values in own_scores(file, "error").items()}
        with np.load(file) as run:
            transmitters = run["transmitters"]
            receiver = run["receiver"]
            labels = run["labels"]
            predictions = run["prediction"]
        gateways = {one.name: one.pose.position.numpy() for one in links.receivers}
        # Of many receivers those with the most test readings, in their order.
        counts = np.bincount(receiver, minlength=len(gateways))
        shown = np.sort((-counts).argsort(kind="stable")[:max_receivers])
        is_shown = np.isin(receiver, shown)
        readings = np.column_stack((transmitters[:, :2], labels))
        measured = {name: readings[receiver == index] for index, name in enumerate(gateways)}
        radio_map = RadioMap.load(folder / "radio_map.npz").only(shown)
        maps = map_pages(radio_map, gateways, measured, links.edges.numpy(), task)
        pages = predicted_against_measured(
            labels[is_shown], predictions[is_shown], receiver[is_shown], [*gateways], task
        )
        # The last hundredth would squeeze all others.
        furthest = float(max(np.quantile(error, 0.99) for error in errors.values())) or None
        title = with_unit("|error|", task.error_unit)
        figures = {"error_cdf": cdf(errors, title, "readings", links.split.name, (0, furthest))}
        return figures | _numbered("predicted_against_measured", pages) | maps

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
    max_panels: int = 6,
) -> list[Figure]:
    """Test readings over label and prediction, one panel a receiver, all on the same axes.

    A receiver without readings has no panel.

    Args:
        labels: Labels [task.unit].
        predictions: Predictions, likewise.
        receiver: Index of each reading's receiver.
        names: Names of the receivers.
        task: Task of the labels.
        max_dots: Largest number of readings of a receiver that are drawn as dots, which do not hide
            each other; more are counted in cells.
        max_panels: Most panels of a figure.
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
        for first in range(0, len(received), max_panels):
            page = received[first : first + max_panels]
            figure, axes = _panels(len(page), 1, 1, f"measured {axis}", f"predicted {axis}")
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
                error = _with_digits(errors[of_receiver].mean(), task.error_unit)
                ax.set_title(f"{names[index]}, MAE {error}")
                ax.grid()
                ax.set_axisbelow(True)
            if not has_few:
                size = f"{cells.width:g} {task.error_unit}".strip()
                _draw_counts(figure, axes, image, f"test readings in {size} × {size}")
            if len(received) < len(names):
                figure.suptitle(f"{len(received)} of {len(names)} receivers", size=8)
            figures.append(figure)
    return figures


class _Cells(NamedTuple):
    """Squares over label and prediction, in which readings are counted."""

    width: float  # [task.unit]
    edges: Float[ndarray, " n+1"]  # along both axes [task.unit]
    limits: tuple[np.floating, np.floating]  # of predictions that are drawn in their place
    counts: dict[int, Float[ndarray, "n n"]]  # (prediction, label), by index of the receiver


def _cells(
    labels: Float[ndarray, " t"],
    predictions: Float[ndarray, " t"],
    receiver: Int[ndarray, " t"],
    error_unit: str,
) -> _Cells:
    """Cells of a round width, which hold all labels.

    A prediction more than 20 cells outside the range of the labels counts as at that limit.
    """
    # Equal labels have no range: the cell's width then suits their size, or is 1.
    span = float(np.ptp(labels)) or float(np.abs(labels).max()) or 1.0
    width = 2 if error_unit == "dB" else round_step(span, 40)
    limits = (labels.min() - 20 * width, labels.max() + 20 * width)
    # In numbers of cells, so that no rounding of the cells' edges leaves a reading out.
    across = labels / width
    up = predictions.clip(*limits) / width
    lower = np.floor(min(across.min(), up.min()))
    upper = np.floor(max(across.max(), up.max())) + 1  # past a value on an edge
    edges = np.arange(lower, upper + 1)
    counts = {}
    for index in np.unique(receiver):
        of_receiver = receiver == index
        count, *_ = np.histogram2d(across[of_receiver], up[of_receiver], (edges, edges))
        counts[int(index)] = count.T
    return _Cells(width, width * edges, limits, counts)


def _with_digits(error: float, unit: str) -> str:
    """An error with its unit: two decimals of decibels, three digits of all else."""
    return f"{error:.2f} dB" if unit == "dB" else f"{error:#.3g} {unit}".strip()


def _draw_counts(figure: Figure, axes: list[Axes], image: Any, label: str) -> None:
    """The colour bar of numbers of readings, with round ticks."""
    bar = figure.colorbar(image, ax=axes, label=label, format="{x:g}", aspect=30, shrink=0.7)
    ticks = np.outer(10.0 ** np.arange(7), (1, 2, 5)).ravel()
    bar.set_ticks(ticks[ticks <= image.norm.vmax])
    bar.minorticks_off()


def _numbered(name: str, pages: Sequence[Figure]) -> dict[str, Figure]:
    return {f"{name}_{page}" if page > 1 else name: figure for page, figure in enumerate(pages, 1)}


def map_pages(
    radio_map: RadioMap,
    gateways: Mapping[str, Float[ndarray, "3"]],
    readings: Mapping[str, Float[ndarray, "k 3"]],
    edges: Float[ndarray, "s 2 3"],
    task: Scalar,
) -> dict[str, Figure]:
    """Pages of ``radio_map`` and, if there are deviations, of ``deviation_map``, by name; see
    ``radio_maps``.
    """
    pages = _numbered("radio_map", radio_maps(radio_map, gateways, readings, edges, task))
    if radio_map.deviations is not None:
        unit = {"quantity": "standard deviation", "unit": task.error_unit}
        deviations = replace(radio_map, values=radio_map.deviations, **unit)
        none = {name: rows[:0] for name, rows in readings.items()}
        pages |= _numbered("deviation_map", radio_maps(deviations, gateways, none, edges, task))
    return pages


def radio_maps(
    radio_map: RadioMap,
    gateways: Mapping[str, Float[ndarray, "3"]],
    readings: Mapping[str, Float[ndarray, "k 3"]],
    edges: Float[ndarray, "s 2 3"],
    task: Scalar,
    max_panels: int = 6,
) -> list[Figure]:
    """The map of each receiver in a panel, all with the same axes and colours.

    Args:
        radio_map: The map.
        gateways: Positions of all receivers by name [m].
        readings: x, y [m] and label [task.unit] by receiver; of each at most 100, evenly chosen,
            are drawn.
        edges: Edges of walls; those on the floor are drawn [m].
        task: Task of the labels.
        max_panels: Most panels of a figure.
    """
    dots = {}
    for name in radio_map.receivers:
        every = ceil(len(readings[name]) / 100) or 1
        dots[name] = readings[name][::every]
    shown = np.concatenate([dot[:, 2] for dot in dots.values()])
    scale = _scale(radio_map.values, shown, task.error_unit)
    is_low = (edges[..., 2] == edges[..., 2].min(initial=np.inf)).all(1)
    walls = edges[is_low][..., :2]
    extent, lower, upper = _extent(radio_map, walls)
    look = {"cmap": "viridis", "vmin": scale.low, "vmax": scale.high}
    place = {"origin": "lower", "extent": extent, "interpolation": "bilinear"}
    lines = {"colors": "white", "linestyles": "solid", "linewidths": 0.4, "alpha": 0.5}
    width, height = upper - lower
    figures = []
    with rc_context(STYLE):
        for first in range(0, len(radio_map.receivers), max_panels):
            names = radio_map.receivers[first : first + max_panels]
            figure, axes = _panels(len(names), width, height, "x [m]", "y [m]")
            for ax, name, values in zip(axes, names, radio_map.values[first:], strict=False):
                image = ax.imshow(values, **place, **look)
                levels = _levels(values, scale)
                if len(levels):
                    ax.contour(radio_map.x, radio_map.y, values, levels, **lines)
                drawn = ax.add_collection(LineCollection(walls, colors="black", linewidths=0.9))
                drawn.set_path_effects([Stroke(linewidth=1.8, foreground="white"), Normal()])
                x, y, label = dots[name].T
                ax.scatter(x, y, 9, label, edgecolors="white", linewidths=0.4, zorder=3, **look)
                gateway = _draw_gateway(ax, gateways[name])
                ax.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), title=name)
                ax.locator_params(nbins=5, steps=(1, 2, 5, 10))
            step = f"{scale.step:g} {task.error_unit}".strip()
            title = _title(radio_map, len(gateways))
            figure.suptitle(f"{title}, a line every {step}", size=8)
            label = with_unit(radio_map.quantity, radio_map.unit)
            figure.colorbar(image, ax=axes, label=label, aspect=30, shrink=0.7, extend="both")
            key = {"receiver": gateway}
            if len(walls):
                key["walls and furniture"] = Line2D([], [], color="black", linewidth=0.9)
            if len(shown):
                dot = Line2D([], [], linestyle="", marker="o", markersize=4, color=GREY)
                key["test readings, in the map's colours"] = dot
            figure.legend(key.values(), key, loc="outside lower center", ncols=3)
            figures.append(figure)
    return figures


def _title(radio_map: RadioMap, receivers: int) -> str:
    """What a radio map shows, of how many receivers."""
    carrier = "" if radio_map.frequency is None else f" at {radio_map.frequency / 1e9:.6g} GHz"
    place = f"z = {radio_map.height:.2f} m{carrier}"
    title = f"Predicted {radio_map.quantity} of a transmitter at {place}"
    count = len(radio_map.receivers)
    return title if count >= receivers else f"{title} at {count} of {receivers} receivers"


def _draw_gateway(ax: Axes, position: Float[ndarray, "3"]) -> Line2D:
    look = {"color": ORANGE, "markersize": 8, "markeredgecolor": "white"}
    (mark,) = ax.plot(*position[:2], "^", **look)
    return mark


class _Extent(NamedTuple):
    """Where a map lies and what its panel shows [m]."""

    image: tuple  # left, right, bottom and top of the map with its outer pixels
    lower: Float[ndarray, "2"]  # ends of a panel
    upper: Float[ndarray, "2"]


def _extent(radio_map: RadioMap, walls: Float[ndarray, "s 2 2"]) -> _Extent:
    """The extent of a map, and of a panel that shows it and the walls with a rim."""
    lowest = np.array((radio_map.x[0], radio_map.y[0]))
    highest = np.array((radio_map.x[-1], radio_map.y[-1]))
    rows, columns = radio_map.values.shape[1:]
    half = (highest - lowest) / (np.array((columns, rows)) - 1) / 2  # of a pixel
    (left, bottom), (right, top) = lowest - half, highest + half
    corners = np.concatenate((((left, bottom), (right, top)), walls.reshape(-1, 2)))
    lower = corners.min(0)
    upper = corners.max(0)
    rim = 0.02 * (upper - lower).max()
    return _Extent((left, right, bottom, top), lower - rim, upper + rim)


class _Scale(NamedTuple):
    """Ends of a scale of colours, and the distance of two contours [task.unit]."""

    low: float
    high: float
    step: float


def _scale(
    values: Float[ndarray, "..."], readings: Float[ndarray, " k"], error_unit: str
) -> _Scale:
    """Round numbers about the middle 98 % of map and readings."""
    parts = [np.quantile(part, (0.01, 0.99)) for part in (values, readings) if part.size]
    quantiles = np.concatenate(parts)
    low = quantiles.min()
    high = quantiles.max()
    # A flat map has no range: the scale's width then suits its size, or is 1.
    span = float(high - low) or float(abs(high)) or 1.0
    is_wide = error_unit == "dB" and span > 10
    rounded = 5 if is_wide else round_step(span, 20)
    step = 10 if is_wide else round_step(span, 8)
    lower = rounded * np.floor(low / rounded)
    return _Scale(lower, rounded * (np.floor(high / rounded) + 1), step)


def _levels(values: Float[ndarray, "rows columns"], scale: _Scale) -> Float[ndarray, " k"]:
    """Contours that cross a map, at most 20 beyond each end of the colour scale."""
    lowest = max(values.min(), scale.low - 20 * scale.step)
    highest = min(values.max(), scale.high + 20 * scale.step)
    first = np.floor(lowest / scale.step)
    last = np.ceil(highest / scale.step)
    levels = scale.step * np.arange(first, last + 1)
    return levels[(levels > lowest) & (levels < highest)]


def _panels(
    count: int, width: float, height: float, xlabel: str, ylabel: str
) -> tuple[Figure, list[Axes]]:
    """Panels with common axes of an extent in one unit, as large as a page with colour bar and
    legend allows.
    """
    bar = 1.5  # inches beside all panels
    title = 0.25  # inches above each panel
    foot = 0.65  # inches below all panels

    def scale(columns: int) -> float:
        """Inches of one unit."""
        rows = ceil(count / columns)
        return min((PAGE - bar) / (columns * width), 5.6 / (rows * height), 3 / height)

    columns = max(range(1, count + 1), key=scale)
    rows = ceil(count / columns)
    inches = scale(columns)
    size = columns * width * inches + bar, rows * (height * inches + title) + foot
    figure = Figure(figsize=size, layout="compressed")
    return figure, panels(figure, count, columns, xlabel, ylabel)
