"""All figures of a run."""

from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from gaigs.data import Links
from gaigs.gaussians import SH_DC, Gaussians
from gaigs.report.curves import loss_curves, read_curves, ssim_cdf
from gaigs.report.room import Cloud, room
from gaigs.report.spectra import spectra
from gaigs.report.style import DPI

EXAMPLES = {"10th percentile": 0.1, "median": 0.5, "90th percentile": 0.9}
"""Which spectra are shown, by their rank in SSIM."""


def write_figures(folder: Path, links: Links, gaussians: Gaussians | None) -> list[Path]:
    """Draws a run: its room, its losses, and for spectra some examples and how SSIM is distributed.

    Args:
        folder: Of the run. ``predictions.npz`` and, where the model was trained, ``log/*/metrics.csv`` are read from
            it; the figures go to ``figures/``.
        links: What the run was trained and tested on.
        gaussians: The Gaussians it learnt; None for a model without.

    Returns:
        The files, as PNG.

    Raises:
        FileNotFoundError: The labels are spectra and the folder holds no ``predictions.npz``.
    """
    figures = {"room": _room(links, gaussians)}
    if losses := sorted(folder.glob("log/*/metrics.csv"), key=lambda file: file.stat().st_mtime):
        figures["loss"] = loss_curves(read_curves(losses))
    if links.grid is not None:
        figures |= _spectra(folder / "predictions.npz", links)
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
        "ssim_cdf": ssim_cdf(scores, links.split.name),
    }


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
