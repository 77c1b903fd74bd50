"""Figures of spatial spectra, over azimuth and elevation or as the sky above the array."""

from collections.abc import Mapping
from math import ceil
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from numpy import ndarray

from gaigs.core.task.spectrum import Spectrum
from gaigs.data import Links
from gaigs.report.curves import cdf
from gaigs.report.figures import Examples, TaskFigures, own_scores, read_examples, scores_of_systems
from gaigs.report.style import PAGE, STYLE

AMPLITUDE = {"cmap": "viridis", "vmin": 0, "vmax": 1}


class SpectrumFigures(TaskFigures):
    """Example spectra and the distribution of SSIM."""

    def of_run(self, task: Spectrum, folder: Path, links: Links) -> dict[str, Figure]:
        file = folder / "predictions.npz"
        shown = read_examples(file, "ssim")
        grid = task.directions
        elevations, azimuths = (
            np.rad2deg(angles.numpy()) for angles in (grid.elevations, grid.azimuths)
        )
        return {
            "spectra": spectra(shown, elevations, azimuths),
            "spectra_polar": spectra(shown, elevations, azimuths, polar=True),
            "ssim_cdf": cdf(
                own_scores(file, "ssim"), "SSIM", "spectra", links.split.name, (None, 1)
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
                predictions[title], label = run["prediction"][median], run["labels"][median]
                grid = [np.rad2deg(run[key]) for key in ("elevations", "azimuths")]
        return {
            "cdf": cdf(scores, "SSIM", "spectra", split, (None, 1)),
            "spectra": side_by_side({"label": label} | predictions, *grid),
        }


def spectra(
    shown: Examples,
    elevations: Float[ndarray, " rows"],
    azimuths: Float[ndarray, " columns"],
    polar: bool = False,
) -> Figure:
    """Label, prediction and signed error over azimuth and elevation [deg], one transmitter a row.

    A polar figure has the zenith in the middle. Amplitudes outside [0, 1] take the colour of the
    nearer end.
    """
    labels, predictions = shown.labels.astype(np.float32), shown.predictions.astype(np.float32)
    errors = predictions - labels
    limit = float(np.abs(errors).max()) or 1.0  # a perfect prediction still needs a colour scale
    difference = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
    columns = (
        (labels, AMPLITUDE, [f"Label, {name}" for name in shown.names]),
        (predictions, AMPLITUDE, [f"Prediction, SSIM {score:.3f}" for score in shown.scores]),
        (errors, difference, [f"Error, MAE {np.abs(error).mean():.3f}" for error in errors]),
    )
    draw = _draw_sky if polar else _draw_plane
    edges = _edges(azimuths, -np.inf, np.inf), _edges(elevations, -90, 90)
    with rc_context(STYLE):
        figure = Figure(
            figsize=(PAGE, (2.2 if polar else 0.95) * len(labels) + 0.75), layout="constrained"
        )
        axes = figure.subplots(
            len(labels), 3, squeeze=False, subplot_kw={"projection": "polar"} if polar else {}
        )
        for panels, (values, colours, titles) in zip(axes.T, columns, strict=True):
            for ax, value, title in zip(panels, values, titles, strict=True):
                image = draw(ax, *edges, value, colours)
                ax.set_title(title)
        bar = {"location": "bottom", "shrink": 0.7}
        figure.colorbar(
            axes[0, 0].collections[0],
            ax=axes[:, :2],
            label="normalised amplitude",
            aspect=45,
            **bar,
        )
        figure.colorbar(image, ax=axes[:, 2], label="prediction − label", aspect=22, **bar)
        if not polar:
            for ax in axes.flat:
                ax.label_outer()
    return figure


def side_by_side(
    panels: Mapping[str, Float[ndarray, "rows columns"]],
    elevations: Float[ndarray, " rows"],
    azimuths: Float[ndarray, " columns"],
) -> Figure:
    """Spectra by title on one grid [deg], e.g. a measured one and its predictions by several
    systems.
    """
    columns = min(4, len(panels))
    rows = ceil(len(panels) / columns)
    edges = _edges(azimuths, -np.inf, np.inf), _edges(elevations, -90, 90)
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, 0.8 * rows + 0.75), layout="constrained")
        axes = [*figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat]
        for ax in axes[len(panels) :]:
            ax.remove()
        axes = axes[: len(panels)]
        for index, (ax, (title, values)) in enumerate(zip(axes, panels.items(), strict=True)):
            image = _draw_plane(ax, *edges, values.astype(np.float32), AMPLITUDE)
            ax.set_title(title)
            ax.label_outer()
            if index + columns >= len(panels):  # the lowest panel of its column
                ax.set_xlabel("azimuth [deg]")
                ax.tick_params(labelbottom=True)
        figure.colorbar(
            image, ax=axes, label="normalised amplitude", location="bottom", shrink=0.5, aspect=45
        )
    return figure


def _edges(centres: Float[ndarray, " n"], lowest: float, highest: float) -> Float[ndarray, " n+1"]:
    """Borders of the pixels: half-way between their centres, and as far outside the first and the
    last.
    """
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
    ink = (
        "0.3" if colours["vmin"] < 0 else "white"
    )  # the middle of the error's scale is white itself
    ax.set_ylim(0, 90 - elevations.min())
    ax.set_yticks((30, 60), ("60°", "30°"), color=ink, size=6)
    ax.set_xticks(np.deg2rad((0, 90, 180, 270)), ("0°", "90°", "180°", "270°"))
    ax.tick_params(pad=-2)
    ax.grid(color=ink, alpha=0.35, linewidth=0.4)
    ax.spines[:].set_visible(False)
    return image
