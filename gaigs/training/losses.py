"""Training losses."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, huber_loss

from gaigs.data import Grid
from gaigs.model import Batch
from gaigs.training.metrics import SSIM_WINDOW

Terms = tuple[Tensor, dict[str, Tensor], dict[str, Tensor]]
"""The loss without penalties, its terms by name, and the model's penalties by name."""


class SpectrumLoss:
    """The paper's (1 - ssim) L_MAE + ssim L_SSIM, on every ``stride``-th row and column of the label, from a random one
    on: neighbouring pixels of a spectrum are far closer than the array resolves.

    Args:
        grid: Of the labels.
        stride: Rows and columns from one looked at to the next.
        ssim: Weight of the SSIM term, the paper's 1 - beta.

    Raises:
        ValueError: An option is out of range.

    Source: GAI-GS, "Results".
    """

    def __init__(self, grid: Grid, stride: int, ssim: float):
        coarsest = min(grid.shape) // 3  # which leaves the SSIM's smallest window
        if not 0 <= ssim <= 1:
            raise ValueError(f"training.loss.ssim must be in [0, 1], got {ssim}")
        if not 1 <= stride <= coarsest:
            raise ValueError(f"training.loss.stride must be in 1..{coarsest} for this grid, got {stride}")
        self.stride, self.ssim = stride, ssim

    def __call__(self, model: nn.Module, batch: Batch, generator: torch.Generator) -> Terms:
        """Of a model on a batch; the generator draws the first row and column."""
        row, column = torch.randint(self.stride, (2,), generator=generator).tolist()
        batch = batch.thin(slice(row, None, self.stride), slice(column, None, self.stride))
        prediction, penalties = model(batch)
        terms = spectrum_loss(prediction, batch.labels, self.stride)
        return (1 - self.ssim) * terms["l1"] + self.ssim * terms["ssim"], terms, penalties


class RssiLoss:
    """A mean over the errors in dB: their magnitude, their square, or Huber's blend of both.

    The magnitude is what the reported error averages, and robust: a reading that is far off pulls no harder than
    another.

    Args:
        kind: ``absolute``, ``squared`` or ``huber``, which is squared up to ``bend`` and absolute beyond.
        bend: Where Huber's loss turns [dB].
        jitter: Standard deviation by which each place is moved along each axis, anew in every step [m]. Places are not
            known to the centimetre and readings fade within a wavelength: what changes faster is not to be learnt.

    Raises:
        ValueError: An option is out of range.
    """

    def __init__(self, kind: str, bend: float, jitter: float):
        if kind not in ("absolute", "squared", "huber"):
            raise ValueError(f"training.loss.kind must be absolute, squared or huber, got {kind!r}")
        if not bend > 0:
            raise ValueError(f"training.loss.bend must be more than 0 dB, got {bend}")
        if not jitter >= 0:
            raise ValueError(f"training.loss.jitter must be at least 0 m, got {jitter}")
        self.kind, self.bend, self.jitter = kind, bend, jitter

    def __call__(self, model: nn.Module, batch: Batch, generator: torch.Generator) -> Terms:
        """Of a model on a batch; the generator draws by how much each place is moved."""
        if self.jitter:
            places, which = batch.transmitters.unique(dim=0, return_inverse=True)
            moves = self.jitter * torch.randn(places.shape, generator=generator).to(places)
            batch = replace(batch, transmitters=(places + moves)[which])
        prediction, penalties = model(batch)
        errors = prediction - batch.labels
        match self.kind:
            case "absolute":
                loss = errors.abs().mean()
            case "squared":
                loss = errors.square().mean()
            case "huber":
                loss = huber_loss(prediction, batch.labels, delta=self.bend)
        return loss, {"mae_db": errors.abs().mean()}, penalties


def spectrum_loss(
    predictions: Float[Tensor, "b rows columns"], labels: Float[Tensor, "b rows columns"], step: int = 1
) -> dict[str, Tensor]:
    """The two terms that the paper blends: mean absolute error, and 1 - SSIM.

    Args:
        predictions: Spectra.
        labels: Measured spectra, in [0, 1].
        step: Pixels of the full grid from one row or column to the next here. The uniform SSIM window spans the angle
            that the reported score's 7 pixels span there, though not less than 3 of these.

    Returns:
        ``l1`` and ``ssim``, scalars.

    Source: GAI-GS, "Results": L_MAE and L_SSIM.
    """
    window = max(3, round((SSIM_WINDOW - 1) / step / 2) * 2 + 1)
    similarity = structural_similarity(predictions, labels, window)
    return {"l1": (predictions - labels).abs().mean(), "ssim": 1 - similarity}


def structural_similarity(
    predictions: Float[Tensor, "b rows columns"], labels: Float[Tensor, "b rows columns"], window: int
) -> Float[Tensor, ""]:
    """Mean SSIM over all windows that lie within the image: uniform weights, sample covariances, data range 1.

    With a window of 7 on the full grid it is the reported score, scikit-image's; mean pooling makes it differentiable.
    torchmetrics' convolutions would take a quarter of a training step here, and leave five rows out at each border.

    Source: Wang et al., Image Quality Assessment, 2004, with the constants 0.01² and 0.03².
    """
    products = (predictions, labels, predictions.square(), labels.square(), predictions * labels)
    x, y, xx, yy, xy = avg_pool2d(torch.stack(products, 1), window, stride=1).unbind(1)
    unbiased = window**2 / (window**2 - 1)
    variances = unbiased * (xx - x.square() + yy - y.square())
    covariance = unbiased * (xy - x * y)
    numerator = (2 * x * y + 0.01**2) * (2 * covariance + 0.03**2)
    return (numerator / ((x.square() + y.square() + 0.01**2) * (variances + 0.03**2))).mean()
