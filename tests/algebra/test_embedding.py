import pytest
import torch

from gaigs.algebra import PROJECTIVE, SPACETIME
from gaigs.algebra.embedding import embed_event, embed_plane, embed_point, extract_point


def close(a, b):
    return torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


@pytest.fixture
def points():
    return torch.randn(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))


def test_points_are_extracted_from_any_multiple(points):
    assert embed_point(points).shape == (6, 16)
    close(extract_point(-3 * embed_point(points)), points)


def test_three_planes_meet_in_a_point(points):
    planes = embed_plane(points[:3], points[:3] @ points[3])
    meet = PROJECTIVE.wedge(PROJECTIVE.wedge(planes[0], planes[1]), planes[2])
    close(extract_point(meet), points[3])


def test_three_points_join_in_their_plane(points):
    first, second, third = embed_point(points[:3])
    plane = PROJECTIVE.join(PROJECTIVE.join(first, second), third)
    assert plane[2:5].norm() > 0.1
    close(plane, embed_plane(plane[2:5], points[0] @ plane[2:5]))


def test_two_parallel_mirrors_translate_by_twice_their_distance(points):
    mirrors = embed_plane(
        torch.tensor([[0, 0, 2.0]]).double().expand(2, 3), torch.tensor([2.0, 5.0]).double()
    )
    moved = extract_point(
        PROJECTIVE.sandwich(PROJECTIVE.product(mirrors[1], mirrors[0]), embed_point(points))
    )
    close(moved, points + torch.tensor([0, 0, 3.0]).double())


def test_events_rotate_and_boost(points):
    first, second, time = torch.eye(16, dtype=torch.float64)[[1, 2, 4]]
    # Mirrors at planes 45 degrees apart rotate by 90 degrees, from e1 to e2.
    rotor = SPACETIME.product((first + second) / 2**0.5, first)
    x, y, z = points.unbind(-1)
    close(SPACETIME.sandwich(rotor, embed_event(points))[:, 1:4], torch.stack((-y, x, z), -1))
    boosted = SPACETIME.sandwich(SPACETIME.product(first + 0.5 * time, first), embed_event(points))
    assert (boosted[:, 4].abs() > 1e-3).all()  # it has a time now
    close(SPACETIME.inner(boosted, boosted), points.square().sum(-1))
