"""A multi-layer perceptron: the plainest network."""

import math
from collections.abc import Mapping
from itertools import pairwise

from jaxtyping import Float
from torch import Tensor, nn

from gaigs.core.scene import Scene
from gaigs_networks.network import BatchNorm, Network, check_widths


class Mlp(Network):
    """Hidden layers (linear, batch normalisation, leaky ReLU, dropout), then a linear head.

    Args:
        scene: Receivers, task, box of the training transmitters.
        widths: Widths of the hidden layers.
        dropout: Share of each hidden layer's numbers that a training step leaves out.
        octaves: Lowest and highest octave k of the transmitter's Fourier features, 2^k cycles a
            metre; None: those that the training transmitters can teach.
        pixel: Pixel of the images in which spectra are drawn [deg].

    Raises:
        ValueError: An option is out of range.

    Source: the baseline of that name in GAI-GS, "Results".
    """

    learning_rates: Mapping[str, float] = {"network": 3e-3}

    def __init__(
        self,
        scene: Scene,
        widths: list[int],
        dropout: float,
        octaves: tuple[int, int] | None,
        pixel: float,
    ):
        super().__init__(scene, octaves, pixel)
        check_widths(widths=widths)
        if not 0 <= dropout < 1:
            raise ValueError(f"model.dropout must be in [0, 1), got {dropout}")
        hidden = []
        for before, width in pairwise([self.question.width, *widths]):
            hidden += [
                nn.Linear(before, width),
                BatchNorm(width),
                nn.LeakyReLU(),
                nn.Dropout(dropout),
            ]
        shape = self.label.shape
        self.network = nn.Sequential(
            *hidden, nn.Linear(widths[-1], math.prod(shape)), nn.Unflatten(1, shape)
        )

    def draw(self, features: Float[Tensor, "b width"]) -> Float[Tensor, "b channels rows columns"]:
        return self.network(features)
