"""Pictures of predictions with their intervals."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Shaped
from matplotlib import rc_context
from matplotlib.axes import Axes
from numpy import ndarray

from gaigs.calibration import Estimate
from gaigs.core.query import as_receivers
from gaigs.core.task import Axis
from gaigs.core.task.scalar import with_unit
from gaigs.report.csi import decibels
from gaigs.report.spectrum import draw_plane, pixel_edges
from gaigs.report.style import BLUE, LINES, PAGE, STYLE, ask, new_figure


def plot_estimate(
    result: Estimate, ax: Any = None, receiver: str | int | None = None, place: int = 0
) -> Any:
    """Draws predictions with their intervals.

    Scalars are drawn for all places, in a colour for each receiver. A spectrum or a channel is
    drawn for one place, a channel at its strongest element.

    Args:
        result: Estimate of ``model.predict``.
        ax: Axes; None: a new figure.
        receiver: Name or index of the receiver; None: all receivers for scalars, otherwise the
            first.
        place: Number of the place, for a spectrum or a channel.
    """
    request = result.asked
    if request is None:
        raise ValueError("only estimates of model.predict know their places")
    kinds = {"": _draw_numbers, "elevation azimuth": _draw_spectrum}
    draw = (kinds | {"element subcarrier": _draw_channel}).get(" ".join(request.axes))
    if draw is None:
        raise ValueError(f"there is no picture of axes {', '.join(request.axes)}; use .to_xarray()")
    names = request.receivers if request.has_axis else np.array([""])
    chosen = np.arange(len(names))
    if receiver is not None and request.has_axis:
        chosen = as_receivers(receiver, names.tolist()).reshape(-1).numpy()
    rank = result.value.ndim - len(request.axes)  # number of axes of places and receivers
    count = math.prod(result.value.shape[:rank]) // len(names)  # of places
    if request.axes and not 0 <= place < count:
        raise ValueError(f"place must be from 0 to {count - 1}, got {place}")
    parts = {}
    for name in ("value", "std", "lower", "upper", "radius"):
        part = getattr(result, name)
        if part is not None:
            values = part.detach().cpu().numpy()
            values = values.reshape(-1, len(names), *values.shape[rank:])  # (places, receivers, …)
            values = values[:, chosen]
            parts[name] = values[place, 0] if request.axes else values
    with rc_context(STYLE):
        if ax is None:
            figure = new_figure(0.7 * PAGE, 0.45 * PAGE)
            ax = figure.subplots()
            ask(figure, "What is predicted, and how surely?")
        draw(ax, parts, request.axes, with_unit(request.quantity, request.unit), names[chosen])
    return ax


def _draw_numbers(
    ax: Axes, parts: Mapping[str, Shaped[ndarray, "n r"]], axes: Any, title: str, names: ndarray
) -> None:
    """Draws values (n, r) with their intervals by the number of the place."""
    x = np.arange(len(parts["value"]))
    for number, name in enumerate(names):
        values, low, high = (parts[part][:, number] for part in ("value", "lower", "upper"))
        shift = 0.5 * ((number + 0.5) / len(names) - 0.5)  # receivers beside each other
        colour, _ = LINES[number % len(LINES)]
        look = {"color": colour, "marker": "o", "markersize": 3, "linestyle": "", "label": name}
        ax.errorbar(x + shift, values, [values - low, high - values], linewidth=0.8, **look)
    ax.set(xlabel="number of the place", ylabel=title)
    ax.locator_params(axis="x", integer=True, min_n_ticks=1)
    ax.grid(axis="y")
    if any(names):
        ax.legend()


def _draw_spectrum(
    ax: Axes, parts: Mapping[str, ndarray], axes: Mapping[str, Axis], title: str, names: ndarray
) -> None:
    """Draws a spectrum, with the mean of its deviations in the title."""
    across = pixel_edges(axes["azimuth"].values, -np.inf, np.inf)
    up = pixel_edges(axes["elevation"].values, -90, 90)
    image = draw_plane(ax, across, up, parts["value"])
    ax.figure.colorbar(image, ax=ax, label=title or "normalised amplitude")
    deviation = np.nanmean(parts["std"])
    ax.set(xlabel="azimuth [deg]", ylabel="elevation [deg]", title=f"{names[0]} ± {deviation:.2g}")


def _draw_channel(
    ax: Axes, parts: Mapping[str, ndarray], axes: Mapping[str, Axis], title: str, names: ndarray
) -> None:
    """Draws a channel's magnitude over frequency at its strongest element, in dB.

    The interval of a complex value is a disc. The drawn band spans the magnitudes within it.
    ``parts`` has the values and the discs' radii (e, s), NaN at elements without a prediction.
    """
    element = int(np.nansum(abs(parts["value"]) ** 2, 1).argmax())
    value = abs(parts["value"][element])
    radius = parts["radius"][element]
    x = axes["subcarrier"].values / 1e6
    order = np.argsort(x)
    look = {"color": BLUE, "alpha": 0.25, "linewidth": 0, "label": "interval"}
    # The band ends 60 dB below the strongest subcarrier, as a disc with 0 has no lower end in dB.
    floor = value.max() / 1e3
    low = decibels((value - radius).clip(floor))
    high = decibels((value + radius).clip(floor))
    ax.fill_between(x[order], low[order], high[order], **look)
    ax.plot(x[order], decibels(value)[order], color=BLUE, label="prediction")
    name = " ".join(filter(None, (names[0], f"element {element + 1}")))
    ax.set(xlabel="frequency [MHz]", ylabel="|h| [dB]", title=name)
    ax.grid()
    ax.legend()
