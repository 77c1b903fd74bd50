"""Null, huge and nearly parallel multivectors: versors and equivariant layers against float64."""

import math

import pytest
import torch
from precision import DTYPES, require_same

from gaigs.algebra import PROJECTIVE, SPACETIME
from gaigs.algebra.embedding import embed_plane, embed_point, extract_point
from gaigs.algebra.layers import (
    EquivariantLinear,
    GATrBlock,
    GeometricAttention,
    GeometricBilinear,
    equivariant_norm,
    gated_gelu,
)

ALGEBRAS = {"projective": PROJECTIVE, "spacetime": SPACETIME}
B, TOKENS, C, S = 2, 5, 4, 4


def random(*shape):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(0))


def light_like(algebra):
    """Vectors whose square is zero: e0 of the projective algebra, e1 + e4 of space-time."""
    x = torch.zeros(B, TOKENS, C, algebra.size)
    x[..., 1] = 1
    if algebra is SPACETIME:
        x[..., 4] = 1
    return x


def at_infinity(algebra):
    """Points at infinity; in space-time all blades with a light-like vector."""
    if algebra is PROJECTIVE:
        points = embed_point(random(B, TOKENS, C, 3))
        points[..., PROJECTIVE.homogeneous] = 0
        return points
    return algebra.product(random(B, TOKENS, C, algebra.size), light_like(algebra))


TOKENS_OF = {
    "nothing": lambda algebra: torch.zeros(B, TOKENS, C, algebra.size),
    "null vectors": light_like,
    "null vectors of 1e4": lambda algebra: 1e4 * light_like(algebra),
    "points at infinity": at_infinity,
    "nearly at infinity": lambda algebra: (
        at_infinity(algebra) + 1e-6 * random(B, TOKENS, C, algebra.size)
    ),
    "all alike": lambda algebra: random(1, 1, 1, algebra.size).expand(B, TOKENS, C, -1),
    "tiny": lambda algebra: 1e-20 * random(B, TOKENS, C, algebra.size),
    "denormal": lambda algebra: 1e-42 * random(B, TOKENS, C, algebra.size),
    "of 1e4": lambda algebra: 1e4 * random(B, TOKENS, C, algebra.size),
    "one huge among others": lambda algebra: (
        random(B, TOKENS, C, algebra.size) * (1 + 1e5 * (torch.arange(TOKENS) == 2))[:, None, None]
    ),
}


LAYERS = {
    "linear": (lambda algebra: EquivariantLinear(algebra, (C, 6), (S, 2)), lambda m, x, s: m(x, s)),
    "bilinear": (
        lambda algebra: GeometricBilinear(algebra, C, S),
        lambda m, x, s: m(x, s, x.mean((-3, -2))),
    ),
    "attention": (
        lambda algebra: GeometricAttention(algebra, C, S, 2),
        lambda m, x, s: m(*equivariant_norm(m.algebra, x, s)),
    ),
    "block": (
        lambda algebra: GATrBlock(algebra, C, S, 2),
        lambda m, x, s: m(x, s, x.mean((-3, -2))),
    ),
    "norm": (torch.nn.Identity, None),
    "gelu": (torch.nn.Identity, lambda m, x, s: gated_gelu(x, s)),
}


@pytest.mark.parametrize("algebra", ALGEBRAS)
@pytest.mark.parametrize("layer", LAYERS)
@pytest.mark.parametrize("tokens", TOKENS_OF)
def test_layers_are_finite_and_those_of_float64(algebra, layer, tokens):
    algebra = ALGEBRAS[algebra]
    make, ask = LAYERS[layer]
    ask = ask or (lambda m, x, s: equivariant_norm(algebra, x, s))
    torch.manual_seed(0)
    x = TOKENS_OF[tokens](algebra)
    # Squares of light-like vectors of 1e4 cancel but for float32's last digits: only finite values
    # are required.
    within = math.inf if tokens == "null vectors of 1e4" else 0
    require_same(ask, make(algebra), x, random(B, TOKENS, S), tolerance=2e-3, within=within)


# --- mirrors ---

TURNS = [0.0, 1e-12, 1e-7, 1e-4, 0.1, math.pi / 2, math.pi - 1e-7, math.pi]


@pytest.mark.parametrize("dtype", DTYPES, ids=["float32", "float64"])
@pytest.mark.parametrize("turn", TURNS)
@pytest.mark.parametrize("apart", [0.0, 1e-7, 1.0, 1e3])
def test_two_mirrors_turn_by_twice_their_angle(dtype, turn, apart):
    normals = torch.tensor(
        [[1.0, 0, 0], [math.cos(turn), math.sin(turn), 0]], dtype=dtype
    ).requires_grad_()
    offsets = torch.tensor([0.5, 0.5 + apart], dtype=dtype).requires_grad_()
    first, second = embed_plane(normals, offsets)
    versor = PROJECTIVE.product(second, first)
    eps = torch.finfo(dtype).eps
    assert PROJECTIVE.inner(versor, versor).item() == pytest.approx(1, abs=20 * eps)
    points = 3 * random(6, 3).to(dtype)
    moved = extract_point(PROJECTIVE.sandwich(versor, embed_point(points)))
    expected = points
    for normal, offset in zip(normals, offsets, strict=True):
        expected = expected - 2 * (expected @ normal - offset)[:, None] * normal
    assert (moved - expected).abs().max().item() <= 60 * eps * (10 + 2 * apart)
    gradients = torch.autograd.grad(moved.sum(), (normals, offsets))
    assert all(gradient.isfinite().all() for gradient in gradients)
