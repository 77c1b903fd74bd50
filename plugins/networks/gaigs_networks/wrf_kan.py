"""WRF-KAN: Kolmogorov-Arnold layers, with a learnt function on each edge."""

import math
from collections.abc import Mapping
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import linear, silu

from gaigs.core.scene import Scene
from gaigs_networks.network import Network, check_widths

DEGREE = 3
"""Degree of the splines."""


class WrfKan(Network):
    """Kolmogorov-Arnold layers from a link's features to its label's image.

    Args:
        scene: Receivers, task, box of the training transmitters.
        widths: Widths between the layers.
        intervals: Number of intervals of each edge's spline.
        octaves: Lowest and highest octave k of the transmitter's Fourier features, 2^k cycles a
            metre; None: those that the training transmitters can teach.
        pixel: Pixel of the images in which spectra are drawn [deg].

    Raises:
        ValueError: An option is out of range.

    Source: WRF-KAN, arXiv 2601.11656; its layers are those of ``KanLayer``.
    """

    learning_rates: Mapping[str, float] = {"network": 3e-3}

    def __init__(
        self,
        scene: Scene,
        widths: list[int],
        intervals: int,
        octaves: tuple[int, int] | None,
        pixel: float,
    ):
        super().__init__(scene, octaves, pixel)
        check_widths(widths=widths, intervals=intervals)
        sizes = [self.question.width, *widths, math.prod(self.label.shape)]
        layers = [KanLayer(*pair, intervals) for pair in pairwise(sizes)]
        self.network = nn.Sequential(*layers, nn.Unflatten(1, self.label.shape))

    def draw(self, features: Float[Tensor, "b width"]) -> Float[Tensor, "b channels rows columns"]:
        return self.network(features)


class KanLayer(nn.Module):
    """A layer with a learnt function on each edge, from input i to output o:

        y_o = b_o + sum_i ( w_oi silu(x_i) + sum_k c_oik B_k(x_i) )

    B_k are cubic B-splines with even knots, some beyond [-1, 1], so that they add up to 1 within.
    Far outside there is the base branch, silu, alone.

    Args:
        inputs, outputs: Widths.
        intervals: Intervals between knots over [-1, 1]; there are ``intervals`` + 3 splines.

    Source: Liu et al., KAN: Kolmogorov-Arnold Networks, 2024, section 2.
    """

    def __init__(self, inputs: int, outputs: int, intervals: int):
        super().__init__()
        self.step = 2 / intervals
        centres = self.step * (torch.arange(intervals + DEGREE) - (DEGREE - 1) / 2) - 1
        self.register_buffer("centres", centres, persistent=False)
        self.base = nn.Linear(inputs, outputs)
        self.splines = nn.Parameter(torch.empty(outputs, inputs * len(centres)))
        # Small beside the base branch, at first.
        nn.init.normal_(self.splines, std=0.1 / math.sqrt(inputs))

    def forward(self, x: Float[Tensor, "b inputs"]) -> Float[Tensor, "b outputs"]:
        return self.base(silu(x)) + linear(self.basis(x).flatten(1), self.splines)

    def basis(self, x: Float[Tensor, "b inputs"]) -> Float[Tensor, "b inputs splines"]:
        """The value of every cubic B-spline.

        At the distance d from its centre [steps] it is (2 - d)³ / 6 - 2 (1 - d)³ / 3, where
        negative differences count as 0.
        """
        distances = ((x[..., None] - self.centres) / self.step).abs()
        outer = (2 - distances).clamp_min(0)
        inner = (1 - distances).clamp_min(0)
        return outer.pow(3) / 6 - inner.pow(3) * (2 / 3)
