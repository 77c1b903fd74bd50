"""All figures of a run."""

from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from gaigs.data import Links
from gaigs.gaussians import SH_DC, Gaussians
from gaigs.radio_map import RadioMap
from gaigs.report.curves import cdf, loss_curves, read_curves
from gaigs.report.radio_map import radio_maps
from gaigs.report.room import Cloud, room
from gaigs.report.rssi import predicted_against_measured
from gaigs.report.spectra import spectra
from gaigs.report.style import DPI

EXAMPLES = {"10th percentile": 0.1, "median": 0.5, "90th percentile": 0.9}
"""Which spectra are shown, by their rank in SSIM."""


def write_figures(folder: Path, links: Links, gaussians: Gaussians | None) -> list[Path]:
    """Draws a run: its room, its losses, how its score is distributed, and what it predicts.

    Args:
        folder: Of the run. ``predictions.npz``, for RSSI ``radio_map.npz`` and, where the model was trained,
            ``log/*/metrics.csv`` are read from it; the figures go to ``figures/``.
        links: What the run was trained and tested on.
        gaussians: The Gaussians it learnt; None for a model without.

    Returns:
        The files, as PNG.

    Raises:
        FileNotFoundError: The folder lacks ``predictions.npz``, or ``radio_map.npz`` where the labels are RSSI.
    """
    figures = {"room": _room(links, gaussians)}
    if losses := sorted(folder.glob("log/*/metrics.csv"), key=lambda file: file.stat().st_mtime):
        figures["loss"] = loss_curves(read_curves(losses))
    figures |= _rssi(folder, links) if links.grid is None else _spectra(folder / "predictions.npz", links)
    (folder / "figures").mkdir(exist_ok=True)
    files = {folder / "figures" / f"{name}.png": figure for name, figure in figures.items()}
    for file, figure in files.items():
        figure.savefig(file, dpi=DPI)
    return list(files)


def _spectra(path: Path, links: Links) -> dict[str, Figure]:
    with np.load(path) as run:
        scores = {name.removeprefix("ssim_"): run[name] for name in run.files if name.startswith("ssim_")}
        labels, predictions = run["labels"], run["prediction"]
    own = next(iter(scores.values()))
    order = np.argsort(own)
    names = {order[round(rank * (len(own) - 1))]: name for name, rank in EXAMPLES.items()}
    shown = list(names)
    grid = np.rad2deg(links.grid.elevations.numpy()), np.rad2deg(links.grid.azimuths.numpy())
    examples = labels[shown], predictions[shown], own[shown], list(names.values()), *grid
    return {
        "spectra": spectra(*examples),
        "spectra_polar": spectra(*examples, polar=True),
        "ssim_cdf": cdf(scores, "SSIM", "spectra", links.split.name, (None, 1)),
    }


def _rssi(folder: Path, links: Links) -> dict[str, Figure]:
    with np.load(folder / "predictions.npz") as run:
        errors = {name.removeprefix("error_"): abs(run[name]) for name in run.files if name.startswith("error_")}
        transmitters, receiver, labels, predictions = (
            run[name] for name in ("transmitters", "receiver", "labels", "prediction")
        )
    names = [receiver.name for receiver in links.receivers]
    readings = np.column_stack((transmitters[:, :2], labels))
    paged = {
        "predicted_against_measured": predicted_against_measured(labels, predictions, receiver, names),
        "radio_map": radio_maps(
            RadioMap.load(folder / "radio_map.npz"),
            {receiver.name: receiver.pose.position.numpy() for receiver in links.receivers},
            {name: readings[receiver == index] for index, name in enumerate(names)},
            links.edges.numpy(),
        ),
    }
    # The last hundredth would squeeze all others.
    furthest = max(np.quantile(error, 0.99) for error in errors.values()) or None
    figures = {"error_cdf": cdf(errors, "|error| [dB]", "readings", links.split.name, (0, furthest))}
    for name, drawn in paged.items():
        figures |= {name if page == 1 else f"{name}_{page}": figure for page, figure in enumerate(drawn, 1)}
    return figures


@torch.no_grad()
def _room(links: Links, gaussians: Gaussians | None) -> Figure:
    poses = [receiver.pose for receiver in links.receivers]
    rotations = np.stack([pose.rotation.numpy() for pose in poses])
    cloud = None
    if gaussians is not None:
        strengths = gaussians.opacities * SH_DC * gaussians.signal[..., 0].norm(dim=-1)
        cloud = Cloud(*(values.cpu().numpy() for values in (gaussians.means, gaussians.covariances, strengths)))
    return room(
        links.transmitters[links.split.train].numpy(),
        links.transmitters[links.split.test].numpy(),
        np.stack([pose.position.numpy() for pose in poses]),
        rotations if links.grid is not None else rotations[:0],
        links.edges.numpy(),
        cloud,
    )
