"""An attention U-Net with a pooling pyramid over images of rays x samples."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import adaptive_avg_pool2d, interpolate, max_pool2d, pad

DIVISOR = 4
"""Rays and samples of an image must be a multiple of it: they are halved twice."""


class Convolution(nn.Conv2d):
    """3 x 3 over rays and samples: the rays close a circle, and there is nothing before the first
    and last sample.
    """

    def __init__(self, inputs: int, outputs: int):
        super().__init__(inputs, outputs, 3)

    def forward(self, image: Float[Tensor, "n c rays samples"]) -> Tensor:
        return super().forward(pad(pad(image, (0, 0, 1, 1), mode="circular"), (1, 1, 0, 0)))


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
    """Means over the whole image and over its quarters join every place."""

    def __init__(self, width: int):
        super().__init__()
        self.levels = nn.ModuleList(nn.Conv2d(width, width // 2, 1) for _ in (1, 2))
        self.join = nn.Conv2d(width + 2 * (width // 2), width, 1)

    def forward(self, image: Float[Tensor, "n c rays samples"]) -> Tensor:
        means = [
            interpolate(level(adaptive_avg_pool2d(image, cells)), image.shape[2:], mode="bilinear")
            for cells, level in zip((1, 2), self.levels, strict=True)
        ]
        return self.join(torch.cat((image, *means), 1))


class Gate(nn.Module):
    """How much of the encoder's features passes at each place, as the decoder's ask for it."""

    def __init__(self, width: int):
        super().__init__()
        hidden = max(1, width // 2)
        self.ask = nn.Sequential(nn.Conv2d(width, hidden, 1), nn.BatchNorm2d(hidden))
        self.offer = nn.Sequential(nn.Conv2d(width, hidden, 1), nn.BatchNorm2d(hidden))
        self.weigh = nn.Sequential(
            nn.ReLU(), nn.Conv2d(hidden, 1, 1), nn.BatchNorm2d(1), nn.Sigmoid()
        )

    def forward(
        self, asked: Float[Tensor, "n c rays samples"], offered: Float[Tensor, "n c rays samples"]
    ) -> Tensor:
        return offered * self.weigh(self.ask(asked) + self.offer(offered))


class UNet(nn.Module):
    """Features of rays x samples -> as many numbers at each, seen in context.

    Args:
        inputs, outputs: Numbers at each sample.
        widths: Channels at full, half and quarter resolution.

    Source: NeRF-APT, 2025; Oktay et al., Attention U-Net, 2018; Zhao et al., Pyramid Scene Parsing
    Network, 2017.
    """

    def __init__(self, inputs: int, outputs: int, widths: list[int]):
        super().__init__()
        full, half, quarter = widths
        self.first = Convolution(inputs, full)
        self.rest = nn.Sequential(*after(full), Convolution(full, full), *after(full))
        self.down, self.bottom, self.pyramid = (
            Double(full, half),
            Double(half, quarter),
            Pyramid(quarter),
        )
        self.to_half, self.to_full = (
            nn.ConvTranspose2d(quarter, half, 2, 2),
            nn.ConvTranspose2d(half, full, 2, 2),
        )
        self.gate_half, self.gate_full = Gate(half), Gate(full)
        self.up_half, self.up_full = Double(2 * half, half), Double(2 * full, full)
        self.last = nn.Conv2d(full, outputs, 1)

    def forward(
        self,
        image: Float[Tensor, "n c rays samples"],
        shifts: Float[Tensor, "b full"] | None = None,
    ) -> Float[Tensor, "bn outputs rays samples"]:
        """One image after another.

        Args:
            image: Features, of one image or several.
            shifts: Part of the first convolution's output by inputs that are constant over an image
                and differ between links b. Each image is then seen b times, those of a link one
                after another.
        """
        full = self.first(image)
        if shifts is not None:
            full = (full + shifts[:, None, :, None, None]).flatten(0, 1)
        full = self.rest(full)
        half = self.down(max_pool2d(full, 2))
        quarter = self.pyramid(self.bottom(max_pool2d(half, 2)))
        asked = self.to_half(quarter)
        half = self.up_half(torch.cat((asked, self.gate_half(asked, half)), 1))
        asked = self.to_full(half)
        return self.last(self.up_full(torch.cat((asked, self.gate_full(asked, full)), 1)))
