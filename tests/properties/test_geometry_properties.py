"""Rotations, semi-axes and angles of arbitrary quaternions and points."""

import math

import torch
from hypothesis import given
from hypothesis import strategies as st
from strategies import normals, points, poses, quaternions, tensors

from gaigs.geometry import (
    from_spherical,
    quaternions_to_rotations,
    semi_axes,
    spherical_harmonics,
    to_spherical,
    unit_quaternions,
)

lengths = st.sampled_from([1e-30, 1e-6, 1.0, 1e6, 1e30])
dtypes = st.sampled_from([torch.float32, torch.float64])
BOUND = {torch.float32: 2e-6, torch.float64: 1e-14}


@given(quaternions, lengths, dtypes)
def test_rotations_are_orthonormal_whatever_the_length(quat, length, dtype):
    quat = (length * quat).to(dtype)
    turn = quaternions_to_rotations(quat)
    assert (turn.mT @ turn - torch.eye(3)).abs().max() < BOUND[dtype]
    assert abs(turn.double().det().item() - 1) < 4 * BOUND[dtype]
    assert (quaternions_to_rotations(-quat) == turn).all()


@given(quaternions, lengths, dtypes)
def test_unit_quaternions_are_of_length_1_and_turn_alike(quat, length, dtype):
    quat = (length * quat).to(dtype)
    unit = unit_quaternions(quat)
    if (quat == 0).all():
        assert (quaternions_to_rotations(unit) - torch.eye(3)).abs().max() == 0
        return
    assert abs(unit.norm().item() - 1) < BOUND[dtype]
    assert (quaternions_to_rotations(unit) - quaternions_to_rotations(quat)).abs().max() < 8 * BOUND[dtype]


@given(quaternions, tensors(st.floats(2.0**-20, 1e3, width=32), 3))
def test_semi_axes_are_as_long_as_the_scales_and_at_right_angles(quat, scales):
    axes = semi_axes(quat, scales)
    torch.testing.assert_close(axes.norm(dim=0), scales, rtol=1e-12, atol=0)
    cosines = (axes / scales).mT @ (axes / scales)
    assert (cosines - torch.eye(3)).abs().max() < 1e-12
    covariance = axes @ axes.mT
    torch.testing.assert_close(covariance.trace(), scales.square().sum(), rtol=1e-10, atol=0)


@given(normals(), st.floats(1e-3, 1e6))
def test_angles_lead_back_to_the_point(direction, distance):
    point = distance * direction
    azimuth, elevation, length = to_spherical(point)
    assert abs(azimuth.item()) <= math.pi
    assert abs(elevation.item()) <= math.pi / 2
    torch.testing.assert_close(length * from_spherical(azimuth, elevation), point, rtol=0, atol=1e-9 * distance)


@given(poses(), points)
def test_a_pose_takes_back_what_it_gives(pose, point):
    torch.testing.assert_close(pose.world(pose.local(point)), point, rtol=0, atol=1e-10)
    torch.testing.assert_close(pose.local(point).norm(), (point - pose.position).norm(), rtol=1e-9, atol=1e-12)


@given(normals(), st.integers(0, 5))
def test_harmonics_of_a_degree_have_the_same_size_everywhere(direction, degree):
    """Unsöld's theorem: the squares of one degree add up to (2 n + 1) / 4 pi in each direction."""
    values = spherical_harmonics(direction, degree).square()
    for n in range(degree + 1):
        total = values[n**2 : (n + 1) ** 2].sum().item()
        assert abs(total - (2 * n + 1) / (4 * math.pi)) < 1e-10
