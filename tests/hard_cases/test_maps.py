"""Maps of extreme Gaussians in every projection and rasterizer, against float64 of the same float32
inputs.
"""

import math
from dataclasses import dataclass, replace

import pytest
import torch
from contracts.rasterizer import distance_to_jumps, rasterize_densely
from precision import build_rasterizer

from gaigs.core.geometry import Grid, Pose, from_spherical, semi_axes
from gaigs.registry import registry
from gaigs.splatting.projection import NEAR, Plane
from gaigs.splatting.rasterizer import ALPHA_MAX, ALPHA_MIN

VALUES, GRADIENTS = 1e-4, 5e-3
"""Tolerances of float32, of the largest value or of 1, and of the largest gradient."""

GRID = Grid(
    torch.linspace(1, 90, 30, dtype=torch.float64).deg2rad(),
    torch.arange(0, 360, 9).double().deg2rad(),
)
PIXEL = math.radians(1)
ASIDE = torch.tensor([0.7, 1.0, 0.4], dtype=torch.float64)
"""No multiple of the grid's pitch: half a turn from a pixel both images are equally near."""

LOOSE = {"beside the receiver": 0.1, "exactly on the axis": 0.05}
"""Tolerance of gradients of footprints of 1e5 rad, and of pixels half a turn from a splat."""

DRAWING = [name for name in registry("rasterizer").names() if name != "fastest"]
ON = Pose(torch.tensor([1.0, -2.0, 0.5]), torch.eye(3))


def build_projection(name):
    return registry("projection").build({"name": name}, pixel=PIXEL)


@dataclass
class Gaussians:
    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    attenuations: torch.Tensor
    pose: Pose = ON

    def leaves(self, dtype):
        names = ("means", "quats", "scales", "opacities", "attenuations")
        return {name: getattr(self, name).float().to(dtype).requires_grad_() for name in names}


