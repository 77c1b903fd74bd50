"""Products of arbitrary multivectors and mirrors of arbitrary planes."""

import torch
from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import coordinates, normals, points, tensors

from gaigs.algebra import PROJECTIVE, SPACETIME
from gaigs.algebra.embedding import embed_point, embed_reflection, extract_point
from gaigs.placement.mirrored.reflections import all_sequences, fold, images, reflect

algebras = st.sampled_from([PROJECTIVE, SPACETIME])
multivectors = tensors(st.floats(-2, 2, width=32), 16)
planes = st.tuples(normals(), coordinates.map(lambda offset: torch.tensor(offset, dtype=torch.float64)))


@given(algebras, st.lists(multivectors, min_size=1, max_size=3), multivectors, multivectors)
def test_a_versor_keeps_inner_products(algebra, vectors, x, y):
    """And so sizes: its sandwich is an isometry, and the reverse of the versor undoes it."""
    versor = torch.nn.functional.one_hot(torch.tensor(0), 16).double()
    for vector in vectors:
        vector = algebra.grade(vector, 1)
        square = algebra.inner(vector, vector)
        assume(square.abs() > 0.5 * vector.square().sum())
        assume(square.abs() > 1e-3)
        versor = algebra.product(versor, vector / square.abs().sqrt())
    moved = [algebra.sandwich(versor, part) for part in (x, y)]
    torch.testing.assert_close(algebra.inner(*moved), algebra.inner(x, y), rtol=0, atol=1e-6)
    back = algebra.sandwich(algebra.reverse(versor), moved[0])
    torch.testing.assert_close(back, x, rtol=0, atol=1e-6)


@given(planes, points)
def test_reflecting_twice_is_nothing(plane, point):
    once = reflect(point, *plane)
    torch.testing.assert_close(reflect(once, *plane), point, rtol=0, atol=1e-10)
    versor = embed_reflection(*plane)
    torch.testing.assert_close(extract_point(PROJECTIVE.sandwich(versor, embed_point(point))), once, rtol=0, atol=1e-9)


@given(st.lists(planes, min_size=1, max_size=3), points, points, st.integers(1, 3))
def test_a_folded_path_is_as_long_as_the_straight_line_from_the_image(walls, transmitter, receiver, order):
    normal, offset = (torch.stack(part) for part in zip(*walls, strict=True))
    words = all_sequences(len(walls), order)
    seen = images(transmitter[None], words, normal, offset)
    folded = fold(seen, receiver[None], words, normal, offset)
    straight = (seen[-1] - receiver).norm(dim=-1)
    legs = (folded.end - folded.start).norm(dim=-1)
    ways = torch.zeros_like(straight).index_add(1, folded.path, legs)
    assert ways.isfinite().all()
    assert (ways - straight)[folded.exists].abs().max() < 1e-6
    assert folded.exists[0, 0]
    for bounce in folded.bounces:
        beside = (bounce.points * normal[bounce.planes]).sum(-1) - offset[bounce.planes]
        meets = folded.exists[:, bounce.first :]
        assert beside[meets].abs().sum() < 1e-6
        assert bounce.cosines.ge(0).all()
        assert bounce.cosines.le(1 + 1e-9).all()


@given(st.lists(planes, min_size=1, max_size=3), points, points, st.integers(1, 3))
def test_there_and_back_are_equally_far(walls, transmitter, receiver, order):
    """Reciprocity: the image of the one in planes is as far from the other as the other way round."""
    normal, offset = (torch.stack(part) for part in zip(*walls, strict=True))
    words = all_sequences(len(walls), order)
    turned = torch.stack([torch.cat((word[word < 0], word[word >= 0].flip(0))) for word in words])
    there = (images(transmitter[None], words, normal, offset)[-1] - receiver).norm(dim=-1)
    back = (images(receiver[None], turned, normal, offset)[-1] - transmitter).norm(dim=-1)
    torch.testing.assert_close(there, back, rtol=1e-9, atol=1e-9)
