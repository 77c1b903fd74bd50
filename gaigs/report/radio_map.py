"""Radio maps: predicted RSSI over the floor, with the walls, the gateways and what was measured."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patheffects import Normal, Stroke
from numpy import ndarray

from gaigs.radio_map import RadioMap
from gaigs.report.panels import pages, panels
from gaigs.report.style import GREY, ORANGE, STYLE

DOTS = 100
"""Most readings that are drawn in a panel; more would hide the map."""

CONTOUR = 10
"""Between the lines of equal RSSI [dB]."""


def radio_maps(
    radio_map: RadioMap,
    gateways: Mapping[str, Float[ndarray, "3"]],
    readings: Mapping[str, Float[ndarray, "k 3"]],
    edges: Float[ndarray, "k 2 3"],
) -> list[Figure]:
    """The map of each receiver in a panel, all to one scale and in the same colours.

    Args:
        radio_map: What to draw.
        gateways: Positions by name [m].
        readings: x, y [m] and RSSI [dBm] of what each receiver measured, by name; at most ``DOTS`` are drawn,
            evenly chosen in the order given.
        edges: Line segments of the room [m]; those on its floor are drawn.

    Returns:
        A figure for every ``PANELS`` receivers.
    """
    dots = {name: readings[name][:: -(-len(readings[name]) // DOTS) or 1] for name in radio_map.receivers}
    colours = {"cmap": "viridis"} | _limits(radio_map.values, np.concatenate([dot[:, 2] for dot in dots.values()]))
    levels = np.arange(-200, 50, CONTOUR)
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
                crossed = levels[(levels > values.min()) & (levels < values.max())]
                if len(crossed):
                    ax.contour(radio_map.x, radio_map.y, values, crossed, colors="white", linestyles="solid", **faint)
                lines = ax.add_collection(LineCollection(walls, colors="black", linewidths=0.9))
                lines.set_path_effects([Stroke(linewidth=1.8, foreground="white"), Normal()])
                x, y, rssi = dots[name].T
                ax.scatter(x, y, 9, rssi, edgecolors="white", linewidths=0.4, zorder=3, **colours)
                (gateway,) = ax.plot(*gateways[name][:2], "^", color=ORANGE, markersize=8, markeredgecolor="white")
                ax.set(xlim=(lower[0], upper[0]), ylim=(lower[1], upper[1]), title=name)
                ax.locator_params(nbins=5, steps=(1, 2, 5, 10))
            title = f"Predicted RSSI of a transmitter at z = {radio_map.height:.2f} m, a line every {CONTOUR} dB"
            figure.suptitle(title, size=8)
            figure.colorbar(image, ax=axes, label="RSSI [dBm]", aspect=30, shrink=0.7, extend="both")
            dot = Line2D([], [], linestyle="", marker="o", markersize=4, color=GREY)
            key = {"gateway": gateway, "test readings, in the map's colours": dot}
            figure.legend(key.values(), key, loc="outside lower center", ncols=2)
            figures.append(figure)
    return figures


def _limits(values: Float[ndarray, "..."], readings: Float[ndarray, "k"]) -> dict[str, float]:
    """Ends of the colour scale, multiples of 5 dB: what holds the middle 98 % of the map and of the readings."""
    quantiles = np.concatenate([np.quantile(part, (0.01, 0.99)) for part in (values, readings) if part.size])
    return {"vmin": 5 * np.floor(quantiles.min() / 5), "vmax": 5 * (np.floor(quantiles.max() / 5) + 1)}
