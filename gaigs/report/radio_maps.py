"""Radio maps: predicted values, or their deviations, over a floor."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from math import ceil
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke
from numpy import ndarray

from gaigs.core.query import as_receivers
from gaigs.core.radio_maps import RadioMap
from gaigs.core.task.scalar import with_unit
from gaigs.data import Links
from gaigs.report.style import (
    GREY,
    ORANGE,
    STYLE,
    ask,
    even_pages,
    numbered,
    round_step,
    scaled_panels,
)


def map_pages(
    radio_map: RadioMap,
    gateways: Mapping[str, Float[ndarray, "3"]],
    readings: Mapping[str, Float[ndarray, "k 3"]],
    edges: Float[ndarray, "s 2 3"],
) -> dict[str, Figure]:
    """Figures of a radio map by file name: maps of values, then of standard deviations.

    Receivers whose deviation is the same everywhere have no map of deviations. Arguments are as for
    ``radio_maps``.
    """
    pages = numbered("radio_map", radio_maps(radio_map, gateways, readings, edges))
    constants = _constants(radio_map)
    varied = [receiver for receiver, constant in enumerate(constants) if constant is None]
    if radio_map.deviations is not None and varied:
        deviations = deviation_map(radio_map.only(np.array(varied)))
        pages |= numbered("deviation_map", radio_maps(deviations, gateways, {}, edges))
    return pages


def deviation_map(radio_map: RadioMap) -> RadioMap:
    """A map of the standard deviations of a map's values."""
    if radio_map.deviations is None:
        raise ValueError(
            "the map has no deviations, as the model has no intervals\n"
            "train it with more validation links"
        )
    unit = _error_unit(radio_map.unit)
    names = {"quantity": f"standard deviation of {radio_map.quantity}", "unit": unit}
    return replace(radio_map, values=radio_map.deviations, deviations=None, **names)


def _error_unit(unit: str) -> str:
    """The unit of a difference of labels."""
    return "dB" if unit == "dBm" else unit


def _constants(radio_map: RadioMap, spread: float = 0.02) -> list[float | None]:
    """The standard deviation at each receiver if it is nearly the same at all places; else None.

    Args:
        spread: Largest range of the middle 98 % of places, as a fraction of the deviation.
    """
    constants: list[float | None] = [None] * len(radio_map.receivers)
    if radio_map.deviations is not None:
        for index, deviations in enumerate(radio_map.deviations):
            low, high = np.quantile(deviations, (0.01, 0.99))
            if high - low <= spread * high:
                constants[index] = float(high)
    return constants


class _Drawing(NamedTuple):
    """Common data of the panels of a radio map."""

    radio_map: RadioMap
    gateways: Mapping[str, Float[ndarray, "3"]]  # positions of receivers by name [m]
    dots: dict[str, Float[ndarray, "k 3"]]  # x, y [m] and label of readings, by receiver
    walls: Float[ndarray, "s 2 2"]  # ends of the edges on the floor [m]
    scale: "_Scale"

    @classmethod
    def of(
        cls,
        radio_map: RadioMap,
        gateways: Mapping[str, Float[ndarray, "3"]],
        readings: Mapping[str, Float[ndarray, "k 3"]],
        edges: Float[ndarray, "s 2 3"],
    ) -> "_Drawing":
        """The drawing of a map, with at most 100 readings for each receiver, evenly chosen."""
        dots = {}
        for name in radio_map.receivers:
            rows = readings.get(name, np.zeros((0, 3)))
            stride = ceil(len(rows) / 100) or 1
            dots[name] = rows[::stride]
        labels = np.concatenate([rows[:, 2] for rows in dots.values()])
        scale = _scale(radio_map.values, labels, _error_unit(radio_map.unit))
        # The edges on the floor are the plan of the walls.
        is_low = (edges[..., 2] == edges[..., 2].min(initial=np.inf)).all(1)
        return cls(radio_map, gateways, dots, edges[is_low][..., :2], scale)

    def draw(self, ax: Axes, name: str) -> Any:
        """Draws the map of a receiver; returns its image, for a colour bar."""
        index = self.radio_map.receivers.index(name)
        values = self.radio_map.values[index]
        extent, lower, upper = _extent(self.radio_map, self.walls)
        colours = {"cmap": "viridis", "vmin": self.scale.low, "vmax": self.scale.high}
        place = {"origin": "lower", "extent": extent, "interpolation": "bilinear"}
        image = ax.imshow(values, **place, **colours)
        levels = _levels(values, self.scale)
        if len(levels):
            lines = {"colors": "white", "linestyles": "solid", "linewidths": 0.4, "alpha": 0.5}
            ax.contour(self.radio_map.x, self.radio_map.y, values, levels, **lines)
        # A white rim keeps walls visible on dark colours.
        walls = LineCollection(self.walls, colors="black", linewidths=0.9)
        walls.set_path_effects([Stroke(linewidth=1.8, foreground="white"), Normal()])
        ax.add_collection(walls)
        x, y, reading = self.dots[name].T
        ring = {"edgecolors": "black", "linewidths": 0.6, "zorder": 3}
        ax.scatter(x, y, 14, reading, **ring, **colours)
        if name in self.gateways:
            ax.add_line(_gateway_mark(self.gateways[name][:2, None]))
        title = name
        constant = _constants(self.radio_map)[index]
        if constant is not None:
            size = f"{constant:#.3g} {_error_unit(self.radio_map.unit)}".strip()
            title = f"{name}, ± {size} everywhere"
        ax.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), title=title)
        ax.locator_params(nbins=5, steps=(1, 2, 5, 10))
        return image

    def bar(self, figure: Figure, image: Any, axes: Sequence[Axes]) -> None:
        """Draws the colour bar of panels."""
        label = with_unit(self.radio_map.quantity, self.radio_map.unit)
        figure.colorbar(image, ax=axes, label=label, aspect=30, shrink=0.7, extend="both")


