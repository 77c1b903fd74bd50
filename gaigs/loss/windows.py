"""Means over windows, for structural similarity."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable


def window_means(images: Float[Tensor, "*batch rows columns"], window: int) -> Float[Tensor, "*batch r c"]:
    """Means over every square window within an image: a faster ``torch.nn.functional.avg_pool2d`` with stride 1.

    On a CPU ``avg_pool2d`` adds window² pixels for each mean; here whole images are added along rows, then columns.

    Args:
        images: At least ``window`` rows and columns.
        window: Edge of the window [pixels].

    Raises:
        RuntimeError: An image is smaller than the window.
    """
    return _WindowMeans.apply(images, window)


class _WindowMeans(torch.autograd.Function):
    @staticmethod
    def forward(ctx, images, window):
        ctx.window = window
        for axis in (-1, -2):
            count = images.shape[axis] - window + 1
            total = images.narrow(axis, 0, count).clone()
            for first in range(1, window):
                total += images.narrow(axis, first, count)
            images = total
        return images.div_(window**2)

    @staticmethod
    @once_differentiable
    def backward(ctx, of_means):
        gradient = of_means / ctx.window**2
        for axis in (-2, -1):
            count = gradient.shape[axis]
            shape = list(gradient.shape)
            shape[axis] += ctx.window - 1
            total = gradient.new_zeros(shape)
            for first in range(ctx.window):
                total.narrow(axis, first, count).add_(gradient)
            gradient = total
        return gradient, None
