"""Projections lay Gaussians on the receiver's perception plane."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gaigs.directions import Directions
from gaigs.geometry import Pose

NEAR = 1e-6
"""A Gaussian nearer to the receiver than this sits on it [m]: float32 tells no direction between two positions of some
metres so close together, and footprints, which grow as 1 / distance², have a finite determinant down to here."""


@dataclass(frozen=True)
class Splats:
    """Gaussians on the perception plane of one receiver.

    Attributes:
        means2d: Centres (n, 2) as (u, v); (b, n, 2) where they follow the transmitter, which ``aperture`` alone takes.
        covariances2d: (1 or b, n, 2, 2); one for all transmitters where nothing deforms the Gaussians.
        depths: Distance to the receiver, as many as centres [m].
        visible: False where a Gaussian has no direction (it sits on the receiver), as many as centres.
    """

    means2d: Float[Tensor, "*b n 2"]
    covariances2d: Float[Tensor, "b n 2 2"]
    depths: Float[Tensor, "*b n"]
    visible: Bool[Tensor, "*b n"]


@dataclass(frozen=True)
class Plane:
    """Where the label's pixel centres lie on the perception plane.

    Attributes:
        u: (1, columns), or (rows, columns) where the projection mixes azimuth and elevation.
        v: (rows, 1), or (rows, columns).
        period: u repeats after this; a splat then acts at the nearest of its images. None: no wrap.
    """

    u: Float[Tensor, "r columns"]
    v: Float[Tensor, "rows c"]
    period: float | None

    @property
    def shape(self) -> tuple[int, int]:
        return self.v.shape[0], self.u.shape[1]


class Projection(ABC):
    """The contract of kind ``projection``, and what all projections share.

    A projection is a smooth map from directions to the plane, ``coordinates``; a Gaussian's footprint there is that of
    the map's linearisation at its centre, ``jacobian`` (EWA splatting). To it comes the variance of a square pixel,
    so that a splat narrower than a pixel is not lost between two pixel centres; docs/methods.md says where that fails.

    Args:
        pixel: Edge of that pixel, the pitch of the label's grid [rad].

    Source: GAI-GS, "Projection and Render Module"; Zwicker et al., EWA Splatting, 2002.
    """

    sees_below = True
    """Whether a direction below the array's plane has a place of its own."""

    def __init__(self, pixel: float):
        if not pixel > 0:
            raise ValueError(f"a projection's pixel must be wider than 0 rad, got {pixel}")
        self.pixel_variance = pixel**2 / 12

    @abstractmethod
    def coordinates(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        """Plane coordinates (u, v) of points in the array's frame, of any distance but zero."""

    @abstractmethod
    def jacobian(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
        """Derivative of ``coordinates`` [1/m]; finite everywhere but at the origin."""

    @property
    @abstractmethod
    def period(self) -> float | None:
        """u repeats after this; None: it does not."""

    def plane(self, directions: Directions) -> Plane:
        """Plane coordinates of a label's pixel centres; a list of rays becomes a single row."""
        vectors = directions.vectors()
        u, v = self.coordinates(vectors if vectors.ndim == 3 else vectors[None]).unbind(-1)
        return Plane(u, v, self.period)

    def project(self, means: Float[Tensor, "*b n 3"], covariances: Float[Tensor, "b n 3 3"], receiver: Pose) -> Splats:
        """Gaussians as the receiver sees them.

        Args:
            means: Centres, world frame [m]; one set, or one a transmitter.
            covariances: World frame [m²]; one set (b = 1), or one a transmitter.
            receiver: Position [m] and orientation of the antenna array.
        """
        receiver = receiver.to(means)
        points = receiver.local(means)
        depths = points.norm(dim=-1)
        visible = ~(depths < NEAR)  # a centre that is NaN is no reason to hide it
        # A Gaussian on the receiver has no direction: a stand-in keeps values and gradients finite, `visible` hides it.
        points = torch.where(visible[..., None], points, points.new_tensor([1.0, 0.0, 0.0]))
        half = self.jacobian(points) @ receiver.rotation.mT
        pixel = self.pixel_variance * torch.eye(2, dtype=means.dtype, device=means.device)
        return Splats(self.coordinates(points), half @ covariances @ half.mT + pixel, depths, visible)
