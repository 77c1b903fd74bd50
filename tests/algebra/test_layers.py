import pytest
import torch

from gaigs.algebra import PROJECTIVE, SPACETIME, Algebra
from gaigs.algebra.embedding import embed_point
from gaigs.algebra.layers import (
    EquivariantLinear,
    GATrBlock,
    GeometricAttention,
    GeometricBilinear,
    equivariant_norm,
    gated_gelu,
)

algebras = pytest.mark.parametrize(
    "algebra", [PROJECTIVE, SPACETIME, Algebra(2, 0, 1), Algebra(1, 1, 1)], ids=str
)
B, TOKENS, C, S = 2, 5, 4, 3


@pytest.fixture(autouse=True)
def seed():
    torch.manual_seed(0)


@pytest.fixture
def tokens(algebra):
    return torch.randn(B, TOKENS, C, algebra.size).double(), torch.randn(B, TOKENS, S).double()


def reference_of(multivectors):
    return multivectors.mean((-3, -2))


LAYERS = {
    "linear": (
        lambda algebra: EquivariantLinear(algebra, (C, 6), (S, 2)),
        lambda layer, x, s: layer(x, s),
    ),
    "bilinear": (
        lambda algebra: GeometricBilinear(algebra, C, S),
        lambda layer, x, s: layer(x, s, reference_of(x)),
    ),
    "attention": (
        lambda algebra: GeometricAttention(algebra, C, 2, heads=2),
        lambda layer, x, s: layer(x, s[..., :2]),
    ),
    "block": (
        lambda algebra: GATrBlock(algebra, C, 2, heads=2),
        lambda layer, x, s: layer(x, s[..., :2], reference_of(x)),
    ),
    "norm": (lambda algebra: torch.nn.Identity(), None),
    "gelu": (lambda algebra: torch.nn.Identity(), lambda layer, x, s: gated_gelu(x, s)),
}


@algebras
@pytest.mark.parametrize("name", LAYERS)
def test_layers_are_equivariant(algebra, name, tokens, check_equivariance):
    make, ask = LAYERS[name]
    layer, scalars = make(algebra).double(), tokens[1]
    ask = ask or (lambda layer, x, s: equivariant_norm(algebra, x, s))
    with torch.no_grad():
        for parameter_name, parameter in layer.named_parameters():
            if parameter_name.endswith("bias"):
                parameter.normal_()
    check_equivariance(algebra, lambda x: ask(layer, x, scalars), tokens[0])


@algebras
def test_linear_has_every_equivariant_map(algebra, make_versor):
    """Matrices that commute with mirrors in general position, counted as the null space of that
    condition.
    """
    eye = torch.eye(algebra.size, dtype=torch.float64)
    generator = torch.Generator().manual_seed(3)
    actions = [
        algebra.sandwich(make_versor(algebra, 1, generator), eye).contiguous() for _ in range(6)
    ]
    condition = torch.cat(
        [torch.kron(a, eye) - torch.kron(eye, a.mT.contiguous()) for a in actions]
    )
    singular = torch.linalg.svdvals(condition)
    layer = EquivariantLinear(algebra, (1, 1), (1, 1)).double()
    assert len(layer.weight) == (singular < 1e-9).sum()

    outputs = []
    for number in range(len(layer.weight)):
        torch.nn.init.zeros_(layer.weight)
        torch.nn.init.zeros_(layer.from_scalars.weight)
        layer.weight.data[number] = 1
        outputs.append(layer(eye[:, None], torch.zeros(algebra.size, 1).double())[0].flatten())
    assert torch.linalg.matrix_rank(torch.stack(outputs)) == len(layer.weight)


def test_bilinear_joins_points_to_lines():
    layer = GeometricBilinear(PROJECTIVE, 2, 1)
    points = embed_point(torch.randn(1, 1, 2, 3))
    with_join, _ = layer(points, torch.zeros(1, 1, 1), points.mean((1, 2)))
    without, _ = layer(points, torch.zeros(1, 1, 1), torch.zeros(1, 16))
    lines = slice(8, 11)  # e12, e13, e23: the direction of a line, which no product of points has
    assert not without[..., lines].any()
    assert with_join[..., lines].abs().max() > 1e-3


def test_attention_sees_the_distance_of_points():
    layer = GeometricAttention(PROJECTIVE, 1, 1, heads=1).double()
    points = torch.randn(2, 7, 3).double()
    query, key = layer.features(embed_point(points))
    logits = ((query @ layer.form) * key).sum(-1)
    squared = (points[0] - points[1]).square().sum(-1)
    torch.testing.assert_close(
        logits, 1 - squared / (1 + GeometricAttention.floor) ** 2
    )  # 1 of the two e123


@algebras
def test_norm_gives_unit_size(algebra, tokens):
    multivectors, scalars = equivariant_norm(algebra, 100 * tokens[0], tokens[1])
    grades = [algebra.grade(multivectors, g) for g in range(algebra.dimension + 1)]
    size = sum(algebra.inner(x, x).abs() for x in grades).mean(-1)
    torch.testing.assert_close(size, torch.ones_like(size), rtol=1e-4, atol=0)
    torch.testing.assert_close(scalars.mean(-1), torch.zeros(B, TOKENS).double())


@pytest.mark.parametrize("scale", [1e-30, 1e-2, 1.0, 1e6])
def test_norm_amplifies_no_more_than_its_floor_allows(scale):
    x = scale * torch.randn(100, 3, 16, dtype=torch.float64)
    for algebra in (PROJECTIVE, SPACETIME):
        normed, _ = equivariant_norm(algebra, x, torch.zeros(100, 2))
        assert (normed.abs() <= x.abs() * 0.01**-0.5 * (1 + 1e-12)).all()


