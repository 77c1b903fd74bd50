"""Scenes of any number of splats for map rasterizers, with the time and the error of a rasterizer
on them.
"""

import math
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import torch
from common import now
from torch import Tensor

from gaigs.splatting.projection import Plane, Splats
from gaigs.splatting.rasterizer import ALPHA_MIN

# The slow but plain rasterizer of the tests is the truth here too.
sys.path.append(str(Path(__file__).parents[1] / "tests"))
from contracts.rasterizer import (
    cast_scene,
    distance_to_jumps,
    footprints_of,
    rasterize_densely,
    render_with_gradients,
)


class DrawnScene(NamedTuple):
    """Arguments of a map rasterizer, in float64 on the processor."""

    splats: Splats
    signal: Tensor
    opacities: Tensor
    attenuations: Tensor | None
    plane: Plane

    def coarse(self, most: float = 4e6) -> "DrawnScene":
        """The scene on every k-th row and column, so that there are at most so many pairs of splat
        and pixel.
        """
        (b, n, _), (rows, columns), plane = self.signal.shape, self.plane.shape, self.plane
        k = math.ceil(math.sqrt(b * n * rows * columns / most))
        return self._replace(plane=Plane(plane.u[:, ::k], plane.v[::k], plane.period))


def common(n: int, rows: int, columns: int) -> DrawnScene:
    """One transmitter, 3 channels, a plane of 360 x 90 that does not wrap; standard deviations
    log-uniform in 1.5..8, opacities uniform in 0.05..0.6, no attenuation."""
    uniform = _uniform()
    means = torch.stack((uniform(0, 360, n), uniform(0, 90, n)), -1)
    splats = _splats(means, uniform(math.log(1.5), math.log(8), 1, n, 2).exp(), uniform)
    u, v = (
        (torch.arange(size).double() + 0.5) * edge / size
        for size, edge in ((columns, 360), (rows, 90))
    )
    return DrawnScene(
        splats,
        uniform(0, 1, 1, n, 3),
        uniform(0.05, 0.6, 1, n),
        None,
        Plane(u[None], v[:, None], None),
    )


def training(n: int, rows: int, columns: int) -> DrawnScene:
    """16 transmitters, each of which deforms the splats and attenuates; 2 channels; splats of 5 to
    15 degrees, on 360 x 90 degrees with wrapping azimuth."""
    uniform = _uniform()
    means = torch.stack((uniform(-math.pi, math.pi, n), uniform(0, math.pi / 2, n)), -1)
    splats = _splats(means, torch.deg2rad(uniform(5, 15, 16, n, 2)), uniform)
    azimuths = 2 * math.pi / columns * torch.arange(columns).double()
    elevations = math.pi / 2 / rows * torch.arange(rows).double()
    plane = Plane(azimuths[None], elevations[:, None], 2 * math.pi)
    return DrawnScene(
        splats, uniform(-1, 1, 16, n, 2), uniform(0, 0.6, 16, n), uniform(0.5, 1, 16, n), plane
    )


SCENES = {"common": common, "training": training}
"""Functions of the numbers of Gaussians, rows and columns, by name."""


def _uniform():
    generator = torch.Generator().manual_seed(0)
    return lambda low, high, *shape: (
        low + (high - low) * torch.rand(*shape, generator=generator).double()
    )


def _splats(means: Tensor, deviations: Tensor, uniform) -> Splats:
    angles, depths = uniform(0, math.pi, *deviations.shape[:2]), uniform(1, 5, len(means))
    axes = torch.stack((angles.cos(), -angles.sin(), angles.sin(), angles.cos()), -1).unflatten(
        -1, (2, 2)
    )
    half = axes * deviations[..., None, :]
    factors = torch.linalg.cholesky(half @ half.mT)[..., [0, 1, 1], [0, 0, 1]]
    return Splats(means, factors, depths, depths > 0)


def passes(
    rasterizer: Callable, scene: DrawnScene, device: str, dtype: torch.dtype, clock=now
) -> Callable[[], tuple]:
    """A function that draws and differentiates a scene, and returns the seconds of both."""
    splats, *others, plane = cast_scene(scene, device, dtype)

    def leaf(tensor):
        return None if tensor is None else tensor.detach().clone().requires_grad_()

    splats = replace(splats, means2d=leaf(splats.means2d), factors=leaf(splats.factors))
    arguments = splats, *map(leaf, others), plane

    def turn() -> tuple[float, float]:
        start = clock()
        outputs = rasterizer(*arguments)
        between = clock()
        torch.autograd.backward(outputs, [torch.ones_like(output) for output in outputs])
        return between - start, clock() - between

    return turn


class Truth:
    """The dense float64 sum over all pairs of a splat and a pixel of a scene, with its gradients.

    A scene of many pairs is drawn on a coarser grid. Pixels are left out where an opacity of a
    splat is within 1e-4 of one of its bounds: there rounding may decide if a splat acts.

    Attributes:
        pairs: Number of pairs that act, of all transmitters; in proportion on the scene's own grid.
    """

    def __init__(self, scene: DrawnScene):
        self.scene = scene.coarse()
        self.pixels = distance_to_jumps(*self.scene) > 1e-4
        self.values = render_with_gradients(rasterize_densely, self.scene, self.pixels)
        order, footprints = footprints_of(self.scene.splats, self.scene.plane)
        acting = int((self.scene.opacities[:, order, None, None] * footprints >= ALPHA_MIN).sum())
        self.pairs = round(
            acting * math.prod(scene.plane.shape) / math.prod(self.scene.plane.shape)
        )

    def errors(self, rasterizer: Callable, device: str, dtype: torch.dtype) -> dict[str, float]:
        """Largest deviations of the map and of the gradients, each relative to its largest true
        value.
        """
        found = render_with_gradients(
            rasterizer, cast_scene(self.scene, device, dtype), self.pixels.to(device)
        )
        errors = {
            name: (found[name].cpu() - true).abs().max() / true.abs().max()
            for name, true in self.values.items()
        }
        gradients = [error for name, error in errors.items() if name.startswith("gradient")]
        return {
            "error": float(errors["map"]),
            "gradient_error": float(torch.stack(gradients).max()),
        }
