"""Rotations, poses, spherical harmonics and places, against scipy, angles against the conventions."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from scipy.special import sph_harm_y

from gaigs.core.geometry import (
    Pose,
    even_places,
    quaternions_to_rotations,
    sinc,
    spherical_harmonics,
    to_spherical,
)


@pytest.fixture
def quats():
    """Quaternions (w, x, y, z) of various lengths."""
    return 3 * torch.randn(20, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))


def test_quaternions_rotate_as_scipys_do_whatever_their_length(quats):
    expected = Rotation.from_quat(quats.roll(-1, -1).numpy()).as_matrix()
    torch.testing.assert_close(quaternions_to_rotations(quats), torch.from_numpy(expected))


def test_the_length_of_a_quaternion_gets_no_gradient(quats):
    assert torch.autograd.gradcheck(quaternions_to_rotations, quats.requires_grad_())
    weights = torch.arange(9.0, dtype=torch.float64).view(3, 3)
    (gradient,) = torch.autograd.grad((quaternions_to_rotations(quats) * weights).sum(), quats)
    torch.testing.assert_close(
        (gradient * quats).sum(-1), torch.zeros(20, dtype=torch.float64), rtol=0, atol=1e-12
    )


def test_a_point_on_an_axis_of_the_array_is_seen_there():
    turn = Rotation.from_euler("xyz", [10, 80, -30], degrees=True)
    pose = Pose.from_xyzw((4, 5, 6), turn.as_quat())
    for axis in range(3):
        point = torch.tensor(
            np.array([4, 5, 6]) + 2 * turn.as_matrix()[:, axis], dtype=torch.float32
        )
        torch.testing.assert_close(pose.local(point), 2 * torch.eye(3)[axis], rtol=0, atol=1e-5)
    points = torch.randn(7, 2, 3)
    torch.testing.assert_close(pose.world(pose.local(points)), points, rtol=0, atol=1e-5)


@pytest.mark.parametrize(
    ("position", "quaternion", "message"),
    [
        ((0, 0, 0), (0, 0, 0, 1.01), "must have length 1"),
        ((0, 0, 0), (0, 0, math.inf, 1), "must have length 1"),
        ((0, 0, 0), (0, 0, math.nan, 1), "must have length 1"),
        ((0, math.nan, 0), (0, 0, 0, 1), "3 finite coordinates"),
        ((0, 0), (0, 0, 0, 1), "3 finite coordinates"),
        ((0, 0, 0), torch.eye(3), r"a quaternion \(x, y, z, w\)"),
    ],
)
def test_impossible_poses_are_refused(position, quaternion, message):
    with pytest.raises(ValueError, match=message):
        Pose.from_xyzw(position, quaternion)


def test_directions_have_the_angles_of_the_convention():
    points = torch.tensor(
        [
            [2.0, 0, 0],
            [0, 3, 0],
            [-1, 0, 0],
            [0, -1, 0],
            [1, 1, math.sqrt(2)],
            [0, 0, 5],
            [0, 0, -5],
        ]
    )
    azimuths, elevations, distances = to_spherical(points)
    torch.testing.assert_close(azimuths.rad2deg(), torch.tensor([0.0, 90, 180, -90, 45, 0, 0]))
    torch.testing.assert_close(elevations.rad2deg(), torch.tensor([0.0, 0, 0, 0, 45, 90, -90]))
    torch.testing.assert_close(distances, torch.tensor([2.0, 3, 1, 1, 2, 5, 5]))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("offset", [0.0, 1e-30, 1e-12, 1e-5])
def test_gradients_are_finite_on_the_axis_and_beside_it(dtype, offset):
    points = torch.tensor([[offset, -offset, 2], [0, offset, -2]], dtype=dtype, requires_grad=True)
    for coordinate in to_spherical(points):
        (gradient,) = torch.autograd.grad(coordinate.sum(), points, retain_graph=True)
        assert gradient.isfinite().all()
    assert (to_spherical(points)[1].abs().rad2deg() > 89.999).all()


def directions(count):
    """Unit vectors, the poles among them."""
    vectors = torch.randn(count, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    vectors[:2] = torch.tensor([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    return vectors / vectors.norm(dim=-1, keepdim=True)


def test_spherical_harmonics_are_scipys():
    vectors, degree = directions(40), 12
    found = spherical_harmonics(vectors, degree).numpy()
    azimuths, elevations, _ = (angle.numpy() for angle in to_spherical(vectors))
    for n in range(degree + 1):
        for m in range(-n, n + 1):
            waves = sph_harm_y(n, abs(m), math.pi / 2 - elevations, azimuths)
            expected = (
                waves.real if m == 0 else math.sqrt(2) * (waves.real if m > 0 else waves.imag)
            )
            np.testing.assert_allclose(found[:, n**2 + n + m], expected, rtol=0, atol=1e-12)


def test_spherical_harmonics_have_finite_gradients_at_the_poles():
    assert torch.autograd.gradcheck(
        lambda vectors: spherical_harmonics(vectors, 4), directions(5).requires_grad_()
    )


@pytest.mark.parametrize(
    ("edges", "axes"),
    [
        ((6, 4, 0), 2),
        ((30, 2, 0), 2),
        ((60, 11, 3), 3),
        ((8, 5, 0.5), 3),
        ((8, 5, 0.2), 2),
        ((9, 1e-3, 0), 1),
        ((0, 0, 0), 0),
    ],
)
def test_places_in_a_box_are_about_as_many_as_asked_for_and_evenly_apart(edges, axes):
    places = even_places(torch.tensor(edges).float(), torch.zeros(3), 1000)
    counts = [len(places[:, axis].unique()) for axis in range(3)]
    assert len(places) == (1 if axes == 0 else pytest.approx(1000, rel=0.35))
    assert sum(count > 1 for count in counts) == axes
    pitches = [edge / count for edge, count in zip(edges, counts, strict=True) if count > 1]
    assert max(pitches, default=1) <= 2 * min(pitches, default=1)


def test_sinc_is_that_of_torch_also_at_0():
    values = torch.tensor(
        [0.0, -0.0, 1e-40, -1e-3, 0.3, 1.0, -2.5, 40.0], dtype=torch.float64, requires_grad=True
    )
    torch.testing.assert_close(sinc(values), torch.sinc(values))
    assert torch.autograd.gradcheck(sinc, values)
    zero = torch.zeros(1, requires_grad=True)
    sinc(zero).backward()
    assert sinc(zero).item() == 1
    assert zero.grad.item() == 0
