"""Training losses."""

from jaxtyping import Float
from torch import Tensor
from torchmetrics.functional.image import structural_similarity_index_measure

from gaigs.training.metrics import SSIM_WINDOW


def spectrum_loss(
    predictions: Float[Tensor, "b rows columns"], labels: Float[Tensor, "b rows columns"], step: int = 1
) -> dict[str, Tensor]:
    """The two terms that the paper blends: mean absolute error, and 1 - SSIM.

    Args:
        predictions: Spectra.
        labels: Measured spectra, in [0, 1].
        step: Pixels of the full grid from one row or column to the next here. The uniform SSIM window spans the angle that
            the reported score's 7 pixels span there, though not less than 3 of these.

    Returns:
        ``l1`` and ``ssim``, scalars.

    Source: GAI-GS, "Results": L_MAE and L_SSIM.
    """
    window = max(3, round((SSIM_WINDOW - 1) / step / 2) * 2 + 1)
    similarity = structural_similarity_index_measure(
        predictions[:, None], labels[:, None], gaussian_kernel=False, kernel_size=window, data_range=1.0
    )
    return {"l1": (predictions - labels).abs().mean(), "ssim": 1 - similarity}
