"""Training losses."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from gaigs.training.metrics import SSIM_WINDOW


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
