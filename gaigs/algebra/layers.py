"""Layers of the Geometric Algebra Transformer (GATr), for any signature.

Tokens have two kinds of channels, ``multivectors`` (b, tokens, channels, k) and ``scalars`` (b,
tokens, channels). A layer f is equivariant: f(u x) = u f(x), where u acts by ``Algebra.sandwich``.
u is a rotation, translation or mirror, in space-time a Lorentz transformation. Scalars are
invariant. The order of the tokens has no effect.

Source: Brehmer et al., Geometric Algebra Transformer, 2023; Spinner et al., Lorentz-Equivariant
Geometric Algebra Transformers, 2024, for signatures with negative squares.
"""

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
    e0, e0 times each grade except the highest. Multiplication by the pseudoscalar is excluded,
    since a mirror changes its sign. Scalars mix with the multivectors' component 1. Both have a
    bias.

    Args:
        algebra: The algebra.
        multivectors: Channels of multivectors, in and out.
        scalars: Channels of scalars, in and out.

    Source: GATr, proposition 2.
    """

    maps: Tensor

    def __init__(self, algebra: Algebra, multivectors: tuple[int, int], scalars: tuple[int, int]):
        super().__init__()
        self.algebra = algebra
        # Number of the basis map from each wedge with null vectors to each component.
        maps = algebra.table("linear_maps", torch.empty(0)).long()  # (2**r, k)
        self.register_buffer("maps", maps, persistent=False)
        # A matrix over channels for each basis map (maps, in, out).
        self.weight = nn.Parameter(torch.empty(int(maps.max()) + 1, *multivectors))
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
        return Mix.apply(
            multivectors,
            scalars,
            self.weight,
            self.from_scalars.weight,
            self.from_scalars.bias,
            self.to_scalars.weight,
            self.to_scalars.bias,
            self.maps,
            self.algebra.table("null_wedges", self.weight),
        )


class GeometricBilinear(nn.Module):
    """Geometric products and joins of learnt pairs of channels.

    A mirror changes a join's sign. Joins are therefore multiplied by the e123 component of a
    reference, whose sign changes, too. Without a null vector products reach every grade, so there
    are twice as many products and no joins.

    Raises:
        ValueError: The number of multivectors is odd, and there is a null vector.

    Source: GATr, "Geometric bilinears"; Spinner et al., 2024, without joins.
    """

    def __init__(self, algebra: Algebra, multivectors: int, scalars: int):
        super().__init__()
        if algebra.r and multivectors % 2:
            raise ValueError(
                f"multivectors must be even, got {multivectors}: "
                "one half are products, the other joins"
            )
        self.algebra = algebra
        factors = multivectors if algebra.r else 2 * multivectors
        self.factors = EquivariantLinear(algebra, (multivectors, factors), (scalars, scalars))
        self.output = EquivariantLinear(algebra, (multivectors, multivectors), (scalars, scalars))

    def forward(
        self, multivectors: Multivectors, scalars: Scalars, reference: Float[Tensor, "... k"]
    ) -> tuple[Multivectors, Scalars]:
        factors, scalars = self.factors(multivectors, scalars)  # (..., factors, k)
        left, right = factors.chunk(2, -2)  # (..., factors / 2, k) each
        if not self.algebra.r:
            return self.output(self.algebra.product(left, right), scalars)
        products, joins = self.algebra.product_and_join(left, right)
        # A mirror changes the signs of a join and of the reference's e123; their product stays.
        orientation = reference[..., self.algebra.homogeneous, None, None, None]
        return self.output(torch.cat((products, orientation * joins), -2), scalars)


class GeometricAttention(nn.Module):
    """Multi-head attention of all tokens to all tokens, by invariants, eq. (8) of GAI-GS.

    The logit of a query and a key is their inner product plus the product of their scalars. The
    inner product ignores components with e0, and so the positions of projective points. In that
    algebra minus the squared distance of two points is added. For trivectors (x, g) and (y, h),
    with the components g and h of e123, it is -w(g) w(h) |g y - h x|² with w(h) = h / (h² + floor).

    Args:
        multivectors, scalars: Channels, multiples of ``heads``.
        heads: Attention maps; each has an equal part of the channels.

    Attributes:
        floor: Number added to h² in w, since h is 0 for a direction; GATr's value.

    Raises:
        ValueError: A number of channels is not a multiple of ``heads``.

    Source: GAI-GS, eq. (8); GATr, "Geometric attention"; for the distances GATr, appendix
    "Distance-aware dot-product attention".
    """

    floor = 1e-3

    blades: Tensor
    ideal: Tensor
    form: Tensor

    def __init__(self, algebra: Algebra, multivectors: int, scalars: int, heads: int):
        super().__init__()
        if multivectors % heads or scalars % heads:
            raise ValueError(
                f"multivectors and scalars must be multiples of {heads} heads, "
                f"got {multivectors}, {scalars}"
            )
        self.algebra = algebra
        self.heads = heads
        self.project = EquivariantLinear(
            algebra, (multivectors, 3 * multivectors), (scalars, 3 * scalars)
        )
        self.output = EquivariantLinear(algebra, (multivectors, multivectors), (scalars, scalars))
        metric = algebra.table("metric", torch.empty(0))  # (k,)
        ideal = algebra.table("ideal", torch.empty(0))  # (k,)
        inner_blades = metric.nonzero().flatten()  # blades that the inner product sees
        ideal_blades = ideal.nonzero().flatten()
        # The logit of ``features`` a and b is a' form b. The features of a distance are (x·x, h²,
        # h x), and minus the squared distance, times g² h², is -g² x·x - h² y·y + 2 g h x·y.
        form = torch.diag(metric[inner_blades])
        if len(ideal_blades):
            distance = torch.tensor([[0.0, -1.0], [-1.0, 0.0]])
            form = torch.block_diag(form, distance, torch.diag(2 * ideal[ideal_blades]))
        self.parts = (len(inner_blades), len(ideal_blades))
        self.register_buffer("blades", torch.cat((inner_blades, ideal_blades)), persistent=False)
        self.register_buffer("ideal", ideal[ideal_blades], persistent=False)
        self.register_buffer("form", form, persistent=False)

    def features(self, multivectors: Multivectors) -> Float[Tensor, "*batch c f"]:
        """Factors of the logits: components of the inner product, and w(h) (x·x, h², h x).

        Algebras other than the projective one have no distances, and only the components.
        """
        components = multivectors.index_select(-1, self.blades)
        inner, x = components.split(self.parts, -1)
        if not x.shape[-1]:
            return inner
        h = inner[..., -1:]  # the homogeneous coordinate is the last blade without e0
        weight = h / (h.square() + self.floor)  # w(h)
        size = (x.square() * self.ideal).sum(-1, keepdim=True)  # x·x
        distances = torch.cat((size, h.square(), h * x), -1)
        return torch.cat((inner, weight * distances), -1)

    def forward(self, multivectors: Multivectors, scalars: Scalars) -> tuple[Multivectors, Scalars]:
        query, key, value = self._project(multivectors, scalars)  # (b, heads, tokens, f) each
        mixed = functional.scaled_dot_product_attention(query, key, value)
        return self._read(mixed.movedim(-3, -2))

    def look(
        self, multivectors: Multivectors, scalars: Scalars, count: int
    ) -> tuple[Multivectors, Scalars]:
        """Attention of one token, once for each of ``count`` alternatives, such as transmitters.

        The first ``count`` tokens are the alternatives, and the next token attends. Result i
        attends to alternative i, to the attending token and to all later tokens. There are
        ``count`` results.
        """
        query, key, value = self._project(multivectors, scalars)  # (*batch, heads, tokens, f)
        # eq. (8): softmax of the logits over the root of their number of features.
        query = query[..., count, :, None] * query.shape[-1] ** -0.5  # (*batch, heads, f, 1)
        logits = (key @ query).squeeze(-1)  # (*batch, heads, tokens)
        sizes = (count, key.shape[-2] - count)  # alternatives, and tokens that all results share
        alternative_logits, common_logits = logits.split(sizes, -1)
        alternatives, common = value.split(sizes, -2)  # (*batch, heads, tokens, f) each
        # The weight of one alternative with logit a, beside common tokens with logits c:
        # exp a / (exp a + sum exp c) = sigmoid(a - log sum exp c).
        log_sums = common_logits.logsumexp(-1, keepdim=True)
        weight = (alternative_logits - log_sums).sigmoid()[..., None]
        mean = common_logits.softmax(-1)[..., None, :] @ common  # (*batch, heads, 1, f)
        mixed = mean + weight * (alternatives - mean)
        return self._read(mixed.movedim(-3, -2))

    def _project(
        self, multivectors: Multivectors, scalars: Scalars
    ) -> list[Float[Tensor, "*batch heads tokens f"]]:
        """Query, key and value, each with a row of numbers for each head and token."""
        multivectors, scalars = self.project(multivectors, scalars)
        # Query, key and value first, then heads before tokens.
        multivectors = multivectors.unflatten(-2, (3, self.heads, -1))
        multivectors = multivectors.movedim((-4, -3), (0, -4))  # (3, *batch, heads, tokens, c, k)
        scalars = scalars.unflatten(-1, (3, self.heads, -1))
        scalars = scalars.movedim((-3, -2), (0, -3))  # (3, *batch, heads, tokens, s)
        query_key, value = multivectors.split((2, 1))
        query, key = self.features(query_key)  # (*batch, heads, tokens, c, features) each
        rows = []
        for numbers, own_scalars in zip((query @ self.form, key, value[0]), scalars, strict=True):
            rows.append(torch.cat((numbers.flatten(-2), own_scalars), -1))
        return rows

    def _read(self, mixed: Float[Tensor, "*tokens heads f"]) -> tuple[Multivectors, Scalars]:
        """Splits mixed values into multivectors and scalars of all heads; applies ``output``."""
        width = self.project.to_scalars.out_features // (3 * self.heads)  # scalars of a head
        multivectors, scalars = mixed.split((mixed.shape[-1] - width, width), -1)
        multivectors = multivectors.unflatten(-1, (-1, self.algebra.size))  # (*tokens, heads, c, k)
        multivectors = multivectors.flatten(-3, -2)  # (*tokens, heads c, k)
        return self.output(multivectors, scalars.flatten(-2))


def equivariant_norm(
    algebra: Algebra, multivectors: Multivectors, scalars: Scalars, floor: float = 0.01
) -> tuple[Multivectors, Scalars]:
    """Layer normalisation: multivectors by their mean size, scalars by mean and variance.

    The squared size of a multivector is the sum over its grades of |inner(x, x)|. It is invariant,
    and grades do not cancel in a signature of both signs.

    Args:
        algebra: The algebra.
        multivectors, scalars: Tokens.
        floor: Number added to the squared size; GATr's value. The size is zero for a token that has
            only components with e0, and for light-like tokens.

    Source: GATr, "Layer normalization"; de Haan, Cohen & Brehmer, Euclidean, Projective, Conformal,
    2023.
    """
    metric = algebra.table("metric", multivectors)
    if algebra.q:
        by_grade = (algebra.table("grades", multivectors) * metric).mT  # (k, n + 1)
        sizes = (multivectors.square() @ by_grade).abs().sum(-1)  # (..., c)
    else:  # no square is negative, so the sum over grades is one over blades
        sizes = multivectors.square() @ metric  # (..., c)
    size = sizes.mean(-1)  # (...)
    multivectors = multivectors * torch.rsqrt(size + floor)[..., None, None]
    return multivectors, functional.layer_norm(scalars, scalars.shape[-1:])


def gated_gelu(multivectors: Multivectors, scalars: Scalars) -> tuple[Multivectors, Scalars]:
    """Every multivector times the GELU of its component 1; the plain GELU of scalars.

    Source: GATr, "Scalar-gated nonlinearities".
    """
    return functional.gelu(multivectors[..., :1]) * multivectors, functional.gelu(scalars)


class GATrBlock(nn.Module):
    """A transformer block: attention, then products and a gated GELU.

    Both halves normalise their tokens and have a residual connection.

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

        Args:
            multivectors, scalars: Tokens.
            reference: A multivector that moves with the tokens, such as the mean of the network's
                inputs; see ``GeometricBilinear``.
        """
        normalised = equivariant_norm(self.algebra, multivectors, scalars)
        attended, attended_scalars = self.attention(*normalised)
        return self.transform(multivectors + attended, scalars + attended_scalars, reference)

    def look(
        self, multivectors: Multivectors, scalars: Scalars, count: int
    ) -> tuple[Multivectors, Scalars]:
        """The first half of the block for one token, once for each of ``count`` alternatives.

        The first ``count`` tokens are the alternatives, and the next token attends, see
        ``GeometricAttention.look``. ``transform`` is the second half.
        """
        normalised = equivariant_norm(self.algebra, multivectors, scalars)
        attended, attended_scalars = self.attention.look(*normalised, count)
        attending = slice(count, count + 1)
        multivectors = multivectors[..., attending, :, :] + attended
        return multivectors, scalars[..., attending, :] + attended_scalars

    def transform(
        self, multivectors: Multivectors, scalars: Scalars, reference: Float[Tensor, "... k"]
    ) -> tuple[Multivectors, Scalars]:
        """The second half of the block, for each token separately; arguments as for ``forward``."""
        normalised = equivariant_norm(self.algebra, multivectors, scalars)
        products = self.bilinear(*normalised, reference)
        change, scalar_change = self.linear(*gated_gelu(*products))
        return multivectors + change, scalars + scalar_change
