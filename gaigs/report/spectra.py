"""Spatial spectra beside their predictions, over azimuth and elevation or as the sky above the array."""

from collections.abc import Mapping, Sequence
from math import ceil

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from numpy import ndarray

from gaigs.report.style import PAGE, STYLE

ACROSS = 4
"""Most panels side by side of one spectrum and its predictions."""


def spectra(
    labels: Float[ndarray, "k rows columns"],
    predictions: Float[ndarray, "k rows columns"],
    ssim: Float[ndarray, "k"],
    names: Sequence[str],
    elevations: Float[ndarray, "rows"],
    azimuths: Float[ndarray, "columns"],
    polar: bool = False,
) -> Figure:
    """Label, prediction and signed error, one transmitter a row.

    Args:
        labels: Measured spectra, amplitudes in [0, 1].
        predictions: Predicted spectra; values outside [0, 1] take the colour of the nearer end.
        ssim: Score of each prediction.
        names: What to call each row.
        elevations: Of the rows [deg].
        azimuths: Of the columns [deg].
        polar: The zenith in the middle and azimuth around it, instead of azimuth across and elevation upwards.
    """
    labels, predictions = labels.astype(np.float32), predictions.astype(np.float32)
    errors = predictions - labels
    limit = float(np.abs(errors).max()) or 1.0  # a perfect prediction still needs a colour scale
    amplitude = {"cmap": "viridis", "vmin": 0, "vmax": 1}
    signed = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
    columns = (
        (labels, amplitude, [f"Label, {name}" for name in names]),
        (predictions, amplitude, [f"Prediction, SSIM {score:.3f}" for score in ssim]),
        (errors, signed, [f"Error, MAE {np.abs(error).mean():.3f}" for error in errors]),
    )
    draw = _draw_sky if polar else _draw_plane
    edges = _edges(azimuths, -np.inf, np.inf), _edges(elevations, -90, 90)
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, (2.2 if polar else 0.95) * len(labels) + 0.75), layout="constrained")
        axes = figure.subplots(len(labels), 3, squeeze=False, subplot_kw={"projection": "polar"} if polar else {})
        for panels, (values, colours, titles) in zip(axes.T, columns, strict=True):
            images = [draw(ax, *edges, value, colours) for ax, value in zip(panels, values, strict=True)]
            for ax, title in zip(panels, titles, strict=True):
                ax.set_title(title)
        bar = {"location": "bottom", "shrink": 0.7}
        figure.colorbar(axes[0, 0].collections[0], ax=axes[:, :2], label="normalised amplitude", aspect=45, **bar)
        figure.colorbar(images[0], ax=axes[:, 2], label="prediction − label", aspect=22, **bar)
        if not polar:
            for ax in axes.flat:
                ax.label_outer()
    return figure


def side_by_side(
    label: Float[ndarray, "rows columns"],
    predictions: Mapping[str, Float[ndarray, "rows columns"]],
    ssim: Mapping[str, float],
    elevations: Float[ndarray, "rows"],
    azimuths: Float[ndarray, "columns"],
) -> Figure:
    """One measured spectrum and what systems predict in its place.

    Args:
        label: The measured spectrum, amplitudes in [0, 1].
        predictions: By system; values outside [0, 1] take the colour of the nearer end.
        ssim: Score of each.
        elevations: Of the rows [deg].
        azimuths: Of the columns [deg].
    """
    panels = {"label": label} | {f"{name} {ssim[name]:.3f}": values for name, values in predictions.items()}
    columns = min(ACROSS, len(panels))
    rows = ceil(len(panels) / columns)
    colours = {"cmap": "viridis", "vmin": 0, "vmax": 1}
    edges = _edges(azimuths, -np.inf, np.inf), _edges(elevations, -90, 90)
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, 0.8 * rows + 0.75), layout="constrained")
        axes = [*figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat]
        for ax in axes[len(panels) :]:
            ax.remove()
        axes = axes[: len(panels)]
        for index, (ax, (title, values)) in enumerate(zip(axes, panels.items(), strict=True)):
            image = _draw_plane(ax, *edges, values.astype(np.float32), colours)
            ax.set_title(title)
            ax.label_outer()
            if index + columns >= len(panels):  # nothing below it
                ax.set_xlabel("azimuth [deg]")
                ax.tick_params(labelbottom=True)
        figure.colorbar(image, ax=axes, label="normalised amplitude", location="bottom", shrink=0.5, aspect=45)
    return figure


def _edges(centres: Float[ndarray, "n"], lowest: float, highest: float) -> Float[ndarray, "n+1"]:
    """Borders of the pixels: half-way between their centres, and as far outside the first and the last."""
    middle = (centres[1:] + centres[:-1]) / 2
    ends = 2 * centres[0] - middle[0], 2 * centres[-1] - middle[-1]
    return np.concatenate((ends[:1], middle, ends[1:])).clip(lowest, highest)


def _draw_plane(ax: Axes, azimuths, elevations, values, colours):
    image = ax.pcolormesh(azimuths, elevations, values, rasterized=True, **colours)
    ax.set(xlabel="azimuth [deg]", ylabel="elevation\n[deg]")
    ax.xaxis.set_major_locator(MultipleLocator(90))
    ax.yaxis.set_major_locator(MultipleLocator(30))
    ax.spines[:].set_visible(False)
    return image


def _draw_sky(ax: Axes, azimuths, elevations, values, colours):
    image = ax.pcolormesh(np.deg2rad(azimuths), 90 - elevations, values, rasterized=True, **colours)
    ink = "0.3" if colours["vmin"] < 0 else "white"  # the middle of the error's scale is white itself
    ax.set_ylim(0, 90 - elevations.min())
    ax.set_yticks((30, 60), ("60°", "30°"), color=ink, size=6)
    ax.set_xticks(np.deg2rad((0, 90, 180, 270)), ("0°", "90°", "180°", "270°"))
    ax.tick_params(pad=-2)
    ax.grid(color=ink, alpha=0.35, linewidth=0.4)
    ax.spines[:].set_visible(False)
    return image