def _gateway_mark(places: Float[ndarray, "2 k"]) -> Line2D:
    """The mark of receivers on a map, at places x and y [m]."""
    look = {"color": ORANGE, "markersize": 8, "markeredgecolor": "white"}
    return Line2D(*places, linestyle="", marker="^", **look)


def radio_maps(
    radio_map: RadioMap,
    gateways: Mapping[str, Float[ndarray, "3"]],
    readings: Mapping[str, Float[ndarray, "k 3"]],
    edges: Float[ndarray, "s 2 3"],
    max_panels: int = 9,
) -> list[Figure]:
    """The map of each receiver in a panel, all with the same axes and colours.

    Args:
        gateways: Positions of all receivers by name [m]; empty if unknown.
        readings: x, y [m] and label [radio_map.unit] by receiver; at most 100 for each are drawn,
            evenly chosen.
        edges: Edges of walls [m]; edges on the floor are drawn.
        max_panels: Largest number of panels in a figure.
    """
    drawing = _Drawing.of(radio_map, gateways, readings, edges)
    _, lower, upper = _extent(radio_map, drawing.walls)
    width, height = upper - lower
    step = f"{drawing.scale.step:g} {_error_unit(radio_map.unit)}".strip()
    question = "Where do receivers hear a transmitter?"
    if radio_map.quantity.startswith("standard deviation"):
        question = "Where are predictions uncertain?"
    key = {}
    if gateways:
        key["receiver"] = _gateway_mark(np.zeros((2, 0)))
    if len(drawing.walls):
        key["walls and furniture"] = Line2D([], [], color="black", linewidth=0.9)
    if any(map(len, drawing.dots.values())):
        ring = {"markeredgecolor": "black", "markersize": 4, "color": GREY}
        key["test labels, in the map's colours"] = Line2D([], [], ls="", marker="o", **ring)
    figures = []
    with rc_context(STYLE):
        for names in even_pages(radio_map.receivers, max_panels):
            figure, axes = scaled_panels(len(names), width, height, "x [m]", "y [m]")
            for ax, name in zip(axes, names, strict=True):
                image = drawing.draw(ax, name)
            drawing.bar(figure, image, axes)
            if key:
                figure.legend(key.values(), key, loc="outside lower center", ncols=3)
            ask(figure, question, f"{_title(radio_map, len(gateways))}, a line every {step}")
            figures.append(figure)
    return figures


