"""Poses, quaternions, spherical and polar coordinates, harmonics; conventions stand in docs/conventions.md."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float
from torch import Tensor
from torch.nn.functional import normalize

FAR = 1e5
"""No coordinate reaches it [m]: float32 tells places apart by 8 mm there, and by half a metre at UTM's northings."""

WITHIN = "positions within 1e5 m of the origin on each axis (subtract a common origin from all)"

FAINTEST = torch.finfo(torch.float32).tiny
"""Amplitudes and powers below this are silence: what is divided by such a number of float32 overflows."""


class ExtrapolationWarning(UserWarning):
    """Something is asked for far from all that was measured."""


@dataclass(frozen=True)
class Pose:
    """Position and orientation of an antenna array.

    Attributes:
        position: Centre of the array, world frame (3,) [m].
        rotation: Columns are the array's axes in the world frame (3, 3), so a world point x
            is seen at ``rotation.T @ (x - position)``.

    Example:
        >>> pose = gaigs.Pose.from_xyzw([1.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0])  # scipy's order: looks along the axes
        >>> pose.local(torch.tensor([3.0, 0.0, 2.0]))
        tensor([2., 0., 0.])
    """

    position: Float[Tensor, "3"]
    rotation: Float[Tensor, "3 3"]

    @classmethod
    def from_xyzw(cls, position, quaternion) -> "Pose":
        """A pose from a scalar-last quaternion, as scipy and the NeRF² files write it.

        Raises:
            ValueError: The quaternion is not of unit length (to 1e-3) or a value is not finite.
        """
        position = torch.as_tensor(position, dtype=torch.float64)
        quaternion = torch.as_tensor(quaternion, dtype=torch.float64)
        if position.shape != (3,) or quaternion.shape != (4,):
            raise ValueError(
                f"a pose needs a position of 3 and a quaternion of 4 numbers, got {tuple(position.shape)} and "
                f"{tuple(quaternion.shape)}"
            )
        if not (torch.isfinite(position).all() and torch.isfinite(quaternion).all()):
            raise ValueError(
                f"a pose must be finite, got position {position.tolist()}, quaternion {quaternion.tolist()}"
            )
        norm = float(quaternion.norm())
        if abs(norm - 1) > 1e-3:
            raise ValueError(
                f"a rotation quaternion must have length 1, got {norm:.6g} for {quaternion.tolist()}; normalise it"
            )
        rotation = quaternions_to_rotations(quaternion.roll(1))
        return cls(position.float(), rotation.float())

    def to(self, like: Tensor) -> "Pose":
        """The same pose on the device and in the dtype of ``like``."""
        return Pose(self.position.to(like), self.rotation.to(like))

    def local(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """World points [m] in the array's own frame [m]."""
        return (points - self.position) @ self.rotation

    def world(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Points of the array's own frame [m] in the world's [m]."""
        return points @ self.rotation.mT + self.position


def quaternions_to_rotations(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Rotation matrices of quaternions (w, x, y, z) of any length; of length zero no rotation.

    The matrix is that of the normalised quaternion; dividing by the squared length keeps the gradient
    free of a component along the quaternion.
    """
    quats = _of_moderate_length(quats)
    w, x, y, z = quats.unbind(-1)
    squares = (quats * quats).sum(-1)
    s = 2 / torch.where(squares == 0, 1, squares)
    rows = (
        1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def unit_quaternions(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """Quaternions of length 1; one of length zero stays as it is."""
    return normalize(_of_moderate_length(quats), dim=-1)


def _of_moderate_length(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 4"]:
    """The same directions with a largest component of 1, so that squares neither overflow nor vanish."""
    largest = quats.detach().abs().amax(-1, keepdim=True)
    return quats / torch.where(largest == 0, 1, largest)


def semi_axes(quats: Float[Tensor, "*batch 4"], scales: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """R diag(scales) [m], a column an axis, of Gaussians with quaternions (w, x, y, z) and standard deviations [m].

    Times its transpose this is the covariance, whose condition number is the square: of a Gaussian 10,000 times as long
    as wide float32 would keep nothing of the width there.
    """
    return quaternions_to_rotations(quats) * scales[..., None, :]


def to_spherical(points: Float[Tensor, "*batch 3"]) -> tuple[Tensor, Tensor, Tensor]:
    """Azimuth in [-pi, pi] [rad], elevation in [-pi/2, pi/2] [rad] and distance [m] of points in the array's frame.

    ``atan2`` of the height over the horizontal distance equals asin(z / r) and is accurate at the zenith too. There,
    where azimuth is undefined, it is 0. Gradients are finite everywhere but at the origin.
    """
    x, y, z = points.unbind(-1)
    distances = points.norm(dim=-1)
    # Nearer to the axis than this no azimuth is resolved: such a point counts as one just beside it, at azimuth 0.
    least = torch.finfo(points.dtype).eps * distances.detach()
    axial = torch.hypot(x, y) <= least
    x, y = torch.where(axial, least, x), torch.where(axial, 0.0, y)
    return torch.atan2(y, x), torch.atan2(z, torch.hypot(x, y)), distances


def from_spherical(azimuths: Float[Tensor, "*batch"], elevations: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 3"]:
    """Unit vectors towards azimuths and elevations [rad]; the inverse of ``to_spherical``."""
    horizontal = torch.cos(elevations)
    return torch.stack((horizontal * torch.cos(azimuths), horizontal * torch.sin(azimuths), torch.sin(elevations)), -1)


def polar(amplitudes: Float[Tensor, "*batch"], phases: Float[Tensor, "*batch"]) -> Complex[Tensor, "*batch"]:
    """Waves of amplitudes, at least 0, and phases [rad]; 0, as are its gradients, below ``FAINTEST``.

    The gradient of ``torch.polar`` is finite at an amplitude of 0, and NaN just beside it.
    """
    return torch.polar(amplitudes.masked_fill(amplitudes < FAINTEST, 0), phases)


def magnitudes(waves: Complex[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Of waves; 0, as is its gradient, where both parts are below ``FAINTEST``: as for ``polar``."""
    largest = torch.maximum(waves.real.detach().abs(), waves.imag.detach().abs())
    return waves.masked_fill(largest < FAINTEST, 0).abs()


def spherical_harmonics(vectors: Float[Tensor, "*batch 3"], degree: int) -> Float[Tensor, "*batch k"]:
    """Real spherical harmonics in directions, of all degrees n up to one, which is k = (degree + 1)² of them.

    Number n² + n + m is sqrt(2) N P_n^|m|(z) times cos(m az) for m > 0, sin(|m| az) for m < 0, and N P_n(z) for m = 0.
    P has the factor (-1)^m, and with N the mean square over the sphere is 1 / 4 pi, as .ply viewers have them.

    The recurrence over n runs on N P_n^m / sin^m of the polar angle, a polynomial in z; the sine goes with the
    azimuth's functions into (x + j y)^m. So values and gradients are finite at the poles too.

    Args:
        vectors: Unit vectors.
        degree: The highest n.

    Source: Holmes and Featherstone, A unified approach to the Clenshaw summation, 2002, section 3.
    """
    x, y, z = vectors.unbind(-1)
    cosines, sines = torch.ones_like(z), torch.zeros_like(z)  # of m az, times sin^m of the polar angle
    harmonics = [z] * (degree + 1) ** 2
    first = 0.5 / math.sqrt(math.pi)
    for m in range(degree + 1):
        if m:
            first *= -math.sqrt((2 * m + 1) / (2 * m))
            cosines, sines = x * cosines - y * sines, x * sines + y * cosines
        last, legendre = torch.zeros_like(z), torch.full_like(z, first)
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
