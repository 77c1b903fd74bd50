"""An attention U-Net with a pooling pyramid over images of rays x samples."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, interpolate, max_pool2d, pad

DIVISOR = 4
"""Rays and samples of an image must be a multiple of it: they are halved twice."""


class Convolution(nn.Conv2d):
    """A 3 x 3 convolution over rays, which close a circle, and samples, which are padded with 0."""

    def __init__(self, inputs: int, outputs: int):
        super().__init__(inputs, outputs, 3)

    def forward(self, image: Float[Tensor, "n c rays samples"]) -> Tensor:
        around = pad(image, (0, 0, 1, 1), mode="circular")
        return super().forward(pad(around, (1, 1, 0, 0)))


class Double(nn.Sequential):
    """Two convolutions, each normalised over the batch and through a leaky ReLU."""

    def __init__(self, inputs: int, width: int):
        super().__init__(
            Convolution(inputs, width), *after(width), Convolution(width, width), *after(width)
        )


def after(width: int) -> tuple[nn.Module, nn.Module]:
    """Normalisation and activation after a convolution."""
    return nn.BatchNorm2d(width), nn.LeakyReLU(inplace=True)


class Pyramid(nn.Module):
    """Adds to every place the means over the whole image and over its quarters."""

    def __init__(self, width: int):
        super().__init__()
        self.levels = nn.ModuleList(nn.Conv2d(width, width // 2, 1) for _ in (1, 2))
        self.join = nn.Conv2d(width + 2 * (width // 2), width, 1)

    def forward(self, image: Float[Tensor, "n c rays samples"]) -> Tensor:
        means = []
        for cells, level in zip((1, 2), self.levels, strict=True):
            small = level(adaptive_avg_pool2d(image, cells))  # (n, c / 2, cells, cells)
            means.append(interpolate(small, image.shape[2:], mode="bilinear"))
        return self.join(torch.cat((image, *means), 1))


class Gate(nn.Module):
    """An attention gate: the decoder's features decide how much of the encoder's passes."""

    def __init__(self, width: int):
        super().__init__()
        hidden = max(1, width // 2)
        self.ask = nn.Sequential(nn.Conv2d(width, hidden, 1), nn.BatchNorm2d(hidden))
        self.offer = nn.Sequential(nn.Conv2d(width, hidden, 1), nn.BatchNorm2d(hidden))
        self.weigh = nn.Sequential(
            nn.ReLU(), nn.Conv2d(hidden, 1, 1), nn.BatchNorm2d(1), nn.Sigmoid()
        )

    def forward(
        self, decoded: Float[Tensor, "n c rays samples"], encoded: Float[Tensor, "n c rays samples"]
    ) -> Tensor:
        return encoded * self.weigh(self.ask(decoded) + self.offer(encoded))


class UNet(nn.Module):
    """A network from features at rays x samples to numbers at them, with their context.

    Args:
        inputs, outputs: Count of numbers at each sample.
        widths: Channels at full, half and quarter resolution.

    Source: NeRF-APT, 2025; Oktay et al., Attention U-Net, 2018; Zhao et al., Pyramid Scene Parsing
    Network, 2017.
    """

    def __init__(self, inputs: int, outputs: int, widths: list[int]):
        super().__init__()
        full, half, quarter = widths
        self.first = Convolution(inputs, full)
        self.rest = nn.Sequential(*after(full), Convolution(full, full), *after(full))
        self.down = Double(full, half)
        self.bottom = Double(half, quarter)
        self.pyramid = Pyramid(quarter)
        self.to_half = nn.ConvTranspose2d(quarter, half, 2, 2)
        self.to_full = nn.ConvTranspose2d(half, full, 2, 2)
        self.gate_half = Gate(half)
        self.gate_full = Gate(full)
        self.up_half = Double(2 * half, half)
        self.up_full = Double(2 * full, full)
        self.last = nn.Conv2d(full, outputs, 1)

    def forward(
        self,
        image: Float[Tensor, "n c rays samples"],
        shifts: Float[Tensor, "b full"] | None = None,
    ) -> Float[Tensor, "bn outputs rays samples"]:
        """The outputs of all images.

        Args:
            image: Features of n images.
            shifts: Part of the first convolution's output that is constant over an image and
                differs between b links. The output then has b times n images, link by link.
        """
        full = self.first(image)
        if shifts is not None:
            full = (full + shifts[:, None, :, None, None]).flatten(0, 1)
        full = self.rest(full)
        half = self.down(max_pool2d(full, 2))
        quarter = self.pyramid(self.bottom(max_pool2d(half, 2)))
        decoded = self.to_half(quarter)
        half = self.up_half(torch.cat((decoded, self.gate_half(decoded, half)), 1))
        decoded = self.to_full(half)
        full = self.up_full(torch.cat((decoded, self.gate_full(decoded, full)), 1))
        return self.last(full)
