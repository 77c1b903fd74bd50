"""Predicted against measured values of one real number a link."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from matplotlib import rc_context
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy import ndarray

from gaigs.report.panels import pages, panels
from gaigs.report.style import STYLE, round_step, with_unit

CELL_DB = 2
"""Width of the cells in which readings are counted, where errors are in dB."""

CELLS = 40
"""Most cells that the range of the labels is divided into where errors are in another unit."""

BEYOND = 20
"""How many cells outside the labels a prediction is still drawn in its place."""


def predicted_against_measured(
    labels: Float[ndarray, "t"],
    predictions: Float[ndarray, "t"],
    receiver: Int[ndarray, "t"],
    names: Sequence[str],
    quantity: str = "RSSI",
    unit: str = "dBm",
    error_unit: str = "dB",
) -> list[Figure]:
    """How many test readings have which label and which prediction, one panel a receiver, all on the same axes.

    Args:
        labels: Measured [unit].
        predictions: By the run's own model [unit]; what lies more than ``BEYOND`` cells outside the labels is drawn
            there.
        receiver: Of each reading, an index into the names.
        names: Of the receivers; one without readings has no panel.
        quantity: What a label is.
        unit: Of a label; empty for a ratio.
        error_unit: Of a difference of labels.

    Returns:
        A figure for every ``PANELS`` receivers.
    """
    errors = np.abs(predictions - labels)
    cell = _cell(labels, error_unit)
    predictions = predictions.clip(labels.min() - BEYOND * cell, labels.max() + BEYOND * cell)
    heard = np.unique(receiver)
    # In numbers of cells, so that no rounding of the cells' edges leaves a reading out.
    across, up = labels / cell, predictions / cell
    lower = np.floor(min(across.min(), up.min()))
    upper = np.floor(max(across.max(), up.max())) + 1  # past a value on an edge
    edges = np.arange(lower, upper + 1)
    counts = [np.histogram2d(across[receiver == r], up[receiver == r], (edges, edges))[0].T for r in heard]
    colours = LogNorm(1, max(2, max(count.max() for count in counts)))
    ticks = np.outer(10.0 ** np.arange(7), (1, 2, 5)).ravel()
    size = f"{cell:g} {error_unit}".strip()
    cells, limits = cell * edges, (cell * lower, cell * upper)
    figures = []
    with rc_context(STYLE):
        for page in pages(len(heard)):
            axis = with_unit(quantity, unit)
            figure, axes = panels(len(page), 1, 1, f"measured {axis}", f"predicted {axis}")
            for ax, panel in zip(axes, page, strict=True):
                count = np.ma.masked_equal(counts[panel], 0)
                image = ax.pcolormesh(cells, cells, count, cmap="viridis_r", norm=colours, rasterized=True)
                ax.axline((limits[0], limits[0]), slope=1, color="0.3", linewidth=0.7)
                ax.set(xlim=limits, ylim=limits, aspect="equal")
                error = _written(errors[receiver == heard[panel]].mean(), error_unit)
                ax.set_title(f"{names[heard[panel]]}, MAE {error}")
                ax.grid()
                ax.set_axisbelow(True)
            bar = figure.colorbar(
                image, ax=axes, label=f"test readings in {size} × {size}", format="{x:g}", aspect=30, shrink=0.7
            )
            bar.set_ticks(ticks[ticks <= colours.vmax])
            bar.minorticks_off()
            figures.append(figure)
    return figures


def _cell(labels: Float[ndarray, "t"], error_unit: str) -> float:
    """Width of the cells [error_unit]."""
    if error_unit == "dB":
        return CELL_DB
    # Labels that are all alike have no range: a cell is as wide as suits their size, or else 1.
    return round_step(float(np.ptp(labels)) or float(np.abs(labels).max()) or 1.0, CELLS)


def _written(error: float, unit: str) -> str:
    """An error with its unit: hundredths of a dB, three digits of what may be of any size."""
    return f"{error:.2f} dB" if unit == "dB" else f"{error:#.3g} {unit}".strip()