def plot_radio_map(
    result: RadioMap,
    ax: Any = None,
    receiver: str | int | None = None,
    deviation: bool = False,
    links: Links | None = None,
) -> Any:
    """Draws the level of a transmitter at each place, a panel for each receiver.

    Args:
        result: The radio map.
        ax: Axes for one receiver; None: a new figure.
        receiver: Name or index of the receiver; None: all receivers.
        deviation: True to draw the standard deviations instead of the values.
        links: Links whose receivers, walls and test labels are also drawn; or None.
    """
    floor = deviation_map(result) if deviation else result
    if receiver is not None:
        floor = floor.only(as_receivers(receiver, floor.receivers).reshape(-1).numpy())
    gateways, readings, edges = {}, {}, np.zeros((0, 2, 3), np.float32)
    if links is not None:
        gateways = {receiver.name: receiver.pose.position.numpy() for receiver in links.receivers}
        edges = links.edges.numpy()
        if not deviation and links.split is not None:
            test = links.split.test
            rows = torch.column_stack((links.query.transmitters[test, :2], links.labels[test]))
            receivers = links.query.receivers[test]
            readings = {name: rows[receivers == k].numpy() for k, name in enumerate(gateways)}
    if ax is None:
        figures = radio_maps(floor, gateways, readings, edges)
        axes = itertools.chain.from_iterable(figure.axes for figure in figures)
        return [ax for ax in axes if ax.get_label() != "<colorbar>"]
    if len(floor.receivers) > 1:
        names = ", ".join(floor.receivers[:5])
        raise ValueError(
            f"one ax shows one receiver of {names}\nname it by receiver=, or leave ax out"
        )
    drawing = _Drawing.of(floor, gateways, readings, edges)
    drawing.bar(ax.figure, drawing.draw(ax, floor.receivers[0]), [ax])
    ax.set(xlabel="x [m]", ylabel="y [m]")
    return ax


def _title(radio_map: RadioMap, receivers: int) -> str:
    """The sentence below a radio map: quantity, height, carrier and number of receivers."""
    carrier = "" if radio_map.frequency is None else f" at {radio_map.frequency / 1e9:.6g} GHz"
    place = f"z = {radio_map.height:.2f} m{carrier}"
    title = f"Predicted {radio_map.quantity} of a transmitter at {place}"
    count = len(radio_map.receivers)
    return title if count >= receivers else f"{title} at {count} of {receivers} receivers"


class _Extent(NamedTuple):
    """Extent of a map and of its panel [m]."""

    image: tuple  # left, right, bottom and top of the map with its outer pixels
    lower: Float[ndarray, "2"]  # ends of a panel
    upper: Float[ndarray, "2"]


def _extent(radio_map: RadioMap, walls: Float[ndarray, "s 2 2"]) -> _Extent:
    """The extent of a map, and of a panel with margins that includes the walls."""
    first_pixel = np.array((radio_map.x[0], radio_map.y[0]))  # centre of the pixel
    last_pixel = np.array((radio_map.x[-1], radio_map.y[-1]))
    rows, columns = radio_map.values.shape[1:]
    half_pixel = (last_pixel - first_pixel) / (np.array((columns, rows)) - 1) / 2
    left, bottom = first_pixel - half_pixel
    right, top = last_pixel + half_pixel
    corners = np.concatenate((((left, bottom), (right, top)), walls.reshape(-1, 2)))
    lower = corners.min(0)
    upper = corners.max(0)
    rim = 0.02 * (upper - lower).max()
    return _Extent((left, right, bottom, top), lower - rim, upper + rim)


class _Scale(NamedTuple):
    """A scale of colours, in the unit of the map."""

    low: float
    high: float
    step: float  # distance of two contours


def _scale(
    values: Float[ndarray, "..."], readings: Float[ndarray, " k"], error_unit: str
) -> _Scale:
    """A scale for the middle 98 % of map and readings, with round ends.

    Levels [dB] over more than 10 dB have ends at multiples of 5 dB, and a contour every 10 dB.
    """
    quantiles = [np.quantile(data, (0.01, 0.99)) for data in (values, readings) if data.size]
    low = np.concatenate(quantiles).min()
    high = np.concatenate(quantiles).max()
    # A flat map has no range: the scale's width then suits its values, or is 1.
    span = float(high - low) or float(abs(high)) or 1.0
    is_wide = error_unit == "dB" and span > 10
    multiple = 5 if is_wide else round_step(span, 20)
    contour_step = 10 if is_wide else round_step(span, 8)
    lower = multiple * np.floor(low / multiple)
    upper = multiple * (np.floor(high / multiple) + 1)  # above ``high`` also if that is a multiple
    return _Scale(lower, upper, contour_step)


def _levels(values: Float[ndarray, "rows columns"], scale: _Scale) -> Float[ndarray, " k"]:
    """Values of a map's contour lines: in its range, at most 20 beyond each end of the scale."""
    lowest = max(values.min(), scale.low - 20 * scale.step)
    highest = min(values.max(), scale.high + 20 * scale.step)
    first = np.floor(lowest / scale.step)
    last = np.ceil(highest / scale.step)
    levels = scale.step * np.arange(first, last + 1)
    return levels[(levels > lowest) & (levels < highest)]
