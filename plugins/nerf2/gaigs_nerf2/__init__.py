"""NeRF²: a radiance field of radio waves, two networks along rays from the receivers."""

import math
from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import leaky_relu, linear, relu

from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.splatting.tokenizer.euclidean import fourier_features
from gaigs_nerf2.marching import RayMarching, Samples, check_octaves, render

__all__ = ["Nerf2", "RayMarching", "Samples", "amplitudes_and_phases", "render"]


class Nerf2(RayMarching):
    """Two networks: place -> attenuation and a feature; feature, direction and transmitter -> the
    field sent along the ray.

    The first network's input joins its layers again halfway. The second has a layer of ``width``
    and one of half of it.

    Args:
        scene: Receivers, task, carrier.
        samples, far, rays, frequency: See ``RayMarching``.
        octaves: Number of the features sin 2^k x and cos 2^k x of positions [m] and directions, k
            from 0.
        width, layers: Width and number of the first network's layers.

    Raises:
        ValueError: See ``RayMarching``.

    Source: NeRF², 2023.
    """

    # Published: 8e-4, falling as a cosine over 30,000 steps.
    learning_rates: Mapping[str, float] = {"network": 2e-3}

    def __init__(
        self,
        scene: Scene,
        samples: int,
        far: float | None,
        rays: list[int],
        frequency: float,
        octaves: int,
        width: int,
        layers: int,
    ):
        super().__init__(scene, samples, far, rays, frequency)
        for option, value, least in (("width", width, 2), ("layers", layers, 2)):
            if value < least:
                raise ValueError(f"model.{option} must be at least {least}, got {value}")
        check_octaves(octaves)
        self.register_buffer("frequencies", 2.0 ** torch.arange(octaves), persistent=False)
        features = 3 * (1 + 2 * octaves)
        self.joint = layers // 2
        inputs = [features, *[width] * (layers - 1)]
        inputs[self.joint] += features
        self.layers = nn.ModuleList(nn.Linear(size, width) for size in inputs)
        self.attenuate = nn.Linear(width, 2)
        self.feature = nn.Linear(width, width)
        self.parts = width, features, features  # inputs of the second network's first layer
        self.join = nn.Linear(sum(self.parts), width)
        self.send = nn.Sequential(
            nn.Linear(width, width // 2),
            nn.ReLU(),
            nn.Linear(width // 2, 2 * self.reading.channels),
        )

    def sample(
        self, query: Query, points: Float[Tensor, "r i 3"], views: Float[Tensor, "r 3"]
    ) -> Samples:
        places = fourier_features(points, self.frequencies)
        hidden = places
        for number, layer in enumerate(self.layers):
            if number == self.joint:
                hidden = torch.cat((places, hidden), -1)
            hidden = relu(layer(hidden))
        attenuations, turns = amplitudes_and_phases(self.attenuate(hidden))  # (r, i, 1) each
        # All links share the first layer's output for the ray: the layer is summed part by part.
        of_feature, of_view, of_transmitter = self.join.weight.split(self.parts, 1)
        ray = linear(self.feature(hidden), of_feature, self.join.bias)  # (r, i, width)
        ray = ray + linear(fourier_features(views, self.frequencies), of_view)[:, None]
        positions = fourier_features(query.transmitters - self.middle, self.frequencies)
        transmitter = linear(positions, of_transmitter)[:, None, None]  # (b, 1, 1, width)
        sent = self.send((ray + transmitter).relu_())
        amplitudes, phases = amplitudes_and_phases(sent)  # (b, r, i, c) each
        return Samples(attenuations[..., 0], turns[..., 0], amplitudes, phases)


def amplitudes_and_phases(values: Float[Tensor, "*batch 2c"]) -> tuple[Tensor, Tensor]:
    """|leaky ReLU| of the first half of a network's output, 2 pi sigmoid of the second [rad]."""
    amplitudes, phases = values.chunk(2, -1)
    return leaky_relu(amplitudes).abs(), 2 * math.pi * phases.sigmoid()
