"""Predicted against measured RSSI."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from matplotlib import rc_context
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from numpy import ndarray

from gaigs.report.panels import pages, panels
from gaigs.report.style import STYLE

CELL = 2
"""Width of the cells in which readings are counted [dB]."""

BEYOND = 40
"""How far outside the labels a prediction is still drawn in its place [dB]."""


def predicted_against_measured(
    labels: Float[ndarray, "t"],
    predictions: Float[ndarray, "t"],
    receiver: Int[ndarray, "t"],
    names: Sequence[str],
) -> list[Figure]:
    """How many test readings have which label and which prediction, one panel a receiver, all on the same axes.

    Args:
        labels: Measured [dBm].
        predictions: By the run's own model [dBm]; what lies more than ``BEYOND`` outside the labels is drawn there.
        receiver: Of each reading, an index into the names.
        names: Of the receivers; one without readings has no panel.

    Returns:
        A figure for every ``PANELS`` receivers.
    """
    errors = np.abs(predictions - labels)
    predictions = predictions.clip(labels.min() - BEYOND, labels.max() + BEYOND)
    heard = np.unique(receiver)
    lower = CELL * np.floor(min(labels.min(), predictions.min()) / CELL)
    upper = CELL * (np.floor(max(labels.max(), predictions.max()) / CELL) + 1)  # past a value on an edge
    cells = np.arange(lower, upper + CELL / 2, CELL)
    counts = [np.histogram2d(labels[receiver == r], predictions[receiver == r], (cells, cells))[0].T for r in heard]
    colours = LogNorm(1, max(2, max(count.max() for count in counts)))
    ticks = np.outer(10.0 ** np.arange(7), (1, 2, 5)).ravel()
    figures = []
    with rc_context(STYLE):
        for page in pages(len(heard)):
            figure, axes = panels(len(page), 1, 1, "measured RSSI [dBm]", "predicted RSSI [dBm]")
            for ax, panel in zip(axes, page, strict=True):
                count = np.ma.masked_equal(counts[panel], 0)
                image = ax.pcolormesh(cells, cells, count, cmap="viridis_r", norm=colours, rasterized=True)
                ax.axline((lower, lower), slope=1, color="0.3", linewidth=0.7)
                ax.set(xlim=(lower, upper), ylim=(lower, upper), aspect="equal")
                ax.set_title(f"{names[heard[panel]]}, MAE {errors[receiver == heard[panel]].mean():.2f} dB")
                ax.grid()
                ax.set_axisbelow(True)
            label = f"test readings in {CELL} dB × {CELL} dB"
            bar = figure.colorbar(image, ax=axes, label=label, format="{x:g}", aspect=30, shrink=0.7)
            bar.set_ticks(ticks[ticks <= colours.vmax])
            bar.minorticks_off()
            figures.append(figure)
    return figures
