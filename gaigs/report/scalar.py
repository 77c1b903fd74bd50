"""Figures of one real number a link: predicted against measured values, radio maps, the
distribution of errors.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import ceil
from pathlib import Path

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
from gaigs.report.figures import TaskFigures, own_scores, scores_of_systems
from gaigs.report.style import BLUE, GREY, ORANGE, PAGE, STYLE, round_step

PANELS, MOST = 6, 12
"""Largest numbers of panels of a figure, a panel a receiver, and of receivers in the figures of a
run.
"""

FEW = 400
"""Largest number of dots of a panel that do not hide each other."""


class ScalarFigures(TaskFigures):
    """Predicted against measured values, the radio map and the distribution of errors."""

    def of_run(self, task: Scalar, folder: Path, links: Links) -> dict[str, Figure]:
        errors = {
            name: abs(values)
            for name, values in own_scores(folder / "predictions.npz", "error").items()
        }
        with np.load(folder / "predictions.npz") as run:
            transmitters, receiver, labels, predictions = (
                run[name] for name in ("transmitters", "receiver", "labels", "prediction")
            )
        gateways = {one.name: one.pose.position.numpy() for one in links.receivers}
        # Of many receivers those with the most test readings, in their order.
        shown = np.sort(
            (-np.bincount(receiver, minlength=len(gateways))).argsort(kind="stable")[:MOST]
        )
        own = np.isin(receiver, shown)
        readings = np.column_stack((transmitters[:, :2], labels))
        measured = {name: readings[receiver == index] for index, name in enumerate(gateways)}
        radio_map, edges = RadioMap.load(folder / "radio_map.npz").only(shown), links.edges.numpy()
        maps = map_pages(radio_map, gateways, measured, edges, task)
        pages = predicted_against_measured(
            labels[own], predictions[own], receiver[own], [*gateways], task
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
        return {
            "cdf": cdf(
                errors, with_unit("|error|", task.error_unit), "readings", split, (0, furthest)
            )
        }


def predicted_against_measured(
    labels: Float[ndarray, " t"],
    predictions: Float[ndarray, " t"],
    receiver: Int[ndarray, " t"],
    names: Sequence[str],
    task: Scalar,
) -> list[Figure]:
    """Test readings over label and prediction [task.unit], one panel a receiver, all on the same
    axes.

    They are dots; if a receiver has more than ``FEW``, they are counted in cells. A prediction more
    than 20 cells outside the labels is drawn there. A receiver without readings has no panel.
    ``receiver`` is an index into the names of each reading.
    """
    errors, unit = np.abs(predictions - labels), task.error_unit
    # Equal labels have no range: the cell's width then suits their size, or is 1.
    span = float(np.ptp(labels)) or float(np.abs(labels).max()) or 1.0
    cell = 2 if unit == "dB" else round_step(span, 40)
    predictions = predictions.clip(labels.min() - 20 * cell, labels.max() + 20 * cell)
    heard = np.unique(receiver)
    # In numbers of cells, so that no rounding of the cells' edges leaves a reading out.
    across, up = labels / cell, predictions / cell
    lower = np.floor(min(across.min(), up.min()))
    upper = np.floor(max(across.max(), up.max())) + 1  # past a value on an edge
    edges = np.arange(lower, upper + 1)
    counts = [
        np.histogram2d(across[receiver == r], up[receiver == r], (edges, edges))[0].T for r in heard
    ]
    has_few = max(count.sum() for count in counts) <= FEW
    colours = LogNorm(1, max(2, max(count.max() for count in counts)))
    ticks = np.outer(10.0 ** np.arange(7), (1, 2, 5)).ravel()
    cells, limits = cell * edges, (cell * lower, cell * upper)
    axis = with_unit(task.quantity, task.unit)
    figures = []
    with rc_context(STYLE):
        for first in range(0, len(heard), PANELS):
            page = range(first, min(first + PANELS, len(heard)))
            figure, axes = _panels(len(page), 1, 1, f"measured {axis}", f"predicted {axis}")
            for ax, panel in zip(axes, page, strict=True):
                if has_few:
                    own = receiver == heard[panel]
                    ax.plot(
                        labels[own],
                        predictions[own],
                        "o",
                        color=BLUE,
                        markersize=3,
                        alpha=0.5,
                        markeredgewidth=0,
                    )
                else:
                    count = np.ma.masked_equal(counts[panel], 0)
                    image = ax.pcolormesh(
                        cells, cells, count, cmap="viridis_r", norm=colours, rasterized=True
                    )
                ax.axline((limits[0], limits[0]), slope=1, color="0.3", linewidth=0.7)
                ax.set(xlim=limits, ylim=limits, aspect="equal")
                error = errors[receiver == heard[panel]].mean()
                error = f"{error:.2f} dB" if unit == "dB" else f"{error:#.3g} {unit}".strip()
                ax.set_title(f"{names[heard[panel]]}, MAE {error}")
                ax.grid()
                ax.set_axisbelow(True)
            if not has_few:
                size = f"{cell:g} {unit}".strip()
                label = f"test readings in {size} × {size}"
                bar = figure.colorbar(
                    image, ax=axes, label=label, format="{x:g}", aspect=30, shrink=0.7
                )
                bar.set_ticks(ticks[ticks <= colours.vmax])
                bar.minorticks_off()
            if len(heard) < len(names):
                figure.suptitle(f"{len(heard)} of {len(names)} receivers", size=8)
            figures.append(figure)
    return figures


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
) -> list[Figure]:
    """The map of each receiver in a panel, all with the same axes and colours, and the walls on the
    floor [m].

    ``readings`` are x, y [m] and label [task.unit] by receiver; at most 100 of each, evenly chosen,
    are drawn.
    """
    dots = {
        name: readings[name][:: -(-len(readings[name]) // 100) or 1] for name in radio_map.receivers
    }
    limits, step = _scale(
        radio_map.values, np.concatenate([dot[:, 2] for dot in dots.values()]), task.error_unit
    )
    colours = {"cmap": "viridis"} | limits
    walls = edges[(edges[..., 2] == edges[..., 2].min(initial=np.inf)).all(1)][..., :2]
    lowest, highest = (np.array((radio_map.x[end], radio_map.y[end])) for end in (0, -1))
    half = (highest - lowest) / (np.array(radio_map.values.shape[:0:-1]) - 1) / 2  # of a pixel
    (left, bottom), (right, top) = lowest - half, highest + half
    corners = np.concatenate((((left, bottom), (right, top)), walls.reshape(-1, 2)))
    lower, upper = corners.min(0), corners.max(0)
    rim = 0.02 * (upper - lower).max()
    lower, upper = lower - rim, upper + rim
    place = {"origin": "lower", "extent": (left, right, bottom, top), "interpolation": "bilinear"}
    lines = {"colors": "white", "linestyles": "solid", "linewidths": 0.4, "alpha": 0.5}
    carrier = "" if radio_map.frequency is None else f" at {radio_map.frequency / 1e9:.6g} GHz"
    title = (
        f"Predicted {radio_map.quantity} of a transmitter at z = {radio_map.height:.2f} m{carrier}"
    )
    if (count := len(radio_map.receivers)) < len(gateways):
        title += f" at {count} of {len(gateways)} receivers"
    figures = []
    with rc_context(STYLE):
        for first in range(0, len(radio_map.receivers), PANELS):
            names = radio_map.receivers[first : first + PANELS]
            figure, axes = _panels(
                len(names), upper[0] - lower[0], upper[1] - lower[1], "x [m]", "y [m]"
            )
            for ax, name, values in zip(axes, names, radio_map.values[first:], strict=False):
                image = ax.imshow(values, **place, **colours)
                levels = _levels(values, limits, step)
                if len(levels):
                    ax.contour(radio_map.x, radio_map.y, values, levels, **lines)
                drawn = ax.add_collection(LineCollection(walls, colors="black", linewidths=0.9))
                drawn.set_path_effects([Stroke(linewidth=1.8, foreground="white"), Normal()])
                x, y, label = dots[name].T
                ax.scatter(x, y, 9, label, edgecolors="white", linewidths=0.4, zorder=3, **colours)
                (gateway,) = ax.plot(
                    *gateways[name][:2], "^", color=ORANGE, markersize=8, markeredgecolor="white"
                )
                ax.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), title=name)
                ax.locator_params(nbins=5, steps=(1, 2, 5, 10))
            figure.suptitle(
                f"{title}, a line every {f'{step:g} {task.error_unit}'.strip()}", size=8
            )
            label = with_unit(radio_map.quantity, radio_map.unit)
            figure.colorbar(image, ax=axes, label=label, aspect=30, shrink=0.7, extend="both")
            dot = Line2D([], [], linestyle="", marker="o", markersize=4, color=GREY)
            key = {"receiver": gateway}
            if len(walls):
                key["walls and furniture"] = Line2D([], [], color="black", linewidth=0.9)
            if any(len(rows) for rows in dots.values()):
                key["test readings, in the map's colours"] = dot
            figure.legend(key.values(), key, loc="outside lower center", ncols=3)
            figures.append(figure)
    return figures


def _scale(
    values: Float[ndarray, "..."], readings: Float[ndarray, " k"], error_unit: str
) -> tuple[dict[str, float], float]:
    """Ends of the colour scale, round numbers about the middle 98 % of map and readings; distance
    of two contours.
    """
    quantiles = np.concatenate(
        [np.quantile(part, (0.01, 0.99)) for part in (values, readings) if part.size]
    )
    low, high = quantiles.min(), quantiles.max()
    # A flat map has no range: the scale's width then suits its size, or is 1.
    span = float(high - low) or float(abs(high)) or 1.0
    rounded, contour = (
        (5, 10) if error_unit == "dB" and span > 10 else (round_step(span, 20), round_step(span, 8))
    )
    return {
        "vmin": rounded * np.floor(low / rounded),
        "vmax": rounded * (np.floor(high / rounded) + 1),
    }, contour


def _levels(
    values: Float[ndarray, "rows columns"], limits: Mapping[str, float], step: float
) -> Float[ndarray, " k"]:
    """Contours that cross a map, at most 20 beyond each end of the colour scale."""
    lowest = max(values.min(), limits["vmin"] - 20 * step)
    highest = min(values.max(), limits["vmax"] + 20 * step)
    levels = step * np.arange(np.floor(lowest / step), np.ceil(highest / step) + 1)
    return levels[(levels > lowest) & (levels < highest)]


def _panels(
    count: int, width: float, height: float, xlabel: str, ylabel: str
) -> tuple[Figure, list[Axes]]:
    """Panels with common axes of an extent in one unit, as large as a page with colour bar and
    legend allows.
    """
    bar, title, foot = 1.5, 0.25, 0.65  # inches beside all, above each and below all
    scale = lambda columns: min(
        (PAGE - bar) / (columns * width), 5.6 / (ceil(count / columns) * height), 3 / height
    )
    columns = max(range(1, count + 1), key=scale)
    rows, inches = ceil(count / columns), scale(columns)
    size = columns * width * inches + bar, rows * (height * inches + title) + foot
    figure = Figure(figsize=size, layout="compressed")
    axes = list(figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat)
    for ax in axes[count:]:
        ax.remove()
    for index, ax in enumerate(axes[:count]):
        if index % columns == 0:
            ax.set_ylabel(ylabel)
        if index + columns >= count:  # the lowest panel of its column
            ax.set_xlabel(xlabel)
            ax.tick_params(labelbottom=True)
    return figure, axes[:count]
