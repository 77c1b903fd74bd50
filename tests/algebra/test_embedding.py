import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from gaigs.algebra import PROJECTIVE, SPACETIME, embedding
from gaigs.algebra.embedding import (
    embed_direction,
    embed_event,
    embed_plane,
    embed_point,
    embed_reflection,
    embed_rotor,
    embed_translator,
    extract_direction,
    extract_event,
    extract_plane,
    extract_point,
    extract_reflection,
    extract_rotor,
)

close = lambda a, b: torch.testing.assert_close(a, b, rtol=1e-9, atol=1e-9)


@pytest.fixture
def points():
    return torch.randn(6, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))


@pytest.mark.parametrize(
    ("kind", "width"), [("point", 3), ("direction", 3), ("rotor", 4), ("translator", 3), ("event", 3)]
)
def test_what_is_embedded_is_extracted(kind, width):
    values = torch.randn(2, 5, width)
    multivectors = getattr(embedding, f"embed_{kind}")(values)
    assert multivectors.shape == (2, 5, 16)
    torch.testing.assert_close(getattr(embedding, f"extract_{kind}")(multivectors), values)


def test_planes_and_reflections_are_extracted(points):
    offsets = torch.arange(6.0, dtype=torch.float64)
    normals, extracted = extract_plane(embed_plane(points, offsets))
    close(normals, points)
    close(extracted, offsets)
    length = points.norm(dim=-1)
    normals, extracted = extract_reflection(3 * embed_reflection(points, offsets))
    close(normals, points / length[:, None])
    close(extracted, offsets / length)


finite = st.floats(-3, 3)
triples = st.tuples(finite, finite, finite).map(lambda values: torch.tensor(values, dtype=torch.float64))


@given(triples, triples, st.integers(0, 1000))
def test_motions_move_points_and_directions(point, translation, seed):
    rotation = Rotation.random(rng=seed)
    quat = torch.from_numpy(rotation.as_quat(scalar_first=True))
    rotated = torch.from_numpy(rotation.apply(point.numpy()))
    rotor, translator = embed_rotor(quat), embed_translator(translation)
    close(PROJECTIVE.sandwich(rotor, embed_point(point)), embed_point(rotated))
    close(PROJECTIVE.sandwich(translator, embed_point(point)), embed_point(point + translation))
    both = PROJECTIVE.product(translator, rotor)
    close(PROJECTIVE.sandwich(both, embed_point(point)), embed_point(rotated + translation))
    close(PROJECTIVE.sandwich(both, embed_direction(point)), embed_direction(rotated))


def test_mirrored_directions_are_negated(points):
    mirror = embed_reflection(torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64), torch.tensor(3.0).double())
    flipped = points * torch.tensor([1.0, 1.0, -1.0])
    close(extract_direction(PROJECTIVE.sandwich(mirror, embed_direction(points))), -flipped)


def test_three_planes_meet_in_a_point(points):
    planes = embed_plane(points[:3], points[:3] @ points[3])
    meet = PROJECTIVE.wedge(PROJECTIVE.wedge(planes[0], planes[1]), planes[2])
    close(extract_point(meet), points[3])


def test_three_points_join_in_their_plane(points):
    first, second, third = embed_point(points[:3])
    normal, offset = extract_plane(PROJECTIVE.join(PROJECTIVE.join(first, second), third))
    assert normal.norm() > 0.1
    close(points[:3] @ normal, offset.expand(3))


def test_rotors_extract_unit_quaternions():
    quat = torch.from_numpy(Rotation.random(rng=3).as_quat(scalar_first=True))
    close(extract_rotor(PROJECTIVE.product(embed_rotor(quat), embed_rotor(quat)))[0], 2 * quat[0] ** 2 - 1)


def test_events_rotate_and_boost(points):
    first, second = (torch.eye(16, dtype=torch.float64)[i] for i in (1, 2))
    # Mirrors at planes 45 degrees apart rotate by 90 degrees, from e1 to e2.
    rotor = SPACETIME.product((first + second) / 2**0.5, first)
    x, y, z = points.unbind(-1)
    close(extract_event(SPACETIME.sandwich(rotor, embed_event(points))), torch.stack((-y, x, z), -1))
    boost = SPACETIME.product(first + 0.5 * torch.eye(16, dtype=torch.float64)[4], first)
    boosted = SPACETIME.sandwich(boost, embed_event(points))
    assert (boosted[:, 4].abs() > 1e-3).all()  # it has a time now
    close(SPACETIME.inner(boosted, boosted), points.square().sum(-1))


def test_a_mirror_without_a_normal_is_refused():
    with pytest.raises(ValueError, match="length zero"):
        embed_reflection(torch.zeros(3), torch.tensor(1.0))
