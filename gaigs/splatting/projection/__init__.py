"""Projections lay Gaussians on the receiver's perception plane."""

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gaigs.core.geometry import Directions, Grid, Pose, semi_axes
from gaigs.registry import is_built, name_of, registry

NEAR = 1e-6
"""Distance below which float32 resolves no direction, and the determinant of a footprint may
overflow [m].
"""


@dataclass(frozen=True)
class Splats:
    """Gaussians on the perception plane of one receiver.

    Attributes:
        means2d: Centres (u, v), (n, 2), or (b, n, 2) where they differ from query to query.
        factors: p, q and r of the lower triangular factor [[p, 0], [q, r]] of each covariance, p
            and r above 0 (1 or b, n, 3).
        depths: Distances to the receiver [m].
        visible: False where a Gaussian sits on the receiver and so has no direction.
    """

    means2d: Float[Tensor, "*b n 2"]
    factors: Float[Tensor, "b n 3"]
    depths: Float[Tensor, "*b n"]
    visible: Bool[Tensor, "*b n"]

    @property
    def covariances2d(self) -> Float[Tensor, "b n 2 2"]:
        """The factor times its transpose, less exact for long and thin splats."""
        p, q, r = self.factors.unbind(-1)
        return torch.stack((p * p, p * q, p * q, q * q + r * r), -1).unflatten(-1, (2, 2))


@dataclass(frozen=True)
class Plane:
    """The label's pixel centres on the perception plane.

    Attributes:
        u: (1, columns), or (rows, columns) where the projection mixes azimuth and elevation.
        v: (rows, 1), or (rows, columns).
        period: u repeats after this; a splat acts at the nearest of its images. None: no wrap.
    """

    u: Float[Tensor, "r columns"]
    v: Float[Tensor, "rows c"]
    period: float | None

    @property
    def shape(self) -> tuple[int, int]:
        return self.v.shape[0], self.u.shape[1]


class Projection(ABC):
    """The contract of kind ``projection``.

    A projection is a smooth map from directions to the plane, ``coordinates``. A Gaussian's
    footprint there is that of the map's linearisation at its centre, ``jacobian`` (EWA splatting),
    plus the variance of a square pixel: a splat narrower than a pixel is not lost between two pixel
    centres. docs/methods.md has the limits.

    Args:
        pixel: Edge of that pixel, the pitch of the label's grid [rad].

    Source: GAI-GS, "Projection and Render Module"; Zwicker et al., EWA Splatting, 2002.
    """

    sees_below = True
    """True if a direction below the array's plane has a place of its own."""

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

    def check_sees(self, directions: Directions) -> None:
        """Raises a ``ValueError`` if directions below the array's plane would fall on those above."""
        if not self.sees_below and directions.elevations.min() < 0:
            raise ValueError(
                f"the grid reaches below the array's plane, which {name_of(self)} folds up; take mercator"
            )

    def plane(self, directions: Directions) -> Plane:
        """Plane coordinates of a label's pixel centres; a list of rays becomes a single row."""
        vectors = directions.vectors()
        u, v = self.coordinates(vectors if vectors.ndim == 3 else vectors[None]).unbind(-1)
        return Plane(u, v, self.period)

    def project(
        self, means: Float[Tensor, "*b n 3"], semi_axes: Float[Tensor, "b n 3 3"], receiver: Pose
    ) -> Splats:
        """Gaussians as the receiver sees them.

        Args:
            means: Centres, world frame [m]; one set, or one a transmitter.
            semi_axes: A column for each axis, world frame [m]; one set (b = 1), or one a
                transmitter.
            receiver: Pose of the antenna array.
        """
        receiver = receiver.to(means)
        points = receiver.local(means)
        depths = points.norm(dim=-1)
        visible = ~(depths < NEAR)  # NaN stays visible
        # A Gaussian on the receiver has no direction: a stand-in keeps values and gradients finite,
        # `visible` hides it.
        points = torch.where(visible[..., None], points, points.new_tensor([1.0, 0.0, 0.0]))
        across, along = (self.jacobian(points) @ receiver.rotation.mT @ semi_axes).unbind(-2)
        return Splats(
            self.coordinates(points), factor(across, along, self.pixel_variance), depths, visible
        )


