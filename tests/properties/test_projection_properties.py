"""Projections of arbitrary Gaussians: finite, hidden where they sit on the receiver, alike on both sides of a seam."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from strategies import points, poses, quaternions, tensors

from gaigs.geometry import Pose, Rays, semi_axes
from gaigs.projection import NEAR
from gaigs.registry import registry

every = pytest.mark.parametrize("name", registry("projection").names())
scales = tensors(st.floats(0, 1e3, width=32), 3)
HERE = Pose(torch.zeros(3).double(), torch.eye(3).double())


def build(name):
    return registry("projection").build({"name": name}, pixel=math.radians(1))


@every
@given(points, quaternions, scales, poses(), st.sampled_from([torch.float32, torch.float64]))
def test_splats_are_finite_and_visible_but_on_the_receiver(name, mean, quat, scale, pose, dtype):
    mean, quat, scale, pose = mean.to(dtype), quat.to(dtype), scale.to(dtype), pose.to(mean.to(dtype))
    splats = build(name).project(mean[None], semi_axes(quat, scale)[None, None], pose)
    for part in (splats.means2d, splats.factors, splats.depths):
        assert part.dtype == dtype
        assert part.isfinite().all()
    assert splats.visible.item() == (splats.depths.item() >= NEAR)
    assert splats.factors[..., 0].gt(0).all()
    assert splats.factors[..., 2].gt(0).all()
    assert splats.depths.item() == pytest.approx((mean - pose.position).norm().item(), rel=1e-5, abs=1e-30)


@every
@given(st.floats(-1.4, 1.4), st.floats(1e-9, 1e-3), st.floats(0.1, 100), scales)
def test_both_sides_of_the_seam_are_neighbours(name, elevation, step, distance, scale):
    """A Gaussian just before azimuth pi and one just behind it lie as near to each other as they are in the room."""
    projection = build(name)
    angles = [elevation] * 2, [math.pi - step, step - math.pi]
    rays = Rays(*(torch.tensor(angle, dtype=torch.float64) for angle in angles))
    splats = projection.project(distance * rays.vectors(), torch.diag(scale).expand(1, 2, 3, 3), HERE)
    apart = splats.means2d[0] - splats.means2d[1]
    if projection.period is not None:
        apart[0] -= projection.period * torch.round(apart[0] / projection.period)
    assert apart.norm().item() <= 2 * step * (1 + 1e-6) + 1e-12
