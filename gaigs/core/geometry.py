"""Poses, quaternions, coordinates, harmonics and grids of directions (docs/conventions.md)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from numbers import Integral, Real

import numpy as np
import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor
from torch.nn.functional import normalize

FAINTEST = torch.finfo(torch.float32).tiny
"""Smaller amplitudes and powers count as 0: dividing by such a float32 number overflows."""


class ExtrapolationWarning(UserWarning):
    """A prediction is far from all measurements."""


@dataclass(frozen=True)
class Frame:
    """Place of the world frame on a map: an EPSG code, and the origin's x and y [m] there.

    Raises:
        ValueError: The system does not exist, its unit is not the metre, or the origin is outside
            the system. Without pyproj only UTM systems are checked.

    Example:
        >>> places = [[10.0, 20.0, 1.5], [30.0, 5.0, 1.5], [0.0, 9.0, 1.5]]
        >>> frame = gaigs.Frame(32632, 450000.0, 5400000.0)  # UTM less this easting and northing
        >>> links = gaigs.links(
        ...     task="rssi", transmitters=places, receivers=[0, 0, 9], labels=[-50.0, -60.0, -55.0],
        ...     frame=frame,
        ... )
        >>> links.frame.epsg
        32632
    """

    epsg: int
    x: float
    y: float

    def __post_init__(self) -> None:
        remedy = (
            "gaigs.data.maps.to_utm converts degrees and feet into metres of UTM, and gives its "
            "code"
        )
        is_number = (
            isinstance(self.epsg, Integral)
            and isinstance(self.x, Real)
            and isinstance(self.y, Real)
        )
        if not is_number or not math.isfinite(self.x + self.y) or self._is_elsewhere():
            raise ValueError(
                "a frame must be an EPSG code with an easting and a northing [m], got "
                f"{self}\n{remedy}"
            )
        if is_utm(self.epsg) or find_spec("pyproj") is None:
            return
        import pyproj

        try:
            system = pyproj.CRS.from_epsg(self.epsg)
        except pyproj.exceptions.CRSError:
            raise ValueError(f"there is no coordinate system EPSG:{self.epsg}\n{remedy}") from None
        units = [axis.unit_name for axis in system.axis_info[:2]]
        if not system.is_projected or units != ["metre", "metre"]:
            given = f"EPSG:{self.epsg}, {system.name} in {units[0]}"
            raise ValueError(f"a frame must be a projected system in metres, got {given}\n{remedy}")

    def _is_elsewhere(self) -> bool:
        """True if the origin looks like degrees, or is beyond all of UTM for a code of UTM."""
        is_small = abs(self.x) <= 180 and abs(self.y) <= 90
        if is_utm(self.epsg):
            # Norway has eastings of -80 to 1120 km in zone 33.
            return is_small or not (-2e5 <= self.x <= 1.3e6 and -1e5 <= self.y <= 1.01e7)
        return is_small and (self.x, self.y) != (0, 0)


def is_utm(epsg: int) -> bool:
    """True for the codes of UTM on WGS 84."""
    return 1 <= epsg % 100 <= 60 and epsg // 100 in (326, 327)


@dataclass(frozen=True)
class Pose:
    """Position and orientation of an antenna array.

    Attributes:
        position: Centre of the array, world frame (3,) [m].
        rotation: The array's axes in the world frame as columns (3, 3).

    Example:
        >>> pose = gaigs.Pose.from_xyzw([1.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0])  # along the axes
        >>> pose.local(torch.tensor([3.0, 0.0, 2.0]))
        tensor([2., 0., 0.])
    """

    position: Float[Tensor, "3"]
    rotation: Float[Tensor, "3 3"]

    @classmethod
    def from_xyzw(cls, position, quaternion) -> "Pose":
        """A pose from a scalar-last quaternion (scipy's order) of length 1 to within 1e-3."""

        def as_double(values):
            if not isinstance(values, Tensor):
                values = torch.from_numpy(np.array(values, float))
            return values.double()

        position = as_double(position)
        quaternion = as_double(quaternion)
        if position.shape != (3,) or quaternion.shape != (4,) or not position.isfinite().all():
            raise ValueError(
                "a pose needs 3 finite coordinates [m] and a quaternion (x, y, z, w), got "
                f"{position.tolist()} and {quaternion.tolist()}"
            )
        norm = float(quaternion.norm())
        if not abs(norm - 1) <= 1e-3:
            raise ValueError(
                f"a rotation quaternion must have length 1, got {norm:.6g}; normalise it"
            )
        rotation = quaternions_to_rotations(quaternion.roll(1))
        return cls(position.float(), rotation.float())

    @classmethod
    def at(cls, position) -> "Pose":
        """A pose at 3 coordinates [m] with the world's axes."""
        return cls.from_xyzw(position, (0.0, 0.0, 0.0, 1.0))

    def to(self, like: Tensor) -> "Pose":
        return Pose(self.position.to(like), self.rotation.to(like))

    def local(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """World points in the array's frame [m]."""
        pose = self.to(points)
        return (points - pose.position) @ pose.rotation

    def world(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Points of the array's frame in the world frame [m]."""
        pose = self.to(points)
        return points @ pose.rotation.mT + pose.position


def quaternions_to_rotations(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z) of any length; length 0 means no rotation."""
    quats = _of_moderate_length(quats)
    squares = (quats * quats).sum(-1, keepdim=True)  # (..., 1)
    s = 2 / torch.where(squares == 0, 1, squares)
    # The column of each axis e is R e = e + s (w u x e + u x (u x e)), with u = (x, y, z) and
    # s = 2 / |quaternion|². That takes few operations, each of which costs as much as hundreds of
    # Gaussians.
    w = quats[..., :1, None]  # (..., 1, 1)
    u = quats[..., None, 1:]  # (..., 1, 3)
    axes = torch.eye(3, dtype=quats.dtype, device=quats.device)
    crossed = torch.linalg.cross(u, axes.expand(*quats.shape[:-1], 3, 3))  # u x e, a row each
    change = w * crossed + torch.linalg.cross(u.expand_as(crossed), crossed)
    return (axes + s[..., None] * change).mT


def unit_quaternions(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Quaternions scaled to length 1; a quaternion of length zero stays zero."""
    return normalize(_of_moderate_length(quats), dim=-1)


def _of_moderate_length(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Quaternions divided by their largest component, so that squares stay in range."""
    largest = quats.detach().abs().amax(-1, keepdim=True)
    return quats / torch.where(largest == 0, 1, largest)


def semi_axes(
    quats: Float[Tensor, "*#batch 4"], scales: Float[Tensor, "*#batch 3"]
) -> Float[Tensor, "*batch 3 3"]:
    """Semi-axes R diag(scales) as columns, from quaternions (w, x, y, z) and scales [m]."""
    return quaternions_to_rotations(quats) * scales[..., None, :]


def to_spherical(points: Float[Tensor, "*batch 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Azimuth in [-pi, pi], elevation in [-pi/2, pi/2] [rad] and distance [m] of points.

    On the z axis, where azimuth is undefined, the azimuth is 0. Gradients are finite everywhere but
    at the origin.
    """
    x, y, z = points.unbind(-1)
    distances = points.norm(dim=-1)
    # Within rounding of the axis no azimuth is resolved: such a point counts as one just beside it,
    # at azimuth 0.
    least = torch.finfo(points.dtype).eps * distances.detach()
    axial = torch.hypot(x, y) <= least
    x = torch.where(axial, least, x)
    y = torch.where(axial, 0.0, y)
    return torch.atan2(y, x), torch.atan2(z, torch.hypot(x, y)), distances


def from_spherical(
    azimuths: Float[Tensor, "*batch"], elevations: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3"]:
    """Unit vectors towards azimuths and elevations [rad]."""
    horizontal = torch.cos(elevations)
    return torch.stack(
        (horizontal * torch.cos(azimuths), horizontal * torch.sin(azimuths), torch.sin(elevations)),
        -1,
    )


def polar(
    amplitudes: Float[Tensor, "*batch"], phases: Float[Tensor, "*batch"]
) -> Complex[Tensor, "*batch"]:
    """``torch.polar``, but with value and gradient 0 below ``FAINTEST``, where torch has NaN."""
    return torch.polar(amplitudes.masked_fill(amplitudes < FAINTEST, 0), phases)


def magnitudes(waves: Complex[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Magnitudes of waves; value and gradient are 0 where both parts are below ``FAINTEST``."""
    largest = torch.maximum(waves.real.detach().abs(), waves.imag.detach().abs())
    return waves.masked_fill(largest < FAINTEST, 0).abs()


class _Sinc(torch.autograd.Function):
    """``sinc`` with its gradient."""

    @staticmethod
    def forward(ctx, values):
        # pi x plus a tiny number: at 0 the quotient is then 1, other numbers do not change.
        angles = torch.add(values.new_tensor(FAINTEST), values, alpha=math.pi)
        result = angles.sin().div_(angles)
        ctx.save_for_backward(angles, result)
        return result

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, gradient):
        angles, result = ctx.saved_tensors
        # d sin(a) / a = (cos(a) - sin(a) / a) / a da, and a = pi x
        return angles.cos().sub_(result).div_(angles).mul_(gradient).mul_(math.pi)


def sinc(values: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """``torch.sinc`` in a quarter of the time: sin(pi x) / (pi x), and 1 at 0."""
    return _Sinc.apply(values)


def spherical_harmonics(
    vectors: Float[Tensor, "*batch 3"], degree: int
) -> Float[Tensor, "*batch k"]:
    """The k = (degree + 1)² real spherical harmonics up to ``degree``.

    Harmonic number n² + n + m, of degree n and order m, is sqrt(2) N P_n^|m|(z) cos(m az) for m >
    0, sqrt(2) N P_n^|m|(z) sin(|m| az) for m < 0, and N P_n(z) for m = 0. P are the associated
    Legendre functions with the factor (-1)^m. N makes the mean square over the sphere 1 / 4 pi, as
    in .ply viewers. The recurrence computes N P_n^m / sin^m of the polar angle, a polynomial in z,
    so values and gradients are finite at the poles.

    Args:
        vectors: Unit vectors (x, y, z) with the azimuth az.
        degree: Highest degree.

    Source: Holmes and Featherstone, A unified approach to the Clenshaw summation, 2002, section 3.
    """
    x, y, z = vectors.unbind(-1)
    # Cosine and sine of m az, times sin^m of the polar angle.
    cosines = torch.ones_like(z)
    sines = torch.zeros_like(z)
    harmonics = [z] * (degree + 1) ** 2  # places, all of which are replaced
    first = 0.5 / math.sqrt(math.pi)  # N P_m^m / sin^m
    for m in range(degree + 1):
        if m:
            first *= -math.sqrt((2 * m + 1) / (2 * m))
            # From m - 1 to m: the product of cosine + j sine and x + j y.
            cosines, sines = x * cosines - y * sines, x * sines + y * cosines
        # The recurrence over n (equation 11) starts at P_m^m.
        last = torch.zeros_like(z)
        legendre = torch.full_like(z, first)
        for n in range(m, degree + 1):
            if n > m:
                step = math.sqrt((4 * n**2 - 1) / (n**2 - m**2))
                back = math.sqrt(((n - 1) ** 2 - m**2) / (4 * (n - 1) ** 2 - 1))
                last, legendre = legendre, step * (z * legendre - back * last)
            middle = n**2 + n
            if m:
                harmonics[middle + m] = math.sqrt(2) * legendre * cosines
                harmonics[middle - m] = math.sqrt(2) * legendre * sines
            else:
                harmonics[middle] = legendre
    return torch.stack(harmonics, -1)


@dataclass
class Rays:
    """A list of directions in the array's frame [rad].

    Example:
        >>> angles = torch.tensor([0.0, 0.5])
        >>> gaigs.Rays(elevations=angles, azimuths=2 * angles).vectors().shape
        torch.Size([2, 3])
    """

    elevations: Float[Tensor, " k"]
    azimuths: Float[Tensor, " k"]

    @property
    def shape(self) -> tuple[int]:
        return (len(self.elevations),)

    def flatten(self) -> "Rays":
        return self

    def vectors(self) -> Float[Tensor, "k 3"]:
        """Unit vectors in the array's frame."""
        return from_spherical(self.azimuths, self.elevations)

    def __getitem__(self, index: slice | Int[Tensor, " j"]) -> "Rays":
        return Rays(self.elevations[index], self.azimuths[index])

    def to(self, where: torch.device | str | torch.dtype | Tensor) -> "Rays":
        return Rays(self.elevations.to(where), self.azimuths.to(where))


@dataclass
class Grid:
    """Directions of a spectrum's pixels in the array's frame: elevations by azimuths [rad].

    Example:
        >>> coarse = gaigs.Grid.degrees(elevations=range(-30, 31, 10), azimuths=range(8))
        >>> gaigs.Grid.degrees().shape, coarse.shape
        ((90, 360), (7, 8))
    """

    elevations: Float[Tensor, " rows"]
    azimuths: Float[Tensor, " columns"]

    @classmethod
    def degrees(cls, elevations=range(1, 91), azimuths=range(360)) -> "Grid":
        """A grid of whole degrees; the default, 90 x 360, is the grid of NeRF² spectra."""

        def as_radians(values):
            return torch.tensor([float(v) for v in values], dtype=torch.float32).deg2rad()

        return cls(as_radians(elevations), as_radians(azimuths))

    @classmethod
    def sphere(cls, rows: int, columns: int) -> "Grid":
        """The full sphere in at least 2 x 3 pixels of equal solid angle."""
        if rows < 2 or columns < 3:
            raise ValueError(
                f"a grid over the sphere takes at least 2 rows and 3 columns, got {rows} x "
                f"{columns}"
            )
        # The area of a zone is 2 pi times the difference of the sines of its elevations, so rows
        # with evenly spaced sines have equal areas.
        sines = (2 * torch.arange(rows, dtype=torch.float64) + 1 - rows) / rows
        azimuths = 2 * math.pi / columns * (torch.arange(columns, dtype=torch.float64) + 0.5)
        return cls(sines.asin().float(), azimuths.float())

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.elevations), len(self.azimuths)

    @property
    def pitch(self) -> float:
        """Mean distance between neighbouring rows [rad]."""
        span = self.elevations[-1] - self.elevations[0]
        return (span / max(len(self.elevations) - 1, 1)).abs().item()

    @property
    def solid_angles(self) -> Float[Tensor, "rows columns"]:
        """Solid angle of each pixel as a fraction of the grid's solid angle.

        Two rows meet at the mean of the sines of their elevations. The first and last row reach as
        far outwards as inwards, at most to a pole.
        """
        if len(self.elevations) < 2:
            raise ValueError(
                f"solid angles take at least 2 rows, got {len(self.elevations)}; use a finer grid"
            )
        sines = self.elevations.double().sin()
        first = (3 * sines[:1] - sines[1:2]) / 2
        middles = (sines[1:] + sines[:-1]) / 2
        last = (3 * sines[-1:] - sines[-2:-1]) / 2
        bounds = torch.cat((first, middles, last)).clamp(-1, 1)  # (rows + 1,)
        shares = bounds.diff().abs()[:, None].expand(self.shape)
        return (shares / shares.sum()).float()

    def thin(self, rows: slice, columns: slice) -> "Grid":
        """The grid of the given rows and columns."""
        return Grid(self.elevations[rows], self.azimuths[columns])

    def matches(self, other: "Directions") -> bool:
        """True for a grid of the same angles."""
        pairs = (self.elevations, other.elevations), (self.azimuths, other.azimuths)
        return self.shape == other.shape and all(torch.equal(a, b.to(a)) for a, b in pairs)

    def flatten(self) -> Rays:
        """The pixels, row by row."""
        elevations, azimuths = torch.meshgrid(self.elevations, self.azimuths, indexing="ij")
        return Rays(elevations.flatten(), azimuths.flatten())

    def vectors(self) -> Float[Tensor, "rows columns 3"]:
        """Unit vectors in the array's frame."""
        return self.flatten().vectors().unflatten(0, self.shape)

    def to(self, where: torch.device | str | torch.dtype | Tensor) -> "Grid":
        return Grid(self.elevations.to(where), self.azimuths.to(where))


Directions = Grid | Rays
"""Directions of the values of a label or a map."""


def even_places(
    lower: Float[Tensor, "3"],
    upper: Float[Tensor, "3"],
    count: int,
    floors: Sequence[float] | Tensor = (),
) -> Float[Tensor, "g 3"]:
    """About ``count`` evenly spaced places in a box [m].

    An edge shorter than the spacing has one row of places, at its middle. With heights of
    ``floors`` [m] places are at these heights only.
    """
    if len(floors):
        count_on_floor = max(1, count // len(floors))
        places = []
        for floor in floors:
            height = lower.new_tensor([floor])
            floor_lower = torch.cat((lower[:2], height))
            floor_upper = torch.cat((upper[:2], height))
            places.append(even_places(floor_lower, floor_upper, count_on_floor))
        return torch.cat(places)
    edges = (upper - lower).abs()
    lower = torch.minimum(lower, upper)
    longest = edges.double().sort(descending=True).values
    pitch = 0.0  # distance between places [m]; stays 0 if the box is a point
    # An edge below the pitch does not count: the box is then a rectangle or a line.
    for dimensions in (3, 2, 1):
        pitch = float(longest[:dimensions].prod() / count) ** (1 / dimensions)
        if 0 < pitch <= longest[dimensions - 1]:
            break
    counts = [max(1, round(edge / (pitch or 1.0))) for edge in edges.tolist()]
    axes = []
    for low, edge, number in zip(lower, edges, counts, strict=True):
        axes.append(low + edge * (torch.arange(number) + 0.5) / number)
    return torch.cartesian_prod(*axes)