@pytest.mark.parametrize("algebra", [PROJECTIVE, SPACETIME], ids=str)
def test_block_has_the_right_gradients(algebra):
    block = GATrBlock(algebra, 2, 1, heads=1).double()
    multivectors, scalars = torch.randn(1, 3, 2, 16).double(), torch.randn(1, 3, 1).double()
    inputs = multivectors.requires_grad_(), scalars.requires_grad_()
    assert torch.autograd.gradcheck(
        lambda x, s: block(x, s, reference_of(x)), inputs, fast_mode=True
    )


def test_channels_that_cannot_be_shared_are_refused():
    with pytest.raises(ValueError, match="must be multiples of 3 heads, got 6, 4"):
        GeometricAttention(PROJECTIVE, 6, 4, heads=3)
    with pytest.raises(ValueError, match="must be even, got 3"):
        GeometricBilinear(PROJECTIVE, 3, 2)


def plain_linear(layer, multivectors, scalars):
    """The sum over the maps, each a matrix of components: a grade alone, or e0 times a grade."""
    algebra, eye = layer.algebra, torch.eye(layer.algebra.size, dtype=torch.float64)
    grades = algebra.table("grades", eye)
    matrices = [torch.diag(grade) for grade in grades]
    if algebra.r:
        e0 = eye[algebra.blades.index("e0")]
        matrices += [(algebra.wedge(e0, eye) * grade[:, None]).mT for grade in grades[:-1]]
    assert len(matrices) == len(layer.weight)
    result = sum(
        torch.einsum("...ck,lk,cd->...dl", multivectors, matrix, weight)
        for matrix, weight in zip(matrices, layer.weight, strict=True)
    )
    ones = torch.nn.functional.pad(layer.from_scalars(scalars)[..., None], (0, algebra.size - 1))
    return result + ones, layer.to_scalars(torch.cat((multivectors[..., 0], scalars), -1))


@algebras
@pytest.mark.parametrize("batch", [(B, TOKENS), (1,), (0, 3), (3, 0)], ids=str)
@pytest.mark.parametrize("channels", [(C, 6), (1, 3)], ids=str)
def test_linear_is_the_sum_over_its_maps_and_so_are_its_gradients(algebra, batch, channels):
    layer = EquivariantLinear(algebra, channels, (S, 2)).double()
    torch.nn.init.normal_(layer.from_scalars.bias)
    multivectors = torch.randn(*batch, algebra.size, channels[0]).double().mT.requires_grad_()
    scalars = torch.randn(*batch, S).double().requires_grad_()
    before = multivectors.detach().clone()
    found, expected = layer(multivectors, scalars), plain_linear(layer, multivectors, scalars)
    weights = [torch.randn_like(part) for part in expected]
    wanted = (multivectors, scalars, *layer.parameters())
    gradients = [torch.autograd.grad(parts, wanted, weights) for parts in (found, expected)]
    for one, other in zip((*found, *gradients[0]), (*expected, *gradients[1]), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)
    assert torch.equal(multivectors, before)


def test_a_linear_map_in_mixed_precision_is_that_of_its_weights():
    layer = EquivariantLinear(PROJECTIVE, (2, 2), (1, 1))
    multivectors, scalars = torch.randn(3, 2, 16), torch.randn(3, 1, requires_grad=True)
    expected = layer(multivectors, scalars)
    with torch.autocast("cpu", torch.bfloat16):
        found = layer(multivectors, scalars)
    assert all(map(torch.equal, found, expected))
    assert torch.autograd.grad(found[1].sum(), scalars)[0].dtype == torch.float32


@algebras
@pytest.mark.parametrize("batch", [(), (3,)], ids=str)
@pytest.mark.parametrize("count", [0, 1, 4])
@pytest.mark.parametrize("alike", [0, 5])
def test_a_token_looks_at_one_of_the_first_and_at_all_behind(algebra, batch, count, alike):
    """Against the whole attention over the tokens that it sees, far from and near all logits."""
    block = GATrBlock(algebra, C, 4, heads=2).double()
    shape = (*batch, count + 1 + alike)
    multivectors = 3 * torch.randn(*shape, C, algebra.size).double()
    scalars = 3 * torch.randn(*shape, 4).double()
    for x in (multivectors, scalars):
        x.requires_grad_()
    found = block.look(multivectors, scalars, count)
    assert [part.shape for part in found] == [(*batch, count, C, algebra.size), (*batch, count, 4)]
    if not count:
        return
    expected = [[], []]
    for i in range(count):
        seen = torch.tensor([count, i, *range(count + 1, count + 1 + alike)])
        own = multivectors.index_select(-3, seen), scalars.index_select(-2, seen)
        attended = block.attention(*equivariant_norm(algebra, *own))
        expected[0].append((own[0] + attended[0])[..., :1, :, :])
        expected[1].append((own[1] + attended[1])[..., :1, :])
    expected = [torch.cat(expected[0], -3), torch.cat(expected[1], -2)]
    weights = [torch.randn_like(part) for part in expected]
    wanted = (multivectors, scalars, *block.attention.parameters())
    gradients = [torch.autograd.grad(parts, wanted, weights) for parts in (found, expected)]
    for one, other in zip((*found, *gradients[0]), (*expected, *gradients[1]), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-11)
