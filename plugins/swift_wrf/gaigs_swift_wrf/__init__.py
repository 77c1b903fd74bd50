"""SwiftWRF: 2-D Gaussians in a spectrum's plane, which a network deforms for each transmitter."""

import math
from collections.abc import Callable, Mapping

import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot, relu

from gaigs.core.geometry import to_spherical
from gaigs.core.query import Batch, Query
from gaigs.core.scene import Scene
from gaigs.model import Model, Prediction
from gaigs.splatting.deformation.two_branch import TokenLinear
from gaigs.splatting.gaussians import Tokens, fibonacci_lattice
from gaigs.splatting.tokenizer.euclidean import (
    BAND_FREQUENCIES,
    fourier_features,
    learnable_octaves,
)
from gaigs.splatting.tokenizer.euclidean import octaves as angular_frequencies
from gaigs_swift_wrf.plane import PlaneGaussians, add_up

PLANE_FREQUENCIES = 2.0 ** torch.arange(5)
"""Angular frequencies of the features of a Gaussian's place in the plane: periods from the whole
circle to 22.5 deg.
"""

LARGEST = 2**23
"""Triples of a link, a direction and a Gaussian that are worked on at a time without a gradient: 32
MiB an array.
"""


class SwiftWrf(Model):
    """Spectra as sums of 2-D Gaussians in the plane of azimuth and elevation, which a network
    deforms for each transmitter:

        s(u) = sum_i a_i exp(-(u - m_i)' C_i^-1 (u - m_i) / 2)    C_i = L_i L_i' + pixel variance

    without opacity, depth or order. Each receiver has Gaussians of its own: means m, lower
    triangular factors L and amplitudes a. A network adds to all three for each transmitter: [PE(m),
    PE(transmitter), receiver] -> layers of one width with ReLU -> a linear head each. The heads of
    means and factors start at 0. Gaussians start on a Fibonacci lattice over the label's
    directions, each as wide as its neighbours are away, and silent.

    Args:
        scene: Receivers and task; positions are taken relative to the middle of the transmitters'
            box.
        count: Number of Gaussians of each receiver.
        width, layers: Width and number of the network's layers.
        octaves: Lowest and highest octave k of the transmitter's Fourier features, 2^k cycles a
            metre; None takes those that the training transmitters can teach, as the ``euclidean``
            tokenizer does.

    Raises:
        ValueError: The labels are no spectra, or an option is out of range.

    Source: SwiftWRF (Liu et al., arXiv 2506.12787).
    """

    learning_rates: Mapping[str, float] = {
        **dict.fromkeys(PlaneGaussians._fields, 5e-3),  # means and factors in [rad]
        **Model.learning_rates,
    }

    def __init__(
        self, scene: Scene, count: int, width: int, layers: int, octaves: tuple[int, int] | None
    ):
        super().__init__(scene)
        grid = scene.task.directions
        if grid is None:
            raise ValueError(
                "model 'swift_wrf' lays its Gaussians in the plane of a spectrum, and labels of "
                f"task {scene.task.name!r} have no directions; take another model"
            )
        if not grid.pitch > 0:
            raise ValueError(
                "model 'swift_wrf' needs labels of two elevations or more, got "
                f"{tuple(grid.shape)} directions; take another model"
            )
        for option, number in (("count", count), ("width", width), ("layers", layers)):
            if number < 1:
                raise ValueError(f"model.{option} must be at least 1, got {number}")
        frequencies = angular_frequencies("model.octaves", *(octaves or learnable_octaves(scene)))
        self.pixel_variance = grid.pitch**2 / 12
        self.chunk = max(1, LARGEST // count)
        self.register_buffer("middle", (scene.lower + scene.upper) / 2)
        self.register_buffer("frequencies", frequencies)

        low, high = grid.elevations.min().item(), grid.elevations.max().item()
        azimuths, elevations, _ = to_spherical(fibonacci_lattice(count, low, high))
        pitch = math.sqrt(2 * math.pi * (math.sin(high) - math.sin(low)) / count)
        # Towards the pole a round Gaussian's azimuths span the whole circle.
        across = (pitch / elevations.cos()).clamp(max=math.pi)
        factors = torch.stack((across, torch.zeros(count), torch.full((count,), pitch)), -1)
        receivers = len(scene.receivers)
        self.means = nn.Parameter(torch.stack((azimuths, elevations), -1).repeat(receivers, 1, 1))
        self.factors = nn.Parameter(factors.repeat(receivers, 1, 1))
        self.amplitudes = nn.Parameter(torch.zeros(receivers, count))

        features = 3 * (1 + 2 * len(self.frequencies))
        if scene.has_band:
            features += 1 + 2 * len(BAND_FREQUENCIES)
        self.first = TokenLinear((receivers, 2 * (1 + 2 * len(PLANE_FREQUENCIES)), features), width)
        self.rest = nn.ModuleList(nn.Linear(width, width) for _ in range(layers - 1))
        sizes = {"means": 2, "factors": 3, "amplitudes": 1}
        self.heads = nn.ModuleDict({name: nn.Linear(width, size) for name, size in sizes.items()})
        for name in ("means", "factors"):
            nn.init.zeros_(self.heads[name].weight)
            nn.init.zeros_(self.heads[name].bias)

    def forward(self, batch: Batch) -> Prediction:
        directions = batch.directions or self.scene.task.directions
        gaussians = self.deform(batch.query)
        values = add_up(gaussians, directions.to(gaussians.means), self.pixel_variance)
        return Prediction(values, {})

    def deform(self, query: Query) -> PlaneGaussians:
        """The Gaussians of each link, with the network's changes."""
        means = self.means[query.receivers]  # (b, n, 2)
        factors = self.factors[query.receivers]  # (b, n, 3)
        amplitudes = self.amplitudes[query.receivers]  # (b, n)
        receivers = one_hot(query.receivers, len(self.scene.receivers)).to(self.middle)
        transmitters = fourier_features(query.transmitters - self.middle, self.frequencies)
        if self.scene.has_band:
            positions = self.scene.band_positions(query)[:, None]
            band = fourier_features(positions, BAND_FREQUENCIES.to(transmitters))
            transmitters = torch.cat((transmitters, band), 1)
        # Detached: the image alone moves the Gaussians, and not the network's use of their places.
        places = fourier_features(means.detach(), PLANE_FREQUENCIES.to(transmitters))
        hidden = relu(self.first(Tokens(receivers, places, transmitters)))
        for layer in self.rest:
            hidden = relu(layer(hidden))
        return PlaneGaussians(
            means + self.heads["means"](hidden),
            factors + self.heads["factors"](hidden),
            amplitudes + self.heads["amplitudes"](hidden)[..., 0],
        )

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        groups = {name: [getattr(self, name)] for name in PlaneGaussians._fields}
        return groups | {
            "network": [*self.first.parameters(), *self.rest.parameters(), *self.heads.parameters()]
        }

    def facts(self) -> dict[str, object]:
        """Number of Gaussians of all receivers together."""
        count = self.amplitudes.numel()
        return {"num_gaussians": count, "num_gaussians_start": count}

    def rendering(self, batch: Batch) -> Callable[[], Tensor]:
        """A function that sums the Gaussians up, without the network."""
        with torch.no_grad():
            gaussians = self.deform(batch.query)
        directions = (batch.directions or self.scene.task.directions).to(gaussians.means)
        return lambda: add_up(gaussians, directions, self.pixel_variance)
