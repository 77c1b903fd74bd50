"""Figures of spatial spectra, over azimuth and elevation or as the sky above the array."""

from collections.abc import Mapping
from math import ceil
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from numpy import ndarray

from gaigs.core.task.spectrum import Spectrum
from gaigs.data import Links
from gaigs.report.curves import cdf
from gaigs.report.figures import TaskFigures
from gaigs.report.predictions import Examples, own_scores, read_examples, scores_of_systems
from gaigs.report.style import PAGE, STYLE, ask, new_figure, panels


class SpectrumFigures(TaskFigures):
    """Example spectra and the distribution of SSIM."""

    def of_run(self, task: Spectrum, folder: Path, links: Links) -> dict[str, Figure]:
        file = folder / "predictions.npz"
        shown = read_examples(file, "ssim")
        elevations = np.rad2deg(task.directions.elevations.numpy())
        azimuths = np.rad2deg(task.directions.azimuths.numpy())
        scores = own_scores(file, "ssim")
        return {
            "spectra": spectra(shown, elevations, azimuths),
            "spectra_polar": spectra(shown, elevations, azimuths, polar=True),
            "ssim_cdf": cdf(
                scores, "SSIM", "spectra", links.split.name, (None, 1), higher_is_better=True
            ),
        }

    def of_systems(
        self, task: type[Spectrum], files: Mapping[str, Path], split: str
    ) -> dict[str, Figure]:
        scores = scores_of_systems(files, "ssim")
        order = np.argsort(np.mean([scores[name] for name in files], 0))
        median = order[round(0.5 * (len(order) - 1))]
        predictions = {}
        for name, file in files.items():
            with np.load(file) as run:
                title = f"{name} {scores[name][median]:.3f}"
                predictions[title] = run["prediction"][median]
                label = run["labels"][median]
                elevations = np.rad2deg(run["elevations"])
                azimuths = np.rad2deg(run["azimuths"])
        shown = {"label": label} | predictions
        return {
            "cdf": cdf(scores, "SSIM", "spectra", split, (None, 1), higher_is_better=True),
            "spectra": side_by_side(shown, elevations, azimuths),
        }


def spectra(
    shown: Examples,
    elevations: Float[ndarray, " rows"],
    azimuths: Float[ndarray, " columns"],
    polar: bool = False,
) -> Figure:
    """Label, prediction and signed error over azimuth and elevation [deg], a row for each
    transmitter.

    A polar figure has the zenith in the middle. Amplitudes outside [0, 1] have the colour of the
    nearest bound.
    """
    labels = shown.labels.astype(np.float32)
    predictions = shown.predictions.astype(np.float32)
    errors = predictions - labels
    limit = float(np.abs(errors).max()) or 1.0  # a perfect prediction still needs a colour scale
    titles = {
        "Label": shown.names,
        "Prediction": [f"SSIM {score:.3f}" for score in shown.scores],
        "Error": [f"MAE {np.abs(error).mean():.3f}" for error in errors],
    }
    draw = _draw_sky if polar else draw_plane
    edges = pixel_edges(azimuths, -np.inf, np.inf), pixel_edges(elevations, -90, 90)
    with rc_context(STYLE):
        height = (2.2 if polar else 0.95) * len(labels) + 1.0
        figure = new_figure(PAGE, height)
        projection = {"projection": "polar"} if polar else {}
        axes = figure.subplots(len(labels), 3, squeeze=False, subplot_kw=projection)
        columns = zip(axes.T, titles, (labels, predictions, errors), strict=True)
        for column, name, values in columns:
            for ax, value, text in zip(column, values, titles[name], strict=True):
                image = draw(ax, *edges, value, limit if name == "Error" else None)
                ax.set_title(f"{name}, {text}")
        bar: dict[str, Any] = {"location": "bottom", "shrink": 0.7}
        amplitude = {"label": "normalised amplitude", "aspect": 45}
        figure.colorbar(axes[0, 0].collections[0], ax=axes[:, :2], **amplitude, **bar)
        figure.colorbar(image, ax=axes[:, 2], label="prediction − label", aspect=22, **bar)
        if not polar:
            for ax in axes.flat:
                ax.set(xlabel="azimuth [deg]", ylabel="elevation\n[deg]")
                ax.label_outer()
        ask(figure, "Are the right directions predicted?")
    return figure


