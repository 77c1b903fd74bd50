"""GSRF's loss: three terms of spectra, one of levels."""

from torch import Tensor

from gaigs.core.query import Batch
from gaigs.core.task import Task
from gaigs.splatting.loss.l1_ssim import find_window, structural_similarity
from gaigs_gsrf.mean_amplitude import RANGE

WINDOW = 11
"""Edge of the SSIM window [pixels]."""

L1, SSIM, FOURIER = 0.44, 0.37, 0.19
"""Weights of the terms of spectra."""


class GsrfLoss:
    """Spectra: 0.44 L1 + 0.37 (1 - SSIM) + 0.19 Fourier. Levels: squared error of amplitudes.

    The SSIM window spans 11 pixels of the label's own grid; its weights are uniform, as in
    ``l1_ssim``. The Fourier term is the mean squared difference of unitary two-dimensional discrete
    Fourier transforms; by Parseval's theorem it is computed as the mean squared error.

    Args:
        task: Task of the labels.

    Raises:
        ValueError: The labels are complex: a loss of channels is not published.

    Source: GSRF (NeurIPS 2025).
    """

    def __init__(self, task: Task):
        if task.dtype.is_complex:
            raise ValueError(
                "loss 'gsrf' takes spectra or levels, got complex labels; take "
                "loss=log_relative_error"
            )
        self.directions = task.directions

    def __call__(self, values: Tensor, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms; see ``gaigs.splatting.loss.Loss``.

        Raises:
            ValueError: The batch has a list of directions, which has no windows, or fewer than
                3 x 3 of them.
        """
        errors = values - batch.labels
        if self.directions is None:
            squared = (errors / RANGE).square().mean()
            return squared, {"amplitude": squared}
        window = find_window("gsrf", batch.directions, self.directions.pitch, WINDOW)
        similarity = structural_similarity(values, batch.labels, window)
        terms = {
            "l1": errors.abs().mean(),
            "ssim": 1 - similarity,
            "fourier": errors.square().mean(),
        }
        return L1 * terms["l1"] + SSIM * terms["ssim"] + FOURIER * terms["fourier"], terms
