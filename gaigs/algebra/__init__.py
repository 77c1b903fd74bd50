"""Clifford (geometric) algebras of any signature, on batches of multivectors."""

import functools
import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Algebra:
    """The Clifford algebra G(p, q, r).

    Of n = p + q + r basis vectors p have the square +1, q the square -1 and r the square 0. A
    multivector is the last axis of a tensor: ``k = 2**n`` components, one for each basis blade.
    Basis vectors are ordered null, positive, negative. Blades are sorted by grade, then by their
    vectors. Vectors are numbered from e0 if there is a null vector, otherwise from e1:

    - G(3,0,1), ``PROJECTIVE``: e0² = 0, e1² = e2² = e3² = 1, components
      ``1, e0, e1, e2, e3, e01, e02, e03, e12, e13, e23, e012, e013, e023, e123, e0123``;
    - G(3,1,0), ``SPACETIME``: e1² = e2² = e3² = 1, e4² = -1, components
      ``1, e1, e2, e3, e4, e12, e13, e14, e23, e24, e34, e123, e124, e134, e234, e1234``.

    Every operation accepts any leading axes, device and dtype, and is differentiable.

    Args:
        p, q, r: The signature.

    Raises:
        ValueError: There is no basis vector, or a count is negative.

    Source: GAI-GS, "Geometric Algebra"; Roelfs & De Keninck, Graded Symmetry Groups, 2023.

    Example:
        >>> from gaigs.algebra import PROJECTIVE
        >>> from gaigs.algebra.embedding import embed_plane, embed_point, extract_point
        >>> wall = embed_plane(torch.tensor([1.0, 0.0, 0.0]), torch.tensor(4.0))  # x = 4 m
        >>> place = torch.tensor([1.0, 2.0, 1.5], requires_grad=True)
        >>> image = extract_point(PROJECTIVE.sandwich(wall, embed_point(place)))  # in the mirror
        >>> image
        tensor([7.0000, 2.0000, 1.5000], grad_fn=<DivBackward0>)
        >>> line = PROJECTIVE.join(embed_point(place), embed_point(image))  # through both
    """

    p: int
    q: int = 0
    r: int = 0

    def __post_init__(self):
        if min(self.p, self.q, self.r) < 0 or self.dimension == 0:
            raise ValueError(
                f"a signature (p, q, r) must have a basis vector and no negative count, got {self}"
            )

    @property
    def dimension(self) -> int:
        """Number of basis vectors n."""
        return self.p + self.q + self.r

    @property
    def size(self) -> int:
        """Number of components k of a multivector."""
        return 2**self.dimension

    @property
    def blades(self) -> tuple[str, ...]:
        """Names of the components: "1", "e0", ..., "e0123"."""
        first = 0 if self.r else 1
        names = ["1"]
        for blade in _vectors(self.dimension)[1:]:
            names.append("e" + "".join(str(vector + first) for vector in blade))
        return tuple(names)

    @property
    def grades(self) -> tuple[int, ...]:
        """Number of vectors in every blade."""
        return tuple(len(blade) for blade in _vectors(self.dimension))

    @property
    def homogeneous(self) -> int:
        """Index of the blade of all non-null vectors: e123, the weight of a point."""
        return _vectors(self.dimension).index(tuple(range(self.r, self.dimension)))

    def product(
        self, x: Float[Tensor, "*#batch k"], y: Float[Tensor, "*#batch k"]
    ) -> Float[Tensor, "*batch k"]:
        """Geometric product x y; of vectors, x y = x · y + x ∧ y, eq. (5) of GAI-GS."""
        return self._multiply("product", x, y)

    def wedge(
        self, x: Float[Tensor, "*#batch k"], y: Float[Tensor, "*#batch k"]
    ) -> Float[Tensor, "*batch k"]:
        """Outer product x ∧ y; in the projective algebra the intersection, e.g. of two planes."""
        return self._multiply("wedge", x, y)

    def join(
        self, x: Float[Tensor, "*#batch k"], y: Float[Tensor, "*#batch k"]
    ) -> Float[Tensor, "*batch k"]:
        """Regressive product x ∨ y: the dual of the wedge of both duals.

        The join of two projective points is the line through both. A mirror u, like every odd
        versor, also changes the sign of a join: join(ux, uy) = -u join(x, y).
        """
        return self._multiply("join", x, y)

    def product_and_join(
        self, x: Float[Tensor, "*#batch k"], y: Float[Tensor, "*#batch k"]
    ) -> tuple[Float[Tensor, "*batch k"], Float[Tensor, "*batch k"]]:
        """``product`` and ``join`` of the same multivectors in one multiplication."""
        product, join = self._multiply("product_and_join", x, y).chunk(2, -1)
        return product, join

    def inner(
        self, x: Float[Tensor, "*#batch k"], y: Float[Tensor, "*#batch k"]
    ) -> Float[Tensor, "*batch"]:
        """Invariant inner product, the scalar part of reverse(x) y; 0 for blades with e0."""
        return (x * y * self.table("metric", x)).sum(-1)

    def reverse(self, x: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch k"]:
        """Reversal: the vectors of every blade in opposite order."""
        return x * self.table("reverse", x)

    def involute(self, x: Float[Tensor, "*batch k"]) -> Float[Tensor, "*batch k"]:
        """Grade involution: odd grades change sign."""
        return x * self.table("involute", x)

    def grade(self, x: Float[Tensor, "*batch k"], grade: int) -> Float[Tensor, "*batch k"]:
        """Projection to one grade."""
        return x * self.table("grades", x)[grade]

    def sandwich(
        self, versor: Float[Tensor, "*#batch k"], x: Float[Tensor, "*#batch k"]
    ) -> Float[Tensor, "*batch k"]:
        """Motion of x by a versor u: u x u⁻¹ for an even u, u involute(x) u⁻¹ for an odd one.

        A versor is a product of vectors, even or odd by their number. A vector u reflects in the
        hyperplane orthogonal to it. Products of vectors rotate and translate.

        Raises:
            ValueError: u has no inverse.

        Source: GAI-GS, eq. (6) and (7).
        """
        square = self.inner(versor, versor)[..., None]  # u reverse(u), so u⁻¹ = reverse(u) / square
        if not (square != 0).all():
            raise ValueError(
                "a versor must be a product of vectors that are not null, "
                "got one whose square is zero"
            )
        # Even and odd parts of x are moved separately: involute(u) has the sign of an odd versor.
        odd = (x - self.involute(x)) / 2
        moved = self.product(versor, x - odd) + self.product(self.involute(versor), odd)
        return self.product(moved, self.reverse(versor)) / square

    def table(self, name: str, like: Tensor) -> Tensor:
        """A constant of the algebra on the device and in the dtype of ``like``.

        ``product``, ``wedge``, ``join`` (k*k, k): row i*k + j holds blade i times blade j.
        ``metric``, ``reverse``, ``involute`` (k,): a factor a blade. ``grades`` (n+1, k): 1 where a
        blade has the grade. ``ideal`` (k,): for blades of points at infinity (r = 1) the metric of
        their non-null vectors, else 0. ``null_wedges`` (2**r, k, k): matrix of the wedge with each
        blade of null vectors (the first is 1). ``linear_maps`` (2**r, k): number of the equivariant
        linear map (``layers.EquivariantLinear``) that leads from each of these wedges to a
        component.
        """
        return _table(self, name, like.dtype, like.device)

    def _multiply(self, name: str, x: Tensor, y: Tensor) -> Tensor:
        """The bilinear product of a table; ``product_and_join`` gives 2 k components."""
        # One matrix multiplication, components first in memory, is a third faster than gathering
        # non-zero terms.
        x, y = torch.broadcast_tensors(x, y)
        batch = x.shape[:-1]
        left = x.movedim(-1, 0).reshape(self.size, batch.numel())  # (k, batch)
        right = y.movedim(-1, 0).reshape(self.size, batch.numel())
        pairs = (left[:, None] * right).flatten(0, 1)  # x_i y_j, (k k, batch)
        result = self.table(name, x).mT @ pairs  # (k or 2 k, batch)
        return result.reshape(len(result), *batch).movedim(0, -1)


PROJECTIVE = Algebra(3, 0, 1)
"""Projective geometric algebra of space: planes are vectors, lines bivectors, points trivectors.

It is GATr's.
"""

SPACETIME = Algebra(3, 1, 0)
"""Space-time algebra with the metric (+, +, +, -), of the paper's section "Geometric Algebra".

Events are vectors e1, e2, e3 (space) and e4 (time).
"""


@functools.cache
def _vectors(dimension: int) -> tuple[tuple[int, ...], ...]:
    """Basis vectors of every blade, by grade."""
    blades: list[tuple[int, ...]] = []
    for grade in range(dimension + 1):
        blades += itertools.combinations(range(dimension), grade)
    return tuple(blades)


@functools.cache
def _tables(algebra: Algebra) -> dict[str, Tensor]:
    """The constants of a signature, float64 on the CPU; ``Algebra.table`` describes them."""
    blades = _vectors(algebra.dimension)
    product, disjoint = _products(algebra)  # (k, k, k), (k, k, 1)
    wedge = product * disjoint
    dual = wedge[:, :, -1]  # signed complement: blade i times blade j is the pseudoscalar
    join = torch.einsum("ia,jb,abc,kc->ijk", dual, dual, wedge, dual)
    count = torch.tensor(algebra.grades)  # vectors in each blade
    metric = [_square(algebra, blade) for blade in blades]
    # Points at infinity: the blades of a point's grade that hold the one null vector, with the
    # metric of the others.
    ideal = []
    for blade in blades:
        is_ideal = algebra.r == 1 and len(blade) == algebra.dimension - 1 and 0 in blade
        ideal.append(_square(algebra, blade[1:]) if is_ideal else 0.0)
    null_blades = []
    for i, blade in enumerate(blades):
        if all(vector < algebra.r for vector in blade):
            null_blades.append(i)
    return {
        "product": product.flatten(0, 1),
        "wedge": wedge.flatten(0, 1),
        "join": join.flatten(0, 1),
        "product_and_join": torch.cat((product, join), -1).flatten(0, 1),
        "metric": torch.tensor(metric, dtype=torch.float64),
        "ideal": torch.tensor(ideal, dtype=torch.float64),
        "reverse": (-1.0) ** (count * (count - 1) // 2).double(),
        "involute": (-1.0) ** count.double(),
        "grades": (count == torch.arange(algebra.dimension + 1)[:, None]).double(),
        "null_wedges": wedge[null_blades].mT,
        "linear_maps": _number_maps(algebra, null_blades),
    }


def _square(algebra: Algebra, vectors: Iterable[int]) -> float:
    """Product of the squares of basis vectors."""
    squares = [0.0] * algebra.r + [1.0] * algebra.p + [-1.0] * algebra.q
    return math.prod(squares[vector] for vector in vectors)


def _products(algebra: Algebra) -> tuple[Tensor, Tensor]:
    """Products of all pairs of blades (k, k, k), and 1 for pairs that share no vector (k, k, 1).

    Entry [i, j, l] of the products is the component of blade l in blade i times blade j.
    """
    blades = _vectors(algebra.dimension)
    position = {frozenset(blade): index for index, blade in enumerate(blades)}
    size = algebra.size
    product = torch.zeros(size, size, size, dtype=torch.float64)
    disjoint = torch.zeros(size, size, 1, dtype=torch.float64)
    for i, a in enumerate(blades):
        for j, b in enumerate(blades):
            common = set(a) & set(b)
            # Exchanges of neighbours that bring the vectors of a and b into order.
            exchanges = sum(v > w for v, w in itertools.product(a, b))
            k = position[frozenset(a) ^ frozenset(b)]
            product[i, j, k] = (-1.0) ** exchanges * _square(algebra, common)
            disjoint[i, j] = not common
    return product, disjoint


def _number_maps(algebra: Algebra, null_blades: list[int]) -> Tensor:
    """Numbers of the equivariant linear maps by blade of null vectors and component (2**r, k).

    Motions leave null vectors unchanged. So the wedge with a blade of null vectors, including 1, is
    an equivariant map of each grade. Maps are numbered by blade, then by grade.
    """
    grades = torch.tensor(algebra.grades)
    first = 0
    maps = []
    for blade in null_blades:
        grade = algebra.grades[blade]
        highest = algebra.dimension - grade
        maps.append(first + (grades - grade).clamp(0, highest))
        first += highest + 1
    return torch.stack(maps)


@functools.cache
def _table(algebra: Algebra, name: str, dtype: torch.dtype, device: torch.device) -> Tensor:
    """``Algebra.table`` in a dtype on a device."""
    # A tensor first made in inference mode (Lightning's validation) could not be saved for a later
    # backward pass.
    with torch.inference_mode(False):
        return _tables(algebra)[name].to(device, dtype)
