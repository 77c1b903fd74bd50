"""Figures of located transmitters."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy import ndarray
from scipy.ndimage import gaussian_filter
from torch import Tensor

from gaigs.commands.locate.location import Location
from gaigs.core.query import evenly
from gaigs.report import style


class Cells(NamedTuple):
    """Square cells of a map from above, and places to count in them."""

    # Their edges [m].
    x: Float[ndarray, " columns1"]
    y: Float[ndarray, " rows1"]
    places: Float[ndarray, "g 2"]  # places on the map [m]

    def sums(self, weights: Float[ndarray, " g"]) -> Float[ndarray, "rows columns"]:
        """Sum of the weights of the places in each cell."""
        x, y = self.places.T
        counted, _, _ = np.histogram2d(x, y, [self.x, self.y], weights=weights)
        return counted.T

    @classmethod
    def around(cls, places: Float[ndarray, "g 2"], most: int = 1500) -> "Cells":
        """Square cells, about ``most`` of them, that hold almost all places."""
        low, high = np.quantile(places, (0.001, 0.999), 0)
        extent = high - low
        # The map of a corridor has at least 15 % of its length as its width.
        margin = np.maximum(0, 0.15 * (extent.max() or 1.0) - extent) / 2
        low, high = low - margin, high + margin
        # At least eight candidates a cell on average, so that their sums vary little.
        pitch = math.sqrt((high - low).prod() / min(most, len(places) / 8))  # edge of a cell [m]
        x = np.arange(low[0], high[0] + pitch, pitch)
        y = np.arange(low[1], high[1] + pitch, pitch)
        return cls(x, y, places)


def posterior_figure(location: Location, level: float | None = None) -> Figure:
    """Map of the transmitters from above: the probability of cells."""
    with rc_context(style.STYLE):
        drawn = style.new_figure(0.6 * style.PAGE, 0.66 * style.PAGE, "compressed")
        axis = drawn.subplots()
        draw_posterior(
            axis, location, "region" if level is None else f"region of {100 * level:g} %"
        )
        drawn.legend(loc="outside lower left", ncols=3)
        is_one = len(location.mean) == 1
        style.ask(drawn, "Where is the transmitter?" if is_one else "Where are the transmitters?")
    return drawn


def draw_posterior(axis: Axes, location: Location, label: str) -> None:
    """Draws the probability of cells; for a single transmission also its region with ``label``."""
    cells = Cells.around(location.places[:, :2].double().numpy())
    probabilities = location.probabilities.mean(0).double().numpy()  # mean over transmissions
    # Smooth over neighbouring cells: they hold different numbers of candidates.
    chances = gaussian_filter(cells.sums(probabilities), 1)
    image = axis.pcolormesh(cells.x, cells.y, 100 * chances, cmap="Blues", rasterized=True)
    title = "probability of a cell [%]"
    axis.figure.colorbar(image, ax=axis, location="bottom", shrink=0.7, aspect=30, label=title)
    x, y = location.mean[:, :2].T.numpy()
    axis.plot(x, y, "o", markersize=4, color=style.ORANGE, markeredgecolor="white", label="mean")
    if len(location.mean) == 1:
        outline(axis, cells, location, label)
    axis.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")


def plot_location(result: Location, ax: Any = None) -> Any:
    """Draws a map of the transmitters from above, on ``ax`` or in a new figure."""
    if ax is None:
        return posterior_figure(result).axes[:1]
    draw_posterior(ax, result, "region")
    ax.legend()
    return ax


def outline(axis: Axes, cells: Cells, location: Location, label: str) -> None:
    """Draws the outline of the region of a single transmission, named ``label`` in the legend."""
    counts = cells.sums(location.region[0].double().numpy())
    # A smooth outline around cells with a candidate of the region.
    inside = gaussian_filter((counts > 0).astype(float), 1)
    x = (cells.x[1:] + cells.x[:-1]) / 2
    y = (cells.y[1:] + cells.y[:-1]) / 2
    axis.contour(x, y, inside, [0.3 * inside.max()], colors=style.GREY, linewidths=0.8)
    axis.plot([], [], color=style.GREY, lw=0.8, label=label)  # a contour has no legend entry


def error_figure(
    truth: Float[Tensor, "n 3"],
    mean: Float[Tensor, "n 3"],
    known: Float[Tensor, "k 3"],
    errors: Mapping[str, Float[Tensor, " n"]],
    most: int = 150,
) -> Figure:
    """Map of transmitters and their estimates, and cumulative distribution of errors.

    Args:
        truth: Places of the transmitters [m].
        mean: Estimated mean places [m].
        known: Known places [m].
        errors: Errors by name of the estimate, with "mean" and "knn" [m].
        most: Largest number of transmitters on the map.
    """
    with rc_context(style.STYLE):
        drawn = style.new_figure(style.PAGE, 0.52 * style.PAGE, "compressed")
        above, shares = drawn.subplots(1, 2)
        chosen = evenly(torch.arange(len(truth)), most)
        dots = {"color": style.GREY, "markersize": 1.5, "label": "known places"}
        above.plot(*known[:, :2].T.numpy(), "o", **dots)
        lines = torch.stack((truth[chosen], mean[chosen]))  # (2, n, 3)
        x, y = lines[..., :2].permute(2, 0, 1).numpy()
        above.plot(x, y, color=style.ORANGE, lw=0.6)
        above.plot(x[0], y[0], "o", markersize=3, color=style.BLUE, label="transmitters")
        above.plot(x[1], y[1], "o", markersize=3, color=style.ORANGE, label="estimates")
        above.set(aspect="equal", xlabel="x [m]", ylabel="y [m]")

        fractions = ((torch.arange(len(truth)) + 0.5) / len(truth)).numpy()
        knn_colour, _ = style.looks(["knn"])["knn"]
        sorted_errors = {name: errors[name].sort().values.numpy() for name in ("mean", "knn")}
        shares.plot(sorted_errors["mean"], fractions, color=style.ORANGE, label="estimates")
        shares.plot(sorted_errors["knn"], fractions, color=knn_colour, label="nearest neighbours")
        shares.set(xlabel="error [m]", ylabel="share of transmitters", ylim=(0, 1), xlim=(0, None))
        shares.grid()
        shares.set_axisbelow(True)
        shares.legend(loc="lower right")
        drawn.legend(*above.get_legend_handles_labels(), loc="outside lower left", ncols=3)
        style.ask(drawn, "How far off are located transmitters?")
    return drawn
