"""The paper's loss of spectra: mean absolute error and structural similarity."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable

from gaigs.core.geometry import Directions, Grid
from gaigs.core.query import Batch
from gaigs.core.task import Task
from gaigs.core.task.spectrum import SSIM_WINDOW
from gaigs.registry import register


@register("loss", "l1_ssim")
class L1Ssim:
    """(1 - ssim) L_MAE + ssim (1 - SSIM) on the label's grid or a thinned one.

    The SSIM window has uniform weights. On the label's own grid its edge is 7 pixels, as in the
    reported score. On a thinned grid it covers about the same angle, at least 3 pixels.

    Args:
        task: Task of the labels, which has directions.
        ssim: Weight of the SSIM term, the paper's 1 - beta.

    Raises:
        ValueError: The weight is out of range, or the labels have no directions.

    Source: GAI-GS, "Results", eq. (15). The model, not the loss, has the paper's penalty on d_attn.
    """

    def __init__(self, task: Task, ssim: float = 0.2):
        if not 0 <= ssim <= 1:
            raise ValueError(f"loss.ssim must be in [0, 1], got {ssim}")
        if task.directions is None:
            raise ValueError(
                f"loss 'l1_ssim' compares spectra, not labels of task {task.name!r}; take another"
            )
        self.ssim = ssim
        self.pitch = task.directions.pitch  # [rad]

    def __call__(self, values: Tensor, batch: Batch) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss, and its terms ``l1`` and ``ssim``.

        Raises:
            ValueError: The batch's directions are a list without windows, or a grid below 3 x 3.
        """
        window = find_window("l1_ssim", batch.directions, self.pitch, SSIM_WINDOW)
        similarity = structural_similarity(values, batch.labels, window)
        terms = {"l1": (values - batch.labels).abs().mean(), "ssim": 1 - similarity}
        # eq. (15): beta L_MAE + (1 - beta) L_SSIM.
        return (1 - self.ssim) * terms["l1"] + self.ssim * terms["ssim"], terms


def find_window(loss: str, directions: Directions | None, pitch: float, pixels: int) -> int:
    """Odd edge of the SSIM window on a thinned grid [pixels], for the angle on the full grid.

    Args:
        loss: Name of the loss, for errors.
        directions: The thinned grid.
        pitch: Angle between neighbouring rows of the label's own grid [rad].
        pixels: Edge of the window on the label's own grid, odd.
    """
    if not isinstance(directions, Grid):
        raise ValueError(
            f"loss {loss!r} needs rows and columns; with training.thinning.rays set loss=absolute"
        )
    smallest = min(directions.shape)  # edge of the thinned grid [pixels]
    if smallest < 3:
        raise ValueError(f"loss {loss!r} needs at least 3 x 3 directions, got {directions.shape}")
    step = max(1, round(directions.pitch / pitch))  # pixels of the full grid in one of this
    same_angle = max(3, round((pixels - 1) / step / 2) * 2 + 1)  # the nearest odd number
    largest = (smallest - 1) // 2 * 2 + 1  # the largest odd number in the grid
    return min(same_angle, largest)


def structural_similarity(
    values: Float[Tensor, "b rows columns"], labels: Float[Tensor, "b rows columns"], window: int
) -> Float[Tensor, ""]:
    """Mean SSIM over all windows within the images.

    Weights are uniform, covariances divide by n - 1, and the data range is 1. With a window of 7 on
    the full grid this is scikit-image's SSIM, the reported score, with gradients.

    Args:
        values, labels: Spectra in [0, 1].
        window: Edge of the window [pixels].

    Source: Wang et al., Image Quality Assessment, 2004, eq. (13), with the constants 0.01² and
    0.03².

    Example:
        >>> from gaigs.splatting.loss.l1_ssim import structural_similarity
        >>> spectra = torch.rand(2, 18, 36)
        >>> structural_similarity(spectra, spectra, window=7)
        tensor(1.)
    """
    # Window means of values x, labels y, and their products. The means of labels alone need no
    # gradient.
    x, xx, xy = window_means(torch.stack((values, values.square(), values * labels)), window)
    y, yy = window_means(torch.stack((labels, labels.square())), window)
    unbiased = window**2 / (window**2 - 1)  # of a sample's covariance
    variances = unbiased * (xx - x.square() + yy - y.square())  # of values plus of labels
    covariance = unbiased * (xy - x * y)
    numerator = (2 * x * y + 0.01**2) * (2 * covariance + 0.03**2)
    denominator = (x.square() + y.square() + 0.01**2) * (variances + 0.03**2)
    return (numerator / denominator).mean()


def window_means(
    images: Float[Tensor, "*batch rows columns"], window: int
) -> Float[Tensor, "*batch r c"]:
    """Means over every square window within an image, equal to ``avg_pool2d`` with stride 1.

    On a CPU ``avg_pool2d`` adds window² pixels for each mean. This function adds whole images along
    rows, then columns, which is faster.
    """
    return _WindowMeans.apply(images, window)


class _WindowMeans(torch.autograd.Function):
    """``window_means`` with its gradient, which spreads the gradient of a mean over its window."""

    @staticmethod
    def forward(ctx, images, window):
        ctx.window = window
        for axis in (-1, -2):
            count = images.shape[axis] - window + 1  # windows along the axis
            total = images.narrow(axis, 0, count).clone()
            for first in range(1, window):
                total += images.narrow(axis, first, count)
            images = total
        return images.div_(window**2)

    @staticmethod
    @once_differentiable
    def backward(ctx, means_gradient):
        # Each pixel gets the sum of the gradients of the windows that contain it.
        gradient = means_gradient / ctx.window**2
        for axis in (-2, -1):
            count = gradient.shape[axis]
            shape = list(gradient.shape)
            shape[axis] += ctx.window - 1
            total = gradient.new_zeros(shape)
            for first in range(ctx.window):
                total.narrow(axis, first, count).add_(gradient)
            gradient = total
        return gradient, None
