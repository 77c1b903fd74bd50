"""What rasterizers are given: scenes of any number of Gaussians, on any grid, in any precision."""

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.geometry import semi_axes
from gaigs.projection import Plane, Splats
from gaigs.scene import Array

SPAN = 360.0, 90.0
"""Edges of the plane of the scene ``common``."""

ELEMENTS, CARRIER = 4, 2.4e9
"""Edge of the square array of the scene ``aperture``, in elements half a wavelength apart, and its carrier [Hz]."""


class MapScene(NamedTuple):
    """A map rasterizer's arguments."""

    splats: Splats
    signal: Tensor
    opacities: Tensor
    attenuations: Tensor | None
    plane: Plane

    def leaves(self) -> list[Tensor]:
        """What the map is differentiable by."""
        leaves = (self.splats.means2d, self.splats.factors, self.signal, self.opacities, self.attenuations)
        return [leaf for leaf in leaves if leaf is not None]


class ApertureScene(NamedTuple):
    """Arguments of ``fields``."""

    points: Tensor
    semi_axes: Tensor
    amplitudes: Tensor
    lengths: Tensor
    array: Array
    carriers: Tensor
    offsets: Tensor

    def leaves(self) -> list[Tensor]:
        """What the fields are differentiable by."""
        return [self.points, self.semi_axes, self.amplitudes, self.lengths]


Scene = MapScene | ApertureScene


def common(n: int, rows: int, columns: int) -> MapScene:
    """One transmitter, 3 channels; a plane of 360 x 90 that does not wrap; standard deviations log-uniform in 1.5..8,
    opacities uniform in 0.05..0.6, no attenuation."""
    uniform = _uniform()
    means = torch.stack((uniform(0, SPAN[0], n), uniform(0, SPAN[1], n)), -1)
    splats = _splats(means, uniform(math.log(1.5), math.log(8), 1, n, 2).exp(), uniform)
    centres = [
        (torch.arange(size).double() + 0.5) * span / size for size, span in zip((columns, rows), SPAN, strict=True)
    ]
    plane = Plane(centres[0][None], centres[1][:, None], None)
    return MapScene(splats, uniform(0, 1, 1, n, 3), uniform(0.05, 0.6, 1, n), None, plane)


def training(n: int, rows: int, columns: int) -> MapScene:
    """16 transmitters, each of which deforms the splats, of 5 to 15 degrees, and attenuates; 2 channels; 360 x 90
    degrees, azimuth wraps."""
    uniform = _uniform()
    means = torch.stack((uniform(-math.pi, math.pi, n), uniform(0, math.pi / 2, n)), -1)
    splats = _splats(means, torch.deg2rad(uniform(5, 15, 16, n, 2)), uniform)
    azimuths = 2 * math.pi / columns * torch.arange(columns).double()
    elevations = math.pi / 2 / rows * torch.arange(rows).double()
    plane = Plane(azimuths[None], elevations[:, None], 2 * math.pi)
    return MapScene(splats, uniform(-1, 1, 16, n, 2), uniform(0, 0.6, 16, n), uniform(0.5, 1, 16, n), plane)


def aperture(n: int, rows: int, columns: int) -> ApertureScene:
    """One transmitter, a square array of 16 elements; Gaussians 1 to 20 m away, up to 44 degrees off each of its axes,
    of 0.02 to 0.17 of that distance, that all interfere at one frequency. The grid is that of the spectrum that is
    pooled from it."""
    uniform = _uniform()
    cosines, lengths = uniform(-0.7, 0.7, n, 2), uniform(1, 20, 1, n)
    ahead = (1 - cosines.square().sum(1, keepdim=True)).sqrt()
    points = lengths[..., None] * torch.cat((cosines, ahead), 1)
    scales = lengths[..., None] * uniform(0.02, 0.17, 1, n, 3)
    axes = semi_axes(uniform(-1, 1, 1, n, 4), scales)
    amplitudes = torch.polar(uniform(0, 1, 1, n), uniform(-math.pi, math.pi, 1, n))
    array = Array.planar(ELEMENTS, ELEMENTS, speed_of_light / CARRIER / 2, "isotropic")
    carriers = torch.full((1,), CARRIER, dtype=torch.float64)
    return ApertureScene(points, axes, amplitudes, lengths, array, carriers, torch.zeros(1, 1, dtype=torch.float64))


SCENES: dict[str, Callable[[int, int, int], Scene]] = {"common": common, "training": training, "aperture": aperture}
"""By name; of Gaussians, rows and columns, in float64 on the processor."""

DRAWS_NO_MAP = "aperture"
"""The scene of rasterizers that draw no map."""


def cast(scene: Scene, device: str, dtype: torch.dtype) -> Scene:
    """A scene elsewhere or in another precision; complex numbers in that of their parts."""

    def moved(part):
        match part:
            case Splats():
                whole = (part.means2d, part.factors, part.depths)
                return Splats(*(tensor.to(device, dtype) for tensor in whole), part.visible.to(device))
            case Plane():
                return Plane(part.u.to(device, dtype), part.v.to(device, dtype), part.period)
            case Tensor():
                return part.to(device, dtype.to_complex() if part.is_complex() else dtype)
        return part

    return type(scene)(*map(moved, scene))


def with_leaves(scene: Scene) -> Scene:
    """The same scene with inputs of its own that take gradients."""
    own = iter([leaf.detach().clone().requires_grad_() for leaf in scene.leaves()])
    if isinstance(scene, ApertureScene):
        return scene._replace(points=next(own), semi_axes=next(own), amplitudes=next(own), lengths=next(own))
    splats = scene.splats
    splats = Splats(next(own), next(own), splats.depths, splats.visible)
    parts = {"signal": next(own), "opacities": next(own), "attenuations": next(own, None)}
    return scene._replace(splats=splats, **parts)


def _uniform():
    generator = torch.Generator().manual_seed(0)
    return lambda low, high, *shape: low + (high - low) * torch.rand(*shape, generator=generator).double()


def _splats(means: Tensor, deviations: Tensor, uniform) -> Splats:
    angles, depths = uniform(0, math.pi, *deviations.shape[:2]), uniform(1, 5, len(means))
    axes = torch.stack((angles.cos(), -angles.sin(), angles.sin(), angles.cos()), -1).unflatten(-1, (2, 2))
    half = axes * deviations[..., None, :]
    factors = torch.linalg.cholesky(half @ half.mT)[..., [0, 1, 1], [0, 0, 1]]
    return Splats(means, factors, depths, depths > 0)