def project(
    means: Float[Tensor, "*#b n 3"],
    quats: Float[Tensor, "*#b n 4"],
    scales: Float[Tensor, "*#b n 3"],
    *,
    receiver: Any,
    grid: Directions,
    projection: str | Mapping | Projection = "mercator",
    pixel: float | None = None,
) -> tuple[Splats, Plane]:
    """Gaussians as a receiver sees them, in 2-D. Quaternions are (w, x, y, z) of any length.

    Args:
        means: Centres, world frame (n, 3) [m].
        quats: Orientations, the columns of whose rotation matrices are the Gaussians' axes in the
            world frame (n, 4).
        scales: Standard deviations along these axes (n, 3) [m].
        receiver: A ``gaigs.Pose``, or a ``gaigs.Receiver`` with one.
        grid: Directions of the pixels in the receiver's frame [rad].
        projection: Name, configuration or object.
        pixel: Edge of the pixel by whose variance footprints are widened [rad]. None: the pitch of
            a ``gaigs.Grid``. Ignored where the projection is an object.

    Returns:
        The splats, and the pixels on the plane; differentiable in means, quaternions and scales.
        Each input may have a leading axis b of transmitters.

    Example:
        >>> from gaigs.splatting.projection import project
        >>> means, quats = torch.tensor([[3.0, 0.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
        >>> pose = gaigs.Pose.from_xyzw([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
        >>> splats, plane = project(means, quats, torch.full((1, 3), 0.1), receiver=pose, grid=gaigs.Grid.degrees())
        >>> splats.means2d.shape, splats.covariances2d.shape, plane.shape  # (azimuth, stretched elevation)
        (torch.Size([1, 2]), torch.Size([1, 1, 2, 2]), (90, 360))
    """
    n = means.shape[-2]
    for name, values, size in (("means", means, 3), ("quats", quats, 4), ("scales", scales, 3)):
        if values.ndim not in (2, 3) or values.shape[-2:] != (n, size):
            raise ValueError(
                f"{name} must be ({n}, {size}) or (b, {n}, {size}), got {tuple(values.shape)}"
            )
    if pixel is None and isinstance(grid, Grid):
        pixel = (
            grid.pitch
            or grid.thin(slice(1), slice(None)).azimuths.diff().abs().sum().item() / grid.shape[1]
        )
    if not is_built(projection) and not pixel:
        raise ValueError(
            "pixel must be given for rays and for a single pixel, in rad: e.g. gaigs.Grid.degrees().pitch"
        )
    if not (grid.elevations.abs() <= math.pi / 2 + 1e-4).all():
        raise ValueError("elevations must lie within 1.5708 rad; gaigs.Grid.degrees takes degrees")
    chosen = registry("projection").build(projection, pixel=pixel)
    grid = grid.to(means)
    chosen.check_sees(grid)
    axes = semi_axes(quats, scales)
    pose = getattr(receiver, "pose", receiver)
    return chosen.project(means, axes if axes.ndim == 4 else axes[None], pose), chosen.plane(grid)


def factor(
    across: Float[Tensor, "*batch k"], along: Float[Tensor, "*batch k"], variance: float
) -> Float[Tensor, "*batch 3"]:
    """p, q and r of the lower triangular factor of [across; along] [across; along]' + variance I.

    With e = across / p: q = e . along and r² = variance + |e x along|² + variance |along|² / p².
    Roots are of sums of squares alone, so no digit is lost to a difference, however long and thin
    the ellipse is.
    """
    p = (across.square().sum(-1) + variance).sqrt()
    unit = across / p[..., None]
    beside = torch.linalg.cross(unit, along).square().sum(-1) + (
        variance / p.square()
    ) * along.square().sum(-1)
    return torch.stack((p, (unit * along).sum(-1), (beside + variance).sqrt()), -1)
