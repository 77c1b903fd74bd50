"""Reported scores: of every test sample, and as the numbers that stand in a table."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Float
from skimage.metrics import structural_similarity
from torch import Tensor

from gaigs.data import Grid

SSIM_WINDOW = 7
"""Edge of scikit-image's default uniform window [pixels]."""


def spectrum_scores(
    labels: Float[Tensor, "k rows columns"], predictions: Float[Tensor, "k rows columns"]
) -> dict[str, Tensor]:
    """SSIM and mean absolute error of each predicted spectrum.

    SSIM is scikit-image's with its default window and ``data_range=1``, computed in float64; the training loss uses
    another window, so the two differ and bear different names.

    Args:
        labels: Measured spectra, amplitudes in [0, 1].
        predictions: Predicted spectra; values outside [0, 1] are scored as they are.

    Returns:
        ``ssim`` (k,) and ``mae`` (k,), float64, on the CPU.

    Raises:
        ValueError: The shapes differ, are not (k, rows, columns), are smaller than the SSIM window, or a value is not
            finite.

    Source: the protocol of GAI-GS, "Evaluation"; Wang et al., Image Quality Assessment, 2004.
    """
    if labels.ndim != 3 or labels.shape != predictions.shape:
        raise ValueError(
            f"labels and predictions must both be (k, rows, columns), got {tuple(labels.shape)} and "
            f"{tuple(predictions.shape)}; add a leading axis to a single spectrum"
        )
    if min(labels.shape[1:]) < SSIM_WINDOW:
        raise ValueError(
            f"SSIM needs spectra of at least {SSIM_WINDOW} x {SSIM_WINDOW} pixels, got {tuple(labels.shape[1:])}; "
            "use a finer grid"
        )
    for name, values in (("labels", labels), ("predictions", predictions)):
        broken = ~values.isfinite().flatten(1).all(1)
        if broken.any():
            raise ValueError(
                f"{name} must be finite, got NaN or infinity in {int(broken.sum())} of {len(values)} spectra, first in "
                f"number {int(broken.int().argmax())}; see whether the training diverged or the file is damaged"
            )
    labels, predictions = labels.detach().cpu().double(), predictions.detach().cpu().double()
    pairs = zip(labels.numpy(), predictions.numpy(), strict=True)
    ssim = [structural_similarity(label, prediction, data_range=1.0) for label, prediction in pairs]
    return {"ssim": torch.tensor(ssim, dtype=torch.float64), "mae": (labels - predictions).abs().mean((1, 2))}


def summarise_spectra(scores: dict[str, Tensor]) -> dict[str, float]:
    """The numbers of a table from the scores of ``spectrum_scores``.

    Returns:
        ``ssim_median``, ``ssim_mean``, ``ssim_p10``, ``ssim_p90`` (percentiles over the samples, linear interpolation)
        and ``mae``.

    Raises:
        ValueError: There is no sample.
    """
    ssim, mae = scores["ssim"], scores["mae"]
    _need_samples(ssim)
    p10, median, p90 = torch.quantile(ssim, ssim.new_tensor([0.1, 0.5, 0.9])).tolist()
    return {
        "ssim_median": median,
        "ssim_mean": ssim.mean().item(),
        "ssim_p10": p10,
        "ssim_p90": p90,
        "mae": mae.mean().item(),
    }


def rssi_scores(labels: Float[Tensor, "k"], predictions: Float[Tensor, "k"]) -> dict[str, Tensor]:
    """Absolute error of each predicted RSSI.

    Args:
        labels: Measured RSSI [dBm].
        predictions: Predicted RSSI [dBm].

    Returns:
        ``mae_db`` (k,) [dB], float64, on the CPU.

    Raises:
        ValueError: The shapes differ or are not (k,), or a value is not finite.
    """
    if labels.ndim != 1 or labels.shape != predictions.shape:
        raise ValueError(
            f"labels and predictions must both be (k,), got {tuple(labels.shape)} and {tuple(predictions.shape)}"
        )
    for name, values in (("labels", labels), ("predictions", predictions)):
        broken = ~values.isfinite()
        if broken.any():
            raise ValueError(
                f"{name} must be finite, got NaN or infinity in {int(broken.sum())} of {len(values)} readings, first "
                f"in number {int(broken.int().argmax())}; see whether the training diverged or the file is damaged"
            )
    return {"mae_db": (predictions.detach().cpu().double() - labels.detach().cpu().double()).abs()}


def summarise_rssi(scores: dict[str, Tensor]) -> dict[str, float]:
    """The numbers of a table from the scores of ``rssi_scores``.

    Returns:
        ``mae_db``, ``median_ae_db`` and ``rmse_db``: mean, median and root of the mean square of the absolute error.

    Raises:
        ValueError: There is no reading.
    """
    errors = scores["mae_db"]
    _need_samples(errors)
    return {
        "mae_db": errors.mean().item(),
        "median_ae_db": torch.quantile(errors, 0.5).item(),
        "rmse_db": errors.square().mean().sqrt().item(),
    }


def _need_samples(scores: Tensor) -> None:
    if not len(scores):
        raise ValueError("a summary needs at least one sample, got none; the split leaves nothing to test on")


class Scoring(NamedTuple):
    """How a kind of label is scored.

    Attributes:
        scores: Labels and predictions -> scores of every sample, by name.
        summarise: These scores -> the numbers of a table.
        watched: The score by whose mean over the validation links the best checkpoint is chosen.
        larger_is_better: Whether that is a similarity; else it is an error.
    """

    scores: Callable[[Tensor, Tensor], dict[str, Tensor]]
    summarise: Callable[[dict[str, Tensor]], dict[str, float]]
    watched: str
    larger_is_better: bool


def scoring(grid: Grid | None) -> Scoring:
    """How labels on a grid are scored, or without one RSSI."""
    if grid is None:
        return Scoring(rssi_scores, summarise_rssi, "mae_db", False)
    return Scoring(spectrum_scores, summarise_spectra, "ssim", True)
