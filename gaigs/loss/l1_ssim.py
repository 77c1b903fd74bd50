"""The paper's loss of spectra: mean absolute error and structural similarity."""

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.geometry import Directions, Grid
from gaigs.loss.windows import window_means
from gaigs.query import Batch
from gaigs.registry import register
from gaigs.task import Task
from gaigs.task.spectrum import SSIM_WINDOW


@register("loss", "l1_ssim")
class L1Ssim:
    """(1 - ssim) L_MAE + ssim (1 - SSIM) on the label's grid or a thinned one.

    The uniform SSIM window spans the same angle as the reported score's 7 pixels on the label's own grid, at least 3
    and at most all pixels of the thinned grid.

    Args:
        task: The labels' task, whose grid sets the window's angle.
        ssim: Weight of the SSIM term, the paper's 1 - beta.

    Raises:
        ValueError: The weight is out of range, or the labels have no grid.

    Source: GAI-GS, "Results": L_MAE and L_SSIM.
    """

    def __init__(self, task: Task, ssim: float = 0.2):
        if not 0 <= ssim <= 1:
            raise ValueError(f"loss.ssim must be in [0, 1], got {ssim}")
        if task.directions is None:
            raise ValueError(f"loss 'l1_ssim' compares spectra, labels of task {task.name!r} are not; choose another")
        self.ssim, self.pitch = ssim, task.directions.pitch

    def __call__(self, values: Float[Tensor, "b rows columns"], batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms ``l1`` and ``ssim``; see ``gaigs.loss.Loss``.

        Raises:
            ValueError: The batch's directions are a list, which has no windows, or fewer than 3 x 3.
        """
        window = find_window("l1_ssim", batch.directions, self.pitch, SSIM_WINDOW)
        similarity = structural_similarity(values, batch.labels, window)
        terms = {"l1": (values - batch.labels).abs().mean(), "ssim": 1 - similarity}
        return (1 - self.ssim) * terms["l1"] + self.ssim * terms["ssim"], terms


def find_window(loss: str, directions: Directions | None, pitch: float, pixels: int) -> int:
    """Edge [pixels] of the window on a thinned grid that spans the same angle as on the label's own grid.

    Args:
        loss: Name of the loss for errors.
        directions: The thinned grid.
        pitch: Angle between neighbouring rows of the label's own grid [rad].
        pixels: Edge on the label's own grid, odd.

    Raises:
        ValueError: The directions are no grid, or fewer than 3 x 3.
    """
    if not isinstance(directions, Grid):
        raise ValueError(
            f"loss {loss!r} needs rows and columns, and training.thinning.rays draws single directions; set "
            "loss=absolute or loss=squared"
        )
    smallest = min(directions.shape)
    if smallest < 3:
        raise ValueError(f"loss {loss!r} needs at least 3 x 3 directions, got {directions.shape}")
    step = max(1, round(directions.pitch / pitch))
    return min(max(3, round((pixels - 1) / step / 2) * 2 + 1), (smallest - 1) // 2 * 2 + 1)


def structural_similarity(
    values: Float[Tensor, "b rows columns"], labels: Float[Tensor, "b rows columns"], window: int
) -> Float[Tensor, ""]:
    """Mean SSIM over all windows within the image: uniform weights, sample covariances, data range 1.

    A window of 7 on the full grid gives the reported score, scikit-image's, with gradients. torchmetrics' convolutions
    take a quarter of a training step here, and leave out five rows at each border.

    Source: Wang et al., Image Quality Assessment, 2004, with the constants 0.01² and 0.03².
    """
    # The labels' means are separate, as they need no gradient.
    x, xx, xy = window_means(torch.stack((values, values.square(), values * labels)), window)
    y, yy = window_means(torch.stack((labels, labels.square())), window)
    unbiased = window**2 / (window**2 - 1)
    variances = unbiased * (xx - x.square() + yy - y.square())
    covariance = unbiased * (xy - x * y)
    numerator = (2 * x * y + 0.01**2) * (2 * covariance + 0.03**2)
    return (numerator / ((x.square() + y.square() + 0.01**2) * (variances + 0.03**2))).mean()
