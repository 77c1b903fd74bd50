"""Projections map Gaussians to the receiver's perception plane."""

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
"""Distance below which float32 resolves no direction, and a footprint may overflow [m]."""


@dataclass(frozen=True)
class Splats:
    """Gaussians on the perception plane of one receiver.

    Attributes:
        means2d: Centres (u, v), (n, 2), or (b, n, 2) if they depend on the query.
        factors: p, q and r of the lower triangular (Cholesky) factor [[p, 0], [q, r]] of each
            covariance, with p and r above 0 (1 or b, n, 3).
        depths: Distances to the receiver [m].
        visible: False for a Gaussian at the receiver, which has no direction.
    """

    means2d: Float[Tensor, "*b n 2"]
    factors: Float[Tensor, "b n 3"]
    depths: Float[Tensor, "*b n"]
    visible: Bool[Tensor, "*b n"]

    @property
    def covariances2d(self) -> Float[Tensor, "b n 2 2"]:
        """Covariances, the factor times its transpose; less exact for long, thin splats."""
        p, q, r = self.factors.unbind(-1)  # (b, n) each
        entries = torch.stack((p * p, p * q, p * q, q * q + r * r), -1)  # (b, n, 4)
        return entries.unflatten(-1, (2, 2))


@dataclass(frozen=True)
class Plane:
    """The label's pixel centres on the perception plane.

    Attributes:
        u: (1, columns), or (rows, columns) if the projection mixes azimuth and elevation.
        v: (rows, 1), or (rows, columns).
        period: Period of u; a splat acts at its nearest periodic image. None: no period.
    """

    u: Float[Tensor, "r columns"]
    v: Float[Tensor, "rows c"]
    period: float | None

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the label."""
        return self.v.shape[0], self.u.shape[1]


class Projection(ABC):
    """Base class of components of kind ``projection``.

    A projection is a smooth map ``coordinates`` from directions to the plane. The footprint of a
    Gaussian follows from the map linearised at its centre, ``jacobian`` (EWA splatting). The
    variance of a square pixel is added, so that a narrow splat is not lost between two pixel
    centres. docs/methods.md states the limits.

    Args:
        pixel: Edge of the added pixel, the pitch of the label's grid [rad].

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
        """Plane coordinates (u, v) of points in the array's frame, at any distance except zero."""

    @abstractmethod
    def jacobian(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
        """Derivative of ``coordinates`` [1/m]; finite everywhere except at the origin."""

    @property
    @abstractmethod
    def period(self) -> float | None:
        """Period of u; None without one."""

    def check_sees(self, directions: Directions) -> None:
        """Raises a ``ValueError`` for directions that coincide with others in this projection."""
        if not self.sees_below and directions.elevations.min() < 0:
            raise ValueError(
                f"the grid reaches below the array's plane, which {name_of(self)} folds up; "
                "take mercator"
            )

    def plane(self, directions: Directions) -> Plane:
        """Plane coordinates of a label's pixel centres; a list of rays becomes a single row."""
        vectors = directions.vectors()  # (rows, columns, 3) or (k, 3)
        if vectors.ndim == 2:
            vectors = vectors[None]
        u, v = self.coordinates(vectors).unbind(-1)  # (rows, columns) each
        return Plane(u, v, self.period)

    def project(
        self, means: Float[Tensor, "*b n 3"], semi_axes: Float[Tensor, "b n 3 3"], receiver: Pose
    ) -> Splats:
        """Gaussians as the receiver sees them.

        Args:
            means: Centres, world frame [m]; one set, or one for each transmitter.
            semi_axes: Semi-axes in columns, world frame [m]; one set (b = 1), or one for each
                transmitter.
            receiver: Pose of the antenna array.
        """
        receiver = receiver.to(means)
        points = receiver.local(means)  # (*b, n, 3) [m]
        depths = points.norm(dim=-1)  # [m]
        visible = ~(depths < NEAR)  # NaN stays visible
        # A Gaussian at the receiver has no direction: a stand-in keeps values and gradients finite,
        # `visible` hides it.
        stand_in = points.new_tensor([1.0, 0.0, 0.0])
        points = torch.where(visible[..., None], points, stand_in)
        # EWA splatting: the footprint's covariance is J S J', with J the map's linearisation and S
        # the covariance in the receiver's frame, here by its factors (2, 3) a Gaussian.
        linearised = self.jacobian(points) @ receiver.rotation.mT @ semi_axes  # (b, n, 2, 3)
        across, along = linearised.unbind(-2)
        factors = factor(across, along, self.pixel_variance)
        return Splats(self.coordinates(points), factors, depths, visible)


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
    """Projects Gaussians to a receiver's 2-D plane. Quaternions are (w, x, y, z) of any length.

    Args:
        means: Centres, world frame (n, 3) [m].
        quats: Orientations (n, 4). The columns of their rotation matrices are the Gaussians' axes
            in the world frame.
        scales: Standard deviations along these axes (n, 3) [m].
        receiver: A ``gaigs.Pose``, or a ``gaigs.Receiver`` with one.
        grid: Directions of the pixels in the receiver's frame [rad].
        projection: Name, configuration or object.
        pixel: Edge of the pixel whose variance is added to footprints [rad]. None: the pitch of a
            ``gaigs.Grid``. Ignored if the projection is an object.

    Returns:
        The splats, and the pixels on the plane; differentiable in means, quaternions and scales.
        Each input may have a leading axis b of transmitters.

    Raises:
        ValueError: A shape is wrong, the pixel's size is unknown, or a direction is not in radians
            or not on the plane.

    Source: GAI-GS, "Projection and Render Module"; Zwicker et al., EWA Splatting, 2002.

    Example:
        >>> from gaigs.splatting.projection import project
        >>> means, quats = torch.tensor([[3.0, 0.0, 1.0]]), torch.tensor([[1.0, 0.0, 0.0, 0.0]])
        >>> pose = gaigs.Pose.from_xyzw([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
        >>> scales, grid = torch.full((1, 3), 0.1), gaigs.Grid.degrees()
        >>> splats, plane = project(means, quats, scales, receiver=pose, grid=grid)
        >>> splats.means2d.shape, plane.shape  # (azimuth, stretched elevation)
        (torch.Size([1, 2]), (90, 360))
        >>> splats.covariances2d.shape
        torch.Size([1, 1, 2, 2])
    """
    n = means.shape[-2]
    for name, values, size in (("means", means, 3), ("quats", quats, 4), ("scales", scales, 3)):
        if values.ndim not in (2, 3) or values.shape[-2:] != (n, size):
            raise ValueError(
                f"{name} must be ({n}, {size}) or (b, {n}, {size}), got {tuple(values.shape)}"
            )
    if pixel is None and isinstance(grid, Grid):
        pixel = grid.pitch or _pitch_of_row(grid)
    if not is_built(projection) and not pixel:
        raise ValueError(
            "pixel must be given for rays and for a single pixel, in rad: "
            "e.g. gaigs.Grid.degrees().pitch"
        )
    if not (grid.elevations.abs() <= math.pi / 2 + 1e-4).all():
        raise ValueError("elevations must lie within 1.5708 rad; gaigs.Grid.degrees takes degrees")
    chosen = registry("projection").build(projection, pixel=pixel)
    grid = grid.to(means)
    chosen.check_sees(grid)
    axes = semi_axes(quats, scales)  # ([b,] n, 3, 3)
    if axes.ndim == 3:
        axes = axes[None]
    pose = getattr(receiver, "pose", receiver)
    return chosen.project(means, axes, pose), chosen.plane(grid)


def _pitch_of_row(grid: Grid) -> float:
    """Mean azimuth step over the columns of a grid of one row [rad]; 0 for a single pixel."""
    steps = grid.thin(slice(1), slice(None)).azimuths.diff().abs()
    return steps.sum().item() / grid.shape[1]


def factor(
    across: Float[Tensor, "*batch k"], along: Float[Tensor, "*batch k"], variance: float
) -> Float[Tensor, "*batch 3"]:
    """p, q and r of the factor [[p, 0], [q, r]] of the covariance M M' + variance I.

    ``across`` and ``along`` are the two rows of M.

    With e = across / p: q = e . along and r² = variance + |e x along|² + variance |along|² / p².
    All roots are of sums of squares, so no difference cancels, even for a long, thin ellipse.
    """
    p = (across.square().sum(-1) + variance).sqrt()  # (...)
    e = across / p[..., None]  # (..., k)
    squared_area = torch.linalg.cross(e, along).square().sum(-1)  # |e x along|²
    beside = squared_area + (variance / p.square()) * along.square().sum(-1)  # r² - variance
    q = (e * along).sum(-1)
    return torch.stack((p, q, (beside + variance).sqrt()), -1)  # (..., 3)
