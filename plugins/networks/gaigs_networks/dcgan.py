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
    """A generator: noise and a link's features -> a small image of many channels -> twice as large
    in each of four layers -> label.

    An axis that is shorter than 16 pixels doubles in the last layers alone, so that one number a
    link is drawn by fully connected layers. Pixels beyond the label's last row and column are cut
    off. The discriminator has the same layers in reverse, and gets the link's features in every
    pixel. A prediction takes the mean of the noise, 0.

    Args:
        scene: Receivers, task, box of the training transmitters.
        width: Channels of the largest images; each layer further in has twice as many.
        noise: Count of standard normal numbers that the generator gets beside the link's.
        octaves: Lowest and highest octave k of the transmitter's Fourier features, 2^k cycles a
            metre; None: those that the training transmitters can teach.
        pixel: Pixel of the images in which spectra are drawn [deg].

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
        # The first image, rounded up: halved as often as the axis doubles.
        small = [widths[0]]
        for size, count in zip(sizes, doublings, strict=True):
            small.append(-(-size // 2**count))
        features = self.question.width
        generator = [nn.Linear(noise + features, math.prod(small)), nn.Unflatten(1, tuple(small))]
        discriminator = []
        for layer, (inner, outer) in enumerate(pairwise([*widths, channels])):
            strides = [2 if layer >= LAYERS - count else 1 for count in doublings]
            generator += [BatchNorm(inner), nn.ReLU(), transposed(inner, outer, strides, sizes)]
            inputs = outer if layer < LAYERS - 1 else outer + features
            reverse = convolution(inputs, inner, strides, sizes)
            discriminator = [reverse, nn.LeakyReLU(0.2), *discriminator]
        self.generator = nn.Sequential(*generator)
        logit = (nn.AdaptiveAvgPool2d(1), nn.Flatten(), nn.Linear(widths[0], 1))
        self.discriminator = nn.Sequential(*discriminator, *logit)

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
            ValueError: The values are for single directions, which make no image.
        """
        images = self.label.images(values, batch.directions)
        features = self.question(batch.query)[..., None, None].expand(-1, -1, *images.shape[2:])
        return self.discriminator(torch.cat((images, features), 1))[:, 0]


def transposed(inner: int, outer: int, strides: list[int], sizes: list[int]) -> nn.ConvTranspose2d:
    """A layer from ``inner`` to ``outer`` channels that multiplies an image's sides by the strides.

    Args:
        sizes: Sides of the label, which bound the kernel.
    """
    kernels = []
    for stride, size in zip(strides, sizes, strict=True):
        kernels.append(4 if stride == 2 else min(size, 3) // 2 * 2 + 1)
    paddings = [(kernel - 1) // 2 for kernel in kernels]
    return nn.ConvTranspose2d(inner, outer, kernels, strides, paddings)


def convolution(outer: int, inner: int, strides: list[int], sizes: list[int]) -> nn.Conv2d:
    """The reverse of ``transposed``: a layer that divides an image's sides by the strides.

    Sides are rounded up, as thinned labels may have a single pixel.
    """
    kernels = [min(size, 3) // 2 * 2 + 1 for size in sizes]
    return nn.Conv2d(outer, inner, kernels, strides, [kernel // 2 for kernel in kernels])
