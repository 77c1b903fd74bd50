"""Poses, quaternions, covariances and spherical coordinates; the conventions stand in docs/conventions.md."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True)
class Pose:
    """Position and orientation of an antenna array.

    Attributes:
        position: Centre of the array, world frame (3,) [m].
        rotation: Columns are the array's axes in the world frame (3, 3), so a world point x
            is seen at ``rotation.T @ (x - position)``.
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
    """Rotation matrices of quaternions (w, x, y, z) of any length but zero.

    The matrix is that of the normalised quaternion; dividing by the squared length keeps the gradient
    free of a component along the quaternion.
    """
    w, x, y, z = quats.unbind(-1)
    s = 2 / (quats * quats).sum(-1)
    rows = (
        1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y),
        s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x),
        s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y),
    )  # fmt: skip
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


def covariances(quats: Float[Tensor, "*batch 4"], scales: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Covariances R diag(scales²) Rᵀ [m²] of Gaussians with quaternions (w, x, y, z) and standard deviations [m]."""
    half = quaternions_to_rotations(quats) * scales[..., None, :]
    return half @ half.mT


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