def random_gaussians(n=12, seed=0):
    """In all directions above the horizon, at 1 to 5 m."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)

    directions = from_spherical(uniform(0, 2 * math.pi, n), uniform(0.05, 1.5, n))
    means = ON.position + directions * uniform(1, 5, n, 1)
    quats = torch.randn(n, 4, generator=generator, dtype=torch.float64)
    return Gaussians(
        means, quats, uniform(0.05, 0.5, n, 3), uniform(0.2, 0.9, n), uniform(0.2, 1, n)
    )


def with_scales(*scales):
    return lambda: replace(
        random_gaussians(), scales=torch.tensor(scales, dtype=torch.float64).expand(12, 3)
    )


def towards(azimuth, elevation, distance=2.0):
    """All in about one direction [deg]."""

    def make():
        azimuths, elevations = (
            torch.full((12,), math.radians(angle), dtype=torch.float64)
            for angle in (azimuth, elevation)
        )
        means = ON.position + distance * from_spherical(azimuths, elevations)
        return replace(
            random_gaussians(),
            means=means + 1e-3 * torch.linspace(-1, 1, 12).double()[:, None] * ASIDE,
        )

    return make


def with_quats(scale):
    return lambda: replace(random_gaussians(), quats=scale * random_gaussians().quats)


def at_the_receiver(distance):
    def make():
        gaussians = random_gaussians()
        gaussians.means[::2] = ON.position + distance * torch.tensor([0.6, 0, 0.8])
        return gaussians

    return make


def on_the_axis():
    """Round Gaussians exactly on the axis, where azimuth is undefined."""
    gaussians = random_gaussians()
    gaussians.scales[::2] = 0.2
    gaussians.means[::2] = ON.position + torch.linspace(1, 4, 6)[:, None] * torch.tensor(
        [0.0, 0, 1]
    )
    return gaussians


def with_values(name, *values):
    return lambda: replace(
        random_gaussians(), **{name: torch.tensor(values, dtype=torch.float64).repeat(12)[:12]}
    )


def far_from_the_origin():
    gaussians = random_gaussians()
    shift = torch.tensor([1e6, -1e6, 5e5], dtype=torch.float64)
    pose = replace(ON, position=(ON.position.double() + shift).float())
    return replace(gaussians, means=gaussians.means + shift, pose=pose)


def first(count):
    def make():
        gaussians = random_gaussians()
        parts = ("means", "quats", "scales", "opacities", "attenuations")
        return replace(gaussians, **{part: getattr(gaussians, part)[:count] for part in parts})

    return make


CASES = {
    "ordinary": random_gaussians,
    "on the zenith": towards(0, 90),
    "exactly on the axis": on_the_axis,
    "beside the zenith": towards(200, 89.99),
    "across the seam": towards(180, 30),
    "at azimuth 0": towards(0, 30),
    "on the horizon": towards(75, 0),
    "below the horizon": towards(75, -40),
    "at the nadir": towards(0, -90),
    "on the receiver": at_the_receiver(0.0),
    "nearer than near": at_the_receiver(NEAR / 2),
    "beside the receiver": at_the_receiver(2 * NEAR),
    "points": with_scales(1e-6, 1e-6, 1e-6),
    "larger than the room": with_scales(1e3, 1e3, 1e3),
    "needles of 10 m": with_scales(10, 1e-3, 1e-3),
    "needles of 30 m": with_scales(1e-3, 30, 1e-3),
    "needles of 1 km": with_scales(1e3, 1e-6, 1e-6),
    "discs of condition 1e12": with_scales(1e3, 1e-9, 1.0),
    "scales of 0": with_scales(0, 0, 0),
    "quaternions of 0": with_quats(0.0),
    "quaternions of 1e-30": with_quats(1e-30),
    "quaternions of 1e30": with_quats(1e30),
    "attenuations of 0": with_values("attenuations", 0.0),
    "hardly any let through": with_values("attenuations", 1e-45, 1e-38, 1e-30, 1e-6),
    "all let through": with_values("attenuations", 1.0),
    "some let through": with_values("attenuations", 0.0, 1.0, 1e-38),
    "opacities at their ends": with_values("opacities", 0.0, 1.0),
    "opacities at their bounds": with_values("opacities", ALPHA_MIN, ALPHA_MAX),
    "faint beyond digits": with_values("opacities", 1e-45, 1e-38),
    "far from the origin": far_from_the_origin,
    "none": first(0),
    "one": first(1),
}


def draw(gaussians, projection, rasterizer, dtype):
    """Map and transmittance of two channels, and the leaves that they depend on."""
    leaves = gaussians.leaves(dtype)
    means, quats, scales, opacities, attenuations = leaves.values()
    splats = projection.project(means, semi_axes(quats, scales)[None], gaussians.pose)
    plane = projection.plane(GRID)
    plane = Plane(plane.u.float().to(dtype), plane.v.float().to(dtype), plane.period)
    signal = torch.arange(2 * len(means)).cos().reshape(1, -1, 2).to(dtype)
    image, left = rasterizer(splats, signal, opacities[None], attenuations[None], plane)
    return (
        image,
        left,
        leaves,
        distance_to_jumps(splats, signal, opacities[None], attenuations[None], plane)[0],
    )


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("projection", registry("projection").names())
def test_maps_and_gradients_are_those_of_the_formula(case, projection):
    gaussians, projection = CASES[case](), build_projection(projection)
    true, true_left, true_leaves, distances = draw(
        gaussians, projection, rasterize_densely, torch.float64
    )
    sure = distances > 3e-3
    assert sure.double().mean() > 0.5
    differentiate((true, true_left), gaussians, sure)
    for name, dtype in (
        (name, dtype) for name in DRAWING for dtype in (torch.float32, torch.float64)
    ):
        rasterizer = build_rasterizer(name)
        if rasterizer is None or (name == "opencl" and dtype == torch.float64):
            continue
        found, left, leaves, *_ = draw(gaussians, projection, rasterizer, dtype)
        for value, truth in ((found, true), (left, true_left)):
            assert value.isfinite().all()
            tolerance = (VALUES if dtype == torch.float32 else 1e-7) * max(
                1.0, truth.abs().max().item()
            )
            assert (value - truth)[..., sure].abs().max() < tolerance, (name, dtype)
        differentiate((found, left), gaussians, sure)
        assert all(leaf.grad is None or leaf.grad.isfinite().all() for leaf in leaves.values())
        for part in ("means", "scales", "opacities"):
            truth = true_leaves[part].grad
            if truth is not None:
                error = (leaves[part].grad.double() - truth).abs().max().item()
                assert error <= LOOSE.get(case, GRADIENTS) * max(truth.abs().max().item(), 1e-6), (
                    name,
                    dtype,
                    part,
                )


def differentiate(values, gaussians, sure):
    """Gradients of map and transmittance where no jump is near."""
    if len(gaussians.means):
        sum((value * value.detach().numel() ** -0.5 * sure).sum() for value in values).backward()
