import functools

import numba
import numpy as np
import pytest
import torch

from gaigs.algebra import PROJECTIVE, SPACETIME, Algebra

numba.config.DISABLE_JIT = True  # compiling takes longer than these few products
import clifford  # noqa: E402

SIGNATURES = [(3, 0, 1), (3, 1, 0), (1, 2, 1)]
signatures = pytest.mark.parametrize("signature", SIGNATURES, ids=str)


@functools.cache
def layout_of(signature):
    return clifford.Cl(*signature)[0]  # each one compiles its own products


@pytest.fixture
def pair(signature):
    """Our algebra, the reference's layout, and eight random pairs of multivectors."""
    algebra, layout = Algebra(*signature), layout_of(signature)
    x, y = torch.randn(
        2, 8, algebra.size, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    return algebra, layout, x, y


def reference(layout, function, *multivectors):
    """Results of the clifford package for a batch."""
    rows = zip(*(x.numpy() for x in multivectors), strict=True)
    return torch.from_numpy(
        np.stack(
            [
                function(*(layout.MultiVector(value=row.copy()) for row in values)).value
                for values in rows
            ]
        )
    )


@signatures
def test_components_stand_in_the_order_of_the_reference(pair):
    algebra, layout, *_ = pair
    assert [len(blade) for blade in layout.bladeTupList] == list(algebra.grades)
    first = layout.bladeTupList[1][0]
    digits = [tuple(int(d) for d in blade[1:]) for blade in algebra.blades]
    start = digits[1][0]
    assert [tuple(v - start for v in blade) for blade in digits] == [
        tuple(v - first for v in blade) for blade in layout.bladeTupList
    ]


def test_blades_have_the_usual_names():
    assert PROJECTIVE.blades == tuple(
        "1 e0 e1 e2 e3 e01 e02 e03 e12 e13 e23 e012 e013 e023 e123 e0123".split()
    )
    assert SPACETIME.blades[:6] == ("1", "e1", "e2", "e3", "e4", "e12")
    assert PROJECTIVE.blades[PROJECTIVE.homogeneous] == "e123"


@signatures
@pytest.mark.parametrize(
    ("name", "function"),
    [
        ("product", lambda x, y: x * y),
        ("wedge", lambda x, y: x ^ y),
        ("join", lambda x, y: x.vee(y)),
    ],
)
def test_products_agree_with_clifford(pair, name, function):
    algebra, layout, x, y = pair
    torch.testing.assert_close(getattr(algebra, name)(x, y), reference(layout, function, x, y))


@signatures
def test_inner_products_involutions_and_grades_agree_with_clifford(pair):
    algebra, layout, x, y = pair
    torch.testing.assert_close(
        algebra.inner(x, y), reference(layout, lambda x, y: (~x * y)(0), x, y)[:, 0]
    )
    torch.testing.assert_close(algebra.reverse(x), reference(layout, lambda x: ~x, x))
    torch.testing.assert_close(algebra.involute(x), reference(layout, lambda x: x.gradeInvol(), x))
    for grade in range(algebra.dimension + 1):
        torch.testing.assert_close(
            algebra.grade(x, grade), reference(layout, lambda x, g=grade: x(g), x)
        )


@signatures
@pytest.mark.parametrize("count", [1, 2, 3])
def test_sandwich_agrees_with_clifford(pair, make_versor, count):
    algebra, layout, x, _ = pair
    versor = 2 * make_versor(algebra, count, torch.Generator().manual_seed(count))

    def sandwich(x):
        u = layout.MultiVector(value=versor.numpy())
        return u * (x.gradeInvol() if count % 2 else x) * ~u / float((u * ~u).value[0])

    torch.testing.assert_close(algebra.sandwich(versor, x), reference(layout, sandwich, x))


@pytest.mark.parametrize(("p", "q", "r"), [(1, 0, 0), (0, 2, 0), (0, 0, 1), (1, 1, 2), (4, 1, 0)])
def test_basis_vectors_square_to_the_signature(p, q, r):
    algebra = Algebra(p, q, r)
    vectors = torch.eye(algebra.size)[1 : algebra.dimension + 1]
    squares = algebra.product(vectors, vectors)
    assert squares[:, 0].tolist() == [0] * r + [1] * p + [-1] * q
    assert not squares[:, 1:].any()


def test_batches_broadcast():
    x, y = torch.randn(5, 1, 16), torch.randn(3, 16)
    product = PROJECTIVE.product(x, y)
    assert product.shape == (5, 3, 16)
    torch.testing.assert_close(product[4, 2], PROJECTIVE.product(x[4, 0], y[2]))
    assert PROJECTIVE.product(x[:0], y).shape == (0, 3, 16)


def test_tables_first_used_in_inference_mode_serve_training_later():
    algebra = Algebra(1, 1, 2)  # of no other test
    x = torch.randn(16)
    with torch.inference_mode():
        algebra.reverse(algebra.product(x, x))
    x.requires_grad_()
    algebra.reverse(algebra.product(x, x)).sum().backward()
    assert x.grad.any()


def test_impossible_signatures_and_versors_without_inverse_are_refused():
    for signature in ((0, 0, 0), (3, -1, 0)):
        with pytest.raises(ValueError, match="must have a basis vector and no negative count"):
            Algebra(*signature)
    with pytest.raises(ValueError, match="not null"):
        PROJECTIVE.sandwich(torch.eye(16)[1], torch.ones(16))
