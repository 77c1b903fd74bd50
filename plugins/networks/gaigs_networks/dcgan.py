"""DCGAN: a generator draws labels by transposed convolutions, and a discriminator judges them."""

import math
from collections.abc import Mapping
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gaigs.core.query import Batch
from gaigs.core.scene import Scene
from gaigs_networks.network import BatchNorm, Network, check_widths

LAYERS = 4
"""Layers of generator and of discriminator, as published."""


class Dcgan(Network):
    """Noise and a link's numbers -> a small image of many channels -> twice as large in each of
    four layers -> label.

    An axis that is shorter than 16 pixels doubles in the last layers alone, so that one number a
    link is drawn by fully connected layers. Pixels beyond the label's last row and column are cut
    off. The discriminator goes the same way back, and is shown the link's numbers in every pixel. A
    prediction takes the noise's mean, 0.

    Args:
        scene: Receivers, task, box of the training transmitters.
        width: Channels of the largest images; each layer further in has twice as many.
        noise: Count of standard normal numbers that the generator gets beside the link's.
        octaves: Lowest and highest octave k of the transmitter's Fourier features, 2^k cycles a
            metre; None: those that the training transmitters can teach.
        pixel: Of the images that spectra are drawn in [deg].

    Raises:
        ValueError: An option is out of range.

    Source: Radford et al., Unsupervised Representation Learning with DCGANs, 2016; the baseline in
    GAI-GS, "Results".
    """

    learning_rates: Mapping[str, float] = {"network": 1e-3, "discriminator": 2e-4}

    trained_by = "adversarial"

    def __init__(
        self, scene: Scene, width: int, noise: int, octaves: tuple[int, int] | None, pixel: float
    ):
        super().__init__(scene, octaves, pixel)
        check_widths(width=width, noise=noise)
        self.noise = noise
        channels, *sizes = self.label.shape
        doublings = [min(LAYERS, (size - 1).bit_length()) for size in sizes]
        widths = [width * 2**k for k in reversed(range(LAYERS))]
        small = (
            widths[0],
            *(-(-size // 2**count) for size, count in zip(sizes, doublings, strict=True)),
        )
        features = self.question.width
        drawing = [nn.Linear(noise + features, math.prod(small)), nn.Unflatten(1, small)]
        judging = []
        for layer, (inner, outer) in enumerate(pairwise([*widths, channels])):
            strides = [2 if layer >= LAYERS - count else 1 for count in doublings]
            drawing += [BatchNorm(inner), nn.ReLU(), transposed(inner, outer, strides, sizes)]
            seen = outer if layer < LAYERS - 1 else outer + features
            judging = [convolution(seen, inner, strides, sizes), nn.LeakyReLU(0.2), *judging]
        self.generator = nn.Sequential(*drawing)
        verdict = (nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(widths[0], 1))
        self.discriminator = nn.Sequential(*judging, *verdict)

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Generator and discriminator."""
        return {
            "network": [*self.generator.parameters()],
            "discriminator": [*self.discriminator.parameters()],
        }

    def draw(self, features: Float[Tensor, "b width"]) -> Float[Tensor, "b channels rows columns"]:
        noise = features.new_zeros(len(features), self.noise)
        if self.training:
            noise.normal_()
        _, rows, columns = self.label.shape
        return self.generator(torch.cat((noise, features), 1))[..., :rows, :columns]

    def discriminate(self, batch: Batch, values: Tensor) -> Float[Tensor, " b"]:
        """A logit for each link, large where the discriminator takes the values for labels.

        Raises:
            ValueError: The values are those of single directions.
        """
        images = self.label.images(values, batch.directions)
        features = self.question(batch.query)[..., None, None].expand(-1, -1, *images.shape[2:])
        return self.discriminator(torch.cat((images, features), 1))[:, 0]


def transposed(inner: int, outer: int, strides: list[int], sizes: list[int]) -> nn.ConvTranspose2d:
    """A layer that multiplies the sides of an image by the strides."""
    kernels = [
        4 if stride == 2 else min(size, 3) // 2 * 2 + 1
        for stride, size in zip(strides, sizes, strict=True)
    ]
    return nn.ConvTranspose2d(
        inner, outer, kernels, strides, [(kernel - 1) // 2 for kernel in kernels]
    )


def convolution(outer: int, inner: int, strides: list[int], sizes: list[int]) -> nn.Conv2d:
    """A layer that divides them, rounded up: thinned labels have fewer pixels, though never less
    than one.
    """
    kernels = [min(size, 3) // 2 * 2 + 1 for size in sizes]
    return nn.Conv2d(outer, inner, kernels, strides, [kernel // 2 for kernel in kernels])
