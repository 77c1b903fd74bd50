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
    """Two U-Nets: place -> attenuation and a feature; feature, direction and transmitter -> the
    field sent along the ray.

    An image is the rays of one elevation, side by side around the circle, times the samples along
    them. A ray's values depend on its neighbours: the model marches a fixed grid of its own, and
    interpolates spectra in other directions. In training, batch normalisation makes a link depend
    on the others of its batch; in a trained model it does not.

    Args:
        scene: Receivers, task, carrier.
        samples, far, frequency: See ``gaigs_nerf2.RayMarching``; ``samples`` is a multiple of 4.
        rays: Rows and columns of the grid, columns a multiple of 4. For spectra it goes from the
            label's lowest elevation to its highest and around the circle, else over the sphere.
        octaves: Number of the features sin 2^k x and cos 2^k x of positions [m] and directions, k
            from 0.
        widths: Channels of both U-Nets at full, half and quarter resolution; the feature has the
            first.

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
        is_grid = len(rays) == 2 and rays[0] >= 2 and rays[1] >= DIVISOR
        if not is_grid or samples % DIVISOR or rays[1] % DIVISOR:
            raise ValueError(
                f"model.samples and the columns of model.rays must be multiples of {DIVISOR}, of "
                f"at least 2 rows, got {samples} and {rays}"
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
        grid = self.grid.to(batch.query.transmitters)
        prediction = super().forward(replace(batch, directions=grid))
        if self.scene.task.directions is None:
            return prediction
        directions = batch.directions or self.scene.task.directions
        return prediction._replace(value=interpolated(prediction.value, self.grid, directions))

    def march(self, query: Query, receiver: int, rays: Rays) -> Complex[Tensor, "b r c"]:
        """Fields along rays at one receiver; rays belong together, so links are split."""
        if torch.is_grad_enabled() or not len(query):
            return self.march_at_once(query, receiver, rays)
        parts = query.parts(max(1, self.chunk // len(rays.azimuths)))
        return torch.cat([self.march_at_once(part, receiver, rays) for part in parts])

    def sample(
        self, query: Query, points: Float[Tensor, "r i 3"], views: Float[Tensor, "r 3"]
    ) -> Samples:
        rows = self.grid.shape[0]
        places = fourier_features(points, self.frequencies)
        matter = as_samples(self.attenuate(as_images(places, rows)), rows)[0]  # (r, i, 2 + width)
        attenuations, turns = amplitudes_and_phases(matter[..., :2])
        feature = matter[..., 2:]
        views = fourier_features(views, self.frequencies)[:, None].expand(-1, points.shape[1], -1)
        ray = as_images(torch.cat((feature, views), -1), rows)
        transmitters = fourier_features(query.transmitters - self.middle, self.frequencies)
        shifts = self.transmitter(transmitters)  # (b, width)
        amplitudes, phases = amplitudes_and_phases(as_samples(self.send(ray, shifts), rows))
        return Samples(attenuations[..., 0], turns[..., 0], amplitudes, phases)


def around(directions: Grid, rows: int, columns: int) -> Grid:
    """A grid of even rows over a label's elevations, and even columns around the circle."""
    elevations = directions.elevations
    spread = torch.linspace(elevations.min().item(), elevations.max().item(), rows)
    return Grid(spread, 2 * math.pi / columns * torch.arange(columns))


def as_images(values: Float[Tensor, "r i c"], rows: int) -> Float[Tensor, "rows c columns i"]:
    """Values along the rays of a grid, as an image for each row of the grid."""
    return values.unflatten(0, (rows, -1)).permute(0, 3, 1, 2)


def as_samples(images: Float[Tensor, "brows c columns i"], rows: int) -> Float[Tensor, "b r i c"]:
    """Images as values along rays: ``rows`` images in a row belong to one link."""
    return images.unflatten(0, (-1, rows)).permute(0, 1, 3, 4, 2).flatten(1, 2)


def interpolated(
    values: Float[Tensor, "b rows columns"], grid: Grid, directions: Directions
) -> Tensor:
    """Values on a grid from ``around``, interpolated linearly in other directions.

    Returns:
        Values (b, *directions.shape).
    """
    rays = directions.flatten().to(values)
    rows, columns = grid.shape
    lowest, highest = grid.elevations[[0, -1]].tolist()
    spread = max(highest - lowest, 1e-6)  # a label may have a single elevation
    # Places of the directions in rows and columns of the grid.
    row = ((rays.elevations - lowest) * ((rows - 1) / spread)).clamp(0, rows - 1)
    column = (rays.azimuths * (columns / (2 * math.pi))).remainder(columns)
    below = row.long().clamp(max=rows - 2)
    before = column.long().clamp(max=columns - 1)
    behind = (before + 1) % columns
    across = column - before
    lower = torch.lerp(values[:, below, before], values[:, below, behind], across)
    upper = torch.lerp(values[:, below + 1, before], values[:, below + 1, behind], across)
    return torch.lerp(lower, upper, row - below).unflatten(1, directions.shape)
