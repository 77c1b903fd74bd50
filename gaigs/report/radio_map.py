"""Radio maps: what is predicted over the floor, with the walls, the receivers and what was measured."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke
from numpy import ndarray

from gaigs.radio_maps import RadioMap
from gaigs.report.panels import pages, panels
from gaigs.report.style import GREY, ORANGE, STYLE, round_step, with_unit

DOTS = 100
"""Most readings that are drawn in a panel; more would hide the map."""

ROUNDED_DB, CONTOUR_DB = 5, 10
"""What the ends of the colour scale are multiples of, and what is between two contours, where errors are in dB."""


def radio_maps(
    radio_map: RadioMap | Path | str,
    gateways: Mapping[str, Float[ndarray, "3"]],
    readings: Mapping[str, Float[ndarray, "k 3"]],
    edges: Float[ndarray, "k 2 3"],
    quantity: str = "RSSI",
    unit: str = "dBm",
    error_unit: str = "dB",
) -> list[Figure]:
    """The map of each receiver in a panel, all to one scale and in the same colours.

    Args:
        radio_map: What to draw, or the file that it was saved to.
        gateways: Positions of the receivers by name [m].
        readings: x, y [m] and label [unit] of what each receiver measured, by name; at most ``DOTS`` are drawn,
            evenly chosen in the order given.
        edges: Line segments of the room [m]; those on its floor are drawn.
        quantity: What a reading is.
        unit: Of a reading, as the map has it too; empty for a ratio.
        error_unit: Of a difference of readings.

    Returns:
        A figure for every ``PANELS`` receivers.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The map is in another unit than the readings.
    """
    radio_map = radio_map if isinstance(radio_map, RadioMap) else RadioMap.load(radio_map)
    if radio_map.unit != unit:
        raise ValueError(
            f"a radio map must be in the unit of the readings, {unit!r}, got one of {radio_map.quantity} in "
            f"{radio_map.unit!r}; make it anew with gaigs.radio_map"
        )
    dots = {name: readings[name][:: -(-len(readings[name]) // DOTS) or 1] for name in radio_map.receivers}
    limits, step = _scale(radio_map.values, np.concatenate([dot[:, 2] for dot in dots.values()]), error_unit)
    colours = {"cmap": "viridis"} | limits
    faint = {"linewidths": 0.4, "alpha": 0.5}
    walls = edges[(edges[..., 2] == edges[..., 2].min(initial=np.inf)).all(1)][..., :2]
    first, last = (np.array((radio_map.x[end], radio_map.y[end])) for end in (0, -1))
    half = (last - first) / (np.array(radio_map.values.shape[:0:-1]) - 1) / 2  # of a pixel
    (left, bottom), (right, top) = first - half, last + half
    corners = np.concatenate((((left, bottom), (right, top)), walls.reshape(-1, 2)))
    lower, upper = corners.min(0), corners.max(0)
    rim = 0.02 * (upper - lower).max()
    lower, upper = lower - rim, upper + rim
    place = {"origin": "lower", "extent": (left, right, bottom, top), "interpolation": "bilinear"}
    figures = []
    with rc_context(STYLE):
        for page in pages(len(radio_map.receivers)):
            figure, axes = panels(len(page), *(upper - lower), "x [m]", "y [m]")
            for ax, panel in zip(axes, page, strict=True):
                name, values = radio_map.receivers[panel], radio_map.values[panel]
                image = ax.imshow(values, **place, **colours)
                crossed = _levels(values, limits, step)
                if len(crossed):
                    ax.contour(radio_map.x, radio_map.y, values, crossed, colors="white", linestyles="solid", **faint)
                lines = ax.add_collection(LineCollection(walls, colors="black", linewidths=0.9))
                lines.set_path_effects([Stroke(linewidth=1.8, foreground="white"), Normal()])
                x, y, label = dots[name].T
                ax.scatter(x, y, 9, label, edgecolors="white", linewidths=0.4, zorder=3, **colours)
                (gateway,) = ax.plot(*gateways[name][:2], "^", color=ORANGE, markersize=8, markeredgecolor="white")
                ax.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), title=name)
                ax.locator_params(nbins=5, steps=(1, 2, 5, 10))
            carrier = "" if radio_map.frequency is None else f" at {radio_map.frequency / 1e9:.6g} GHz"
            between = f"{step:g} {error_unit}".strip()
            title = f"Predicted {quantity} of a transmitter at z = {radio_map.height:.2f} m{carrier}"
            figure.suptitle(f"{title}, a line every {between}", size=8)
            figure.colorbar(image, ax=axes, label=with_unit(quantity, unit), aspect=30, shrink=0.7, extend="both")
            dot = Line2D([], [], linestyle="", marker="o", markersize=4, color=GREY)
            key = {"receiver": gateway, "test readings, in the map's colours": dot}
            figure.legend(key.values(), key, loc="outside lower center", ncols=2)
            figures.append(figure)
    return figures


def _scale(
    values: Float[ndarray, "..."], readings: Float[ndarray, "k"], error_unit: str
) -> tuple[dict[str, float], float]:
    """Ends of the colour scale, round numbers about the middle 98 % of map and readings; what is between contours."""
    quantiles = np.concatenate([np.quantile(part, (0.01, 0.99)) for part in (values, readings) if part.size])
    low, high = quantiles.min(), quantiles.max()
    # A flat map has no range: the scale is then as wide as suits its size, or else 1.
    span = float(high - low) or float(abs(high)) or 1.0
    in_db = error_unit == "dB"
    rounded, contour = (ROUNDED_DB, CONTOUR_DB) if in_db else (round_step(span, 20), round_step(span, 8))
    return {"vmin": rounded * np.floor(low / rounded), "vmax": rounded * (np.floor(high / rounded) + 1)}, contour


def _levels(values: Float[ndarray, "rows columns"], limits: Mapping[str, float], step: float) -> Float[ndarray, "k"]:
    """Contours that cross a map, at most 20 beyond each end of the colour scale, however wild the map."""
    lowest = max(values.min(), limits["vmin"] - 20 * step)
    highest = min(values.max(), limits["vmax"] + 20 * step)
    levels = step * np.arange(np.floor(lowest / step), np.ceil(highest / step) + 1)
    return levels[(levels > lowest) & (levels < highest)]