def side_by_side(
    shown: Mapping[str, Float[ndarray, "rows columns"]],
    elevations: Float[ndarray, " rows"],
    azimuths: Float[ndarray, " columns"],
) -> Figure:
    """Spectra on one grid [deg], such as a label and several predictions, each with its title."""
    columns = min(4, len(shown))
    rows = ceil(len(shown) / columns)
    edges = pixel_edges(azimuths, -np.inf, np.inf), pixel_edges(elevations, -90, 90)
    with rc_context(STYLE):
        figure = new_figure(PAGE, 0.8 * rows + 1.0)
        axes = panels(figure, len(shown), columns, "azimuth [deg]", "elevation\n[deg]")
        for ax, (title, values) in zip(axes, shown.items(), strict=True):
            image = draw_plane(ax, *edges, values.astype(np.float32))
            ax.set_title(title)
        bar: dict[str, Any] = {"location": "bottom", "shrink": 0.5, "aspect": 45}
        figure.colorbar(image, ax=axes, label="normalised amplitude", **bar)
        ask(figure, "Which system predicts the right directions?")
    return figure


def pixel_edges(
    centres: Float[ndarray, " n"], lowest: float, highest: float
) -> Float[ndarray, " n+1"]:
    """Borders of the pixels: midpoints of their centres, and equally far outside the ends."""
    middle = (centres[1:] + centres[:-1]) / 2
    first = 2 * centres[0] - middle[0]
    last = 2 * centres[-1] - middle[-1]
    return np.concatenate(([first], middle, [last])).clip(lowest, highest)


def _colours(limit: float | None) -> dict[str, Any]:
    """Colours for amplitudes from 0 to 1, or for signed errors up to the limit if it is given."""
    if limit is None:
        return {"cmap": "viridis", "vmin": 0, "vmax": 1}
    return {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}


def draw_plane(
    ax: Axes,
    azimuths: Float[ndarray, " across"],
    elevations: Float[ndarray, " up"],
    values: Float[ndarray, "rows columns"],
    limit: float | None = None,
) -> QuadMesh:
    """Draws a spectrum, or errors of at most ``limit``, between edges of pixels [deg]."""
    image = ax.pcolormesh(azimuths, elevations, values, rasterized=True, **_colours(limit))
    ax.xaxis.set_major_locator(MultipleLocator(90))
    ax.yaxis.set_major_locator(MultipleLocator(30))
    ax.spines[:].set_visible(False)
    return image


def _draw_sky(
    ax: Axes,
    azimuths: Float[ndarray, " across"],
    elevations: Float[ndarray, " up"],
    values: Float[ndarray, "rows columns"],
    limit: float | None = None,
) -> QuadMesh:
    """Draws a spectrum as ``draw_plane``, but on polar axes with the zenith in the middle."""
    turns = np.deg2rad(azimuths)
    image = ax.pcolormesh(turns, 90 - elevations, values, rasterized=True, **_colours(limit))
    # The middle of the error's scale is white itself.
    ink = "white" if limit is None else "0.3"
    ax.set_ylim(0, 90 - elevations.min())
    ax.set_yticks((30, 60), ("60°", "30°"), color=ink, size=6)
    ax.set_xticks(np.deg2rad((0, 90, 180, 270)), ("0°", "90°", "180°", "270°"))
    ax.tick_params(pad=-2)
    ax.grid(color=ink, alpha=0.35, linewidth=0.4)
    ax.spines[:].set_visible(False)
    return image
