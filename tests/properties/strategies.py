"""Arbitrary inputs of the properties: numbers in their ranges, the awkward ones first."""

import math

import torch
from hypothesis import strategies as st

from gaigs.geometry import Pose, from_spherical, quaternions_to_rotations
from gaigs.projection import Plane, Splats

coordinates = st.floats(-50, 50, width=32)
unit = st.floats(0, 1, width=32)
seeds = st.integers(0, 2**31 - 1)


def tensors(elements, *shape):
    """Float64 tensors of a shape."""
    count = math.prod(shape)
    return st.lists(elements, min_size=count, max_size=count).map(
        lambda values: torch.tensor(values, dtype=torch.float64).reshape(shape)
    )


points = tensors(coordinates, 3)
quaternions = tensors(st.floats(-1, 1, width=32), 4)


@st.composite
def poses(draw):
    return Pose(draw(points), quaternions_to_rotations(draw(quaternions)))


@st.composite
def normals(draw):
    """Unit vectors, the poles and the seam among them."""
    azimuth = draw(st.sampled_from([0.0, math.pi / 2, math.pi, -math.pi]) | st.floats(-math.pi, math.pi))
    elevation = draw(st.sampled_from([0.0, math.pi / 2, -math.pi / 2]) | st.floats(-math.pi / 2, math.pi / 2))
    return from_spherical(*(torch.tensor(angle, dtype=torch.float64) for angle in (azimuth, elevation)))


@st.composite
def drawings(draw, b=2):
    """Arguments of a rasterizer: splats of any number and form on a small plane with or without a seam."""
    n = draw(st.integers(0, 12))
    generator = torch.Generator().manual_seed(draw(seeds))
    random = lambda low, high, *shape: low + (high - low) * torch.rand(*shape, generator=generator, dtype=torch.float64)
    period = draw(st.sampled_from([None, 2 * math.pi]))
    width = draw(st.floats(-4, 1))  # of the splats, as an exponent of 10 [rad]
    diagonal, skew = 10 ** (width + random(-0.5, 0.5, 1, n, 2)), random(-2, 2, 1, n, 1)
    factors = torch.cat((diagonal[..., :1], skew * diagonal[..., :1], diagonal[..., 1:]), -1) + torch.tensor(
        [5e-3, 0, 5e-3]
    )
    depths = random(1, 9, n)
    if draw(st.booleans()):
        depths = depths.round()  # ties
    splats = Splats(random(-3.2, 3.2, n, 2), factors, depths, random(0, 1, n) > 0.1)
    ends = draw(st.sampled_from([(0.0, 1.0), (0.0, 0.1), (0.9, 1.0)]))
    opacities = random(*ends, b, n)
    attenuations = draw(st.sampled_from([None, (0.0, 1.0), (0.9, 1.0)]))
    plane = Plane(torch.linspace(0, 6.1, 20).double()[None], torch.linspace(-1.5, 1.5, 9).double()[:, None], period)
    lets = None if attenuations is None else random(*attenuations, b, n)
    return splats, random(-1, 1, b, n, 2), opacities, lets, plane


def cast(part, dtype):
    """A rasterizer's arguments in another precision."""
    if isinstance(part, tuple):
        return tuple(cast(entry, dtype) for entry in part)
    if isinstance(part, Splats):
        return Splats(*(x.to(dtype) for x in (part.means2d, part.factors, part.depths)), part.visible)
    if isinstance(part, Plane):
        return Plane(part.u.to(dtype), part.v.to(dtype), part.period)
    return None if part is None else part.to(dtype)
