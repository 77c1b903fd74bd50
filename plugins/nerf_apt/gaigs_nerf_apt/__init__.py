"""NeRF-APT: the radiance field of NeRF², its networks attention U-Nets over rays x samples."""

import math
from collections.abc import Mapping
from dataclasses import replace

import torch
from gaigs_nerf2 import RayMarching, Samples, amplitudes_and_phases
from gaigs_nerf2.marching import check_octaves
from jaxtyping import Complex, Float
from torch import Tensor, nn

from gaigs.core.geometry import Directions, Grid, Rays
from gaigs.core.query import Batch, Query
from gaigs.core.scene import Scene
from gaigs.model import Prediction
from gaigs.splatting.tokenizer.euclidean import fourier_features
from gaigs_nerf_apt.unet import DIVISOR, UNet


class NerfApt(RayMarching):
    """Place -> attenuation and a feature; feature, direction and transmitter -> the field sent
    along the ray.

    An image is the rays of one elevation, side by side around the circle, times the samples along
    them. A ray is seen with its neighbours, so it must always have the same: a grid of the model's
    own is marched whatever directions are asked for, and spectra are interpolated from it. While
    training, batch normalisation makes a link depend on the others of its batch; a trained model's
    links do not.

    Args:
        scene: Receivers, task, carrier.
        samples, far, frequency: See ``gaigs_nerf2.RayMarching``; a multiple of 4 samples.
        rays: Rows and columns of the grid, a multiple of 4: of spectra evenly from the label's
            lowest elevation to its highest and around the circle, else over the sphere.
        octaves: Of the features sin 2^k x and cos 2^k x of positions [m] and directions, k from 0.
        widths: Of both U-Nets at full, half and quarter resolution; the first is the feature's too.

    Raises:
        ValueError: See ``gaigs_nerf2.RayMarching``.

    Source: NeRF-APT, 2025.
    """

    learning_rates: Mapping[str, float] = {"network": 4e-3}  # not published

    def __init__(
        self,
        scene: Scene,
        samples: int,
        far: float | None,
        rays: list[int],
        frequency: float,
        octaves: int,
        widths: list[int],
    ):
        super().__init__(scene, samples, far, rays, frequency)
        if (
            samples % DIVISOR
            or len(rays) != 2
            or rays[0] < 2
            or rays[1] < DIVISOR
            or rays[1] % DIVISOR
        ):
            raise ValueError(
                f"model.samples and the columns of model.rays must be multiples of {DIVISOR}, of "
                "at least 2 rows, got "
                f"{samples} and {rays}"
            )
        if len(widths) != 3 or min(widths) < 2:
            raise ValueError(f"model.widths must be three numbers of at least 2, got {widths}")
        check_octaves(octaves)
        if self.grid is None:
            self.grid = around(scene.task.directions, *rays)
        self.register_buffer("frequencies", 2.0 ** torch.arange(octaves), persistent=False)
        features = 3 * (1 + 2 * octaves)
        self.attenuate = UNet(features, 2 + widths[0], widths)
        self.send = UNet(widths[0] + features, 2 * self.reading.channels, widths)
        self.transmitter = nn.Linear(features, widths[0], bias=False)

    def forward(self, batch: Batch) -> Prediction:
        prediction = super().forward(
            replace(batch, directions=self.grid.to(batch.query.transmitters))
        )
        if self.scene.task.directions is None:
            return prediction
        directions = batch.directions or self.scene.task.directions
        return prediction._replace(value=interpolated(prediction.value, self.grid, directions))

    def march(self, query: Query, receiver: int, rays: Rays) -> Complex[Tensor, "b r c"]:
        """Fields along rays at one receiver; they belong together, so links are parted."""
        if torch.is_grad_enabled() or not len(query):
            return self.march_at_once(query, receiver, rays)
        parts = query.parts(max(1, self.chunk // len(rays.azimuths)))
        return torch.cat([self.march_at_once(part, receiver, rays) for part in parts])

    def sample(
        self, query: Query, points: Float[Tensor, "r i 3"], views: Float[Tensor, "r 3"]
    ) -> Samples:
        rows = self.grid.shape[0]
        places = fourier_features(points, self.frequencies)
        there = as_samples(self.attenuate(as_images(places, rows)), rows)[0]
        (attenuations, turns), feature = amplitudes_and_phases(there[..., :2]), there[..., 2:]
        views = fourier_features(views, self.frequencies)[:, None].expand(-1, points.shape[1], -1)
        ray = as_images(torch.cat((feature, views), -1), rows)
        shifts = self.transmitter(
            fourier_features(query.transmitters - self.middle, self.frequencies)
        )
        amplitudes, phases = amplitudes_and_phases(as_samples(self.send(ray, shifts), rows))
        return Samples(attenuations[..., 0], turns[..., 0], amplitudes, phases)


def around(directions: Grid, rows: int, columns: int) -> Grid:
    """A grid that spans a label's elevations evenly, and the circle."""
    elevations = directions.elevations
    spread = torch.linspace(elevations.min().item(), elevations.max().item(), rows)
    return Grid(spread, 2 * math.pi / columns * torch.arange(columns))


def as_images(values: Float[Tensor, "r i c"], rows: int) -> Float[Tensor, "rows c columns i"]:
    """Values along the rays of a grid, an image a row."""
    return values.unflatten(0, (rows, -1)).permute(0, 3, 1, 2)


def as_samples(images: Float[Tensor, "brows c columns i"], rows: int) -> Float[Tensor, "b r i c"]:
    """Images, those of a link one after another, as values along its rays."""
    return images.unflatten(0, (-1, rows)).permute(0, 1, 3, 4, 2).flatten(1, 2)


def interpolated(
    values: Float[Tensor, "b rows columns"], grid: Grid, directions: Directions
) -> Tensor:
    """Values on a grid from ``around`` in other directions, linear in elevation and azimuth (b,
    *directions.shape).
    """
    rays, (rows, columns) = directions.flatten().to(values), grid.shape
    lowest, highest = grid.elevations[[0, -1]].tolist()
    spread = max(highest - lowest, 1e-6)  # a label may have a single elevation
    row = ((rays.elevations - lowest) * ((rows - 1) / spread)).clamp(0, rows - 1)
    column = (rays.azimuths * (columns / (2 * math.pi))).remainder(columns)
    below, before = row.long().clamp(max=rows - 2), column.long().clamp(max=columns - 1)
    up, on, behind = row - below, column - before, (before + 1) % columns
    lower, upper = (
        torch.lerp(values[:, k, before], values[:, k, behind], on) for k in (below, below + 1)
    )
    return torch.lerp(lower, upper, up).unflatten(1, directions.shape)
