"""Rotations, semi-axes, angles and mirror images of arbitrary quaternions, points and planes."""

import math

import torch
from hypothesis import given
from hypothesis import strategies as st
from strategies import coordinates, normals, points, quaternions, tensors

from gaigs.algebra import PROJECTIVE
from gaigs.algebra.embedding import embed_plane, embed_point, extract_point
from gaigs.core.geometry import (
    from_spherical,
    quaternions_to_rotations,
    semi_axes,
    to_spherical,
    unit_quaternions,
)
from gaigs.splatting.placement.mirrored.reflections import reflect

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
    assert (
        quaternions_to_rotations(unit) - quaternions_to_rotations(quat)
    ).abs().max() < 8 * BOUND[dtype]


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
    torch.testing.assert_close(
        length * from_spherical(azimuth, elevation), point, rtol=0, atol=1e-9 * distance
    )


@given(normals(), coordinates, points)
def test_a_reflection_undoes_itself_and_is_the_sandwich_with_the_plane(normal, offset, point):
    offset = torch.tensor(offset, dtype=torch.float64)
    once = reflect(point, normal, offset)
    torch.testing.assert_close(reflect(once, normal, offset), point, rtol=0, atol=1e-10)
    versor = embed_plane(normal, offset)
    torch.testing.assert_close(
        extract_point(PROJECTIVE.sandwich(versor, embed_point(point))), once, rtol=0, atol=1e-9
    )
