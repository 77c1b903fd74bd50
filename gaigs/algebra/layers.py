"""Layers that commute with every motion of space: the Geometric Algebra Transformer (GATr) for any
signature.

Tokens carry two kinds of channels, ``multivectors`` (b, tokens, channels, k) and ``scalars`` (b,
tokens, channels). A layer f is equivariant: f(u x) = u f(x) where u acts by ``Algebra.sandwich``,
for rotations, translations and mirrors, or the Lorentz group in space-time; scalars stay as they
are. Nothing depends on the order of the tokens.

Source: Brehmer et al., Geometric Algebra Transformer, 2023; Spinner et al., Lorentz-Equivariant
Geometric Algebra Transformers, 2024, for signatures with negative squares.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from gaigs.algebra import Algebra
from gaigs.algebra.mix import Mix

Multivectors = Float[Tensor, "... _ k"]
Scalars = Float[Tensor, "... _"]


class EquivariantLinear(nn.Module):
    """The most general equivariant linear map, learnt for every pair of channels (in, out).

    It is a sum of basis maps: the projection to each of the n + 1 grades and, with a null vector
    e0, e0 times each grade but the highest. Multiplication by the pseudoscalar is excluded, because
    a mirror changes its sign. Scalars mix with the multivectors' component 1, which has the bias.

    Source: GATr, proposition 2.
    """

    maps: Tensor

    def __init__(self, algebra: Algebra, multivectors: tuple[int, int], scalars: tuple[int, int]):
        super().__init__()
        self.algebra = algebra
        self.register_buffer(
            "maps", algebra.table("linear_maps", torch.empty(0)).long(), persistent=False
        )
        self.weight = nn.Parameter(
            torch.empty(int(self.maps.max()) + 1, multivectors[0], multivectors[1])
        )
        self.from_scalars = nn.Linear(scalars[0], multivectors[1])
        self.to_scalars = nn.Linear(multivectors[0] + scalars[0], scalars[1])
        # Weights of variance 1 / (channels in) keep the components' variance.
        bound = (3 / (multivectors[0] + scalars[0])) ** 0.5
        for weight in (self.weight, self.from_scalars.weight, self.to_scalars.weight):
            nn.init.uniform_(weight, -bound, bound)
        for layer in (self.from_scalars, self.to_scalars):
            nn.init.zeros_(layer.bias)

    def forward(self, multivectors: Multivectors, scalars: Scalars) -> tuple[Multivectors, Scalars]:
        device = self.weight.device.type
        if torch.is_autocast_enabled(device):  # computed in the precision of the weights
            with torch.autocast(device, enabled=False):
                return self(multivectors.to(self.weight.dtype), scalars.to(self.weight.dtype))
        null_wedges = self.algebra.table("null_wedges", self.weight)
        linears = (
            self.from_scalars.weight,
            self.from_scalars.bias,
            self.to_scalars.weight,
            self.to_scalars.bias,
        )
        return Mix.apply(multivectors, scalars, self.weight, *linears, self.maps, null_wedges)


class GeometricBilinear(nn.Module):
    """Products of learnt pairs of channels: the geometric product and the join of each.

    A mirror changes a join's sign, so joins are multiplied by the e123 component of a reference,
    whose sign it also changes. Without a null vector products alone reach every grade, so there are
    twice as many products and no joins.

    Source: GATr, "Geometric bilinears"; Spinner et al., 2024, without joins.
    """

    def __init__(self, algebra: Algebra, multivectors: int, scalars: int):
        super().__init__()
        if algebra.r and multivectors % 2:
            raise ValueError(
                f"multivectors must be even, got {multivectors}: one half are products, the other joins"
            )
        self.algebra = algebra
        factors = multivectors if algebra.r else 2 * multivectors
        self.factors = EquivariantLinear(algebra, (multivectors, factors), (scalars, scalars))
        self.output = EquivariantLinear(algebra, (multivectors, multivectors), (scalars, scalars))

    def forward(
        self, multivectors: Multivectors, scalars: Scalars, reference: Float[Tensor, "... k"]
    ) -> tuple[Multivectors, Scalars]:
        factors, scalars = self.factors(multivectors, scalars)
        left, right = factors.chunk(2, -2)
        if not self.algebra.r:
            return self.output(self.algebra.product(left, right), scalars)
        products, joins = self.algebra.product_and_join(left, right)
        orientation = reference[..., self.algebra.homogeneous, None, None, None]
        return self.output(torch.cat((products, orientation * joins), -2), scalars)


HOMOGENEOUS_FLOOR = 1e-3
"""Floor of h² in the division of a trivector by its e123 component h, which is 0 for a direction.
GATr's value.
"""


class GeometricAttention(nn.Module):
    """Multi-head attention of all tokens to all tokens, by invariants of their multivectors and
    scalars.

    The logit of a query and a key is their inner product plus the product of their scalars. The
    inner product ignores components with e0, and with them the positions of projective points. So
    in that algebra the logit also has minus the squared distance of two points, -w(g) w(h) |g y - h
    x|² for trivectors with e123 of g and h and other components x and y, with w(h) = h / (h² +
    floor).

    Args:
        multivectors, scalars: Channels, multiples of ``heads``.
        heads: Attention maps, each of an equal share of the channels.

    Source: GATr, "Geometric attention" and, for the distances, appendix "Distance-aware dot-product
    attention".
    """

    blades: Tensor
    ideal: Tensor
    form: Tensor

    def __init__(self, algebra: Algebra, multivectors: int, scalars: int, heads: int):
        super().__init__()
        if multivectors % heads or scalars % heads:
            raise ValueError(
                f"multivectors and scalars must be multiples of {heads} heads, got {multivectors}, {scalars}"
            )
        self.algebra = algebra
        self.heads = heads
        self.project = EquivariantLinear(
            algebra, (multivectors, 3 * multivectors), (scalars, 3 * scalars)
        )
        self.output = EquivariantLinear(algebra, (multivectors, multivectors), (scalars, scalars))
        metric, ideal = (algebra.table(name, torch.empty(0)) for name in ("metric", "ideal"))
        seen, ideal_blades = metric.nonzero().flatten(), ideal.nonzero().flatten()
        # Logits are a bilinear form of the features; the distance's is -g² y·y - h² x·x + 2 g h
        # x·y.
        form = torch.diag(metric[seen])
        if len(ideal_blades):
            distance = torch.tensor([[0.0, -1.0], [-1.0, 0.0]])
            form = torch.block_diag(form, distance, torch.diag(2 * ideal[ideal_blades]))
        self.parts = (len(seen), len(ideal_blades))
        self.register_buffer("blades", torch.cat((seen, ideal_blades)), persistent=False)
        self.register_buffer("ideal", ideal[ideal_blades], persistent=False)
        self.register_buffer("form", form, persistent=False)

    def features(self, multivectors: Multivectors) -> Float[Tensor, "*batch c f"]:
        """Factors of the logits: components of the inner product, and w(h) (x·x, h², h x) of
        points.
        """
        seen, x = multivectors.index_select(-1, self.blades).split(self.parts, -1)
        if not x.shape[-1]:
            return seen
        h = seen[..., -1:]  # the homogeneous coordinate is the last blade without e0
        weight = h / (h.square() + HOMOGENEOUS_FLOOR)
        size = (x.square() * self.ideal).sum(-1, keepdim=True)
        return torch.cat((seen, weight * torch.cat((size, h.square(), h * x), -1)), -1)

    def forward(self, multivectors: Multivectors, scalars: Scalars) -> tuple[Multivectors, Scalars]:
        query, key, value = self._project(multivectors, scalars)
        return self._read(
            functional.scaled_dot_product_attention(query, key, value).movedim(-3, -2)
        )

    def look(
        self, multivectors: Multivectors, scalars: Scalars, groups: tuple[int, int]
    ) -> tuple[Multivectors, Scalars]:
        """Attention of the first token of each group to its group and to the tokens common to all
        groups.

        Args:
            multivectors, scalars: One group after the other, then any common tokens.
            groups: Number of groups, and of tokens in each.
        """
        query, key, value = self._project(multivectors, scalars)
        own = math.prod(groups)
        query = query[:, :own].unflatten(1, groups)[:, :, 0]
        logits = (
            (key[:, :own].unflatten(1, groups) @ query[..., None]).squeeze(-1),
            query @ key[:, own:].mT,
        )
        weights = (torch.cat(logits, -1) * query.shape[-1] ** -0.5).softmax(-1)
        grouped, alike = weights.split((groups[1], key.shape[1] - own), -1)
        mixed = (grouped[..., None, :] @ value[:, :own].unflatten(1, groups)).squeeze(
            -2
        ) + alike @ value[:, own:]
        return self._read(mixed.movedim(0, 1))

    def _project(
        self, multivectors: Multivectors, scalars: Scalars
    ) -> list[Float[Tensor, "*batch heads tokens f"]]:
        multivectors, scalars = self.project(multivectors, scalars)
        # Query, key and value first, then heads before tokens.
        multivectors = multivectors.unflatten(-2, (3, self.heads, -1)).movedim((-4, -3), (0, -4))
        scalars = scalars.unflatten(-1, (3, self.heads, -1)).movedim((-3, -2), (0, -3))
        query_key, value = multivectors.split((2, 1))
        query, key = self.features(query_key)
        channels = zip((query @ self.form, key, value[0]), scalars, strict=True)
        return [torch.cat((x.flatten(-2), s), -1) for x, s in channels]

    def _read(self, mixed: Float[Tensor, "*tokens heads f"]) -> tuple[Multivectors, Scalars]:
        width = self.project.to_scalars.out_features // (3 * self.heads)
        multivectors, scalars = mixed.split((mixed.shape[-1] - width, width), -1)
        multivectors = multivectors.unflatten(-1, (-1, self.algebra.size)).flatten(-3, -2)
        return self.output(multivectors, scalars.flatten(-2))


NORM_FLOOR = 0.01
"""Added to the squared size, which may be zero for large tokens with e0 or light-like ones. GATr's
value.
"""


def equivariant_norm(
    algebra: Algebra, multivectors: Multivectors, scalars: Scalars
) -> tuple[Multivectors, Scalars]:
    """Layer normalisation: a token's multivectors by their mean size, its scalars by mean and
    variance.

    The squared size of a multivector is the sum over its grades of |inner(x, x)|: invariant, and
    without cancellation between grades in a signature of both signs.

    Source: GATr, "Layer normalization"; de Haan, Cohen & Brehmer, Euclidean, Projective, Conformal,
    2023.
    """
    by_grade = (algebra.table("grades", multivectors) * algebra.table("metric", multivectors)).mT
    size = (multivectors.square() @ by_grade).abs().sum(-1).mean(-1)
    multivectors = multivectors * torch.rsqrt(size + NORM_FLOOR)[..., None, None]
    return multivectors, functional.layer_norm(scalars, scalars.shape[-1:])


def gated_gelu(multivectors: Multivectors, scalars: Scalars) -> tuple[Multivectors, Scalars]:
    """Every multivector times the GELU of its component 1; scalars through a plain GELU.

    Source: GATr, "Scalar-gated nonlinearities".
    """
    return functional.gelu(multivectors[..., :1]) * multivectors, functional.gelu(scalars)


class GATrBlock(nn.Module):
    """A transformer block: attention, then products and a gated GELU, each on normalised tokens and
    added to them.

    Source: GATr, figure 1.
    """

    def __init__(self, algebra: Algebra, multivectors: int, scalars: int, heads: int = 4):
        super().__init__()
        self.algebra = algebra
        self.attention = GeometricAttention(algebra, multivectors, scalars, heads)
        self.bilinear = GeometricBilinear(algebra, multivectors, scalars)
        self.linear = EquivariantLinear(algebra, (multivectors, multivectors), (scalars, scalars))

    def forward(
        self, multivectors: Multivectors, scalars: Scalars, reference: Float[Tensor, "... k"]
    ) -> tuple[Multivectors, Scalars]:
        """Tokens after the block.

        ``reference`` moves with the tokens, such as the mean of the network's inputs; see
        ``GeometricBilinear``.
        """
        attended = self.attention(*equivariant_norm(self.algebra, multivectors, scalars))
        return self.transform(multivectors + attended[0], scalars + attended[1], reference)

    def look(
        self, multivectors: Multivectors, scalars: Scalars, groups: tuple[int, int]
    ) -> tuple[Multivectors, Scalars]:
        """The block's first half for the first token of each group alone; see
        ``GeometricAttention.look``.
        """
        attended = self.attention.look(
            *equivariant_norm(self.algebra, multivectors, scalars), groups
        )
        first, first_scalars = (
            x[: math.prod(groups)].unflatten(0, groups)[:, :1] for x in (multivectors, scalars)
        )
        return first + attended[0][:, None], first_scalars + attended[1][:, None]

    def transform(
        self, multivectors: Multivectors, scalars: Scalars, reference: Float[Tensor, "... k"]
    ) -> tuple[Multivectors, Scalars]:
        """The block's second half, for each token alone."""
        products = self.bilinear(*equivariant_norm(self.algebra, multivectors, scalars), reference)
        made = self.linear(*gated_gelu(*products))
        return multivectors + made[0], scalars + made[1]
