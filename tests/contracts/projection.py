"""The check of kind ``projection``."""

import torch
from torch import Tensor

from gaigs.core.geometry import (
    Directions,
    Grid,
    Pose,
    Rays,
    from_spherical,
    quaternions_to_rotations,
)
from gaigs.splatting.projection import NEAR, Projection
from gaigs.testing.checks import require, require_close, require_gradients, require_tensor


def check_projection(projection: Projection, device: torch.device | str = "cpu") -> None:
    """Checks a projection: ``jacobian`` and ``plane`` agree with ``coordinates``, at pole, horizon
    and seam too.

    The contract is that of ``gaigs.splatting.projection.Projection``.
    """

    def degrees(*range_):
        return torch.arange(*range_, dtype=torch.float64, device=device).deg2rad()

    azimuths, elevations = torch.cartesian_prod(
        degrees(-175, 180, 25), degrees(-55, 60, 10)
    ).unbind(1)
    directions = from_spherical(azimuths, elevations)
    points = 3 * directions
    coordinates = projection.coordinates(points)
    require_tensor("coordinates", coordinates, (len(points), 2), torch.float64, device)
    require_close(
        projection.coordinates(directions),
        coordinates,
        1e-12,
        "coordinates must not depend on the distance",
    )
    alone = projection.coordinates(points[:1])
    require_close(alone, coordinates[:1], 1e-12, "coordinates must not depend on other points")
    jacobian = projection.jacobian(points)
    require_tensor("the jacobian", jacobian, (len(points), 2, 3), torch.float64, device)
    derivative = torch.autograd.functional.jacobian(
        lambda p: projection.coordinates(p).sum(0), points
    ).transpose(0, 1)
    require_close(jacobian, derivative, 1e-9, "jacobian must be the derivative of coordinates")
    grids = (
        Grid(degrees(-80, 81, 20), degrees(0, 360, 30)),
        Grid(degrees(30, 31), degrees(350, 351)),
    )
    for grid in grids:
        _check_plane(projection, grid)
        _check_plane(projection, grid.flatten())
    _check_plane(projection, grids[0].flatten()[:0])
    _check_footprints(projection, device)
    _check_frames(projection, points)


def _check_plane(projection: Projection, directions: Directions) -> None:
    rows, columns = directions.shape if isinstance(directions, Grid) else (1, *directions.shape)
    plane = projection.plane(directions)
    noun = "a list of rays" if isinstance(directions, Rays) else "a grid"
    for name, smallest in {"u": (1, columns), "v": (rows, 1)}.items():
        given = tuple(getattr(plane, name).shape)
        rule = f"plane.{name} of {noun} must be of shape {smallest} or {rows, columns}, got {given}"
        require(given in (smallest, (rows, columns)), rule)
    require(
        plane.u.dtype == plane.v.dtype == directions.azimuths.dtype,
        "a plane must be of its directions' dtype",
    )
    require(plane.period == projection.period, "a plane must have the projection's period")
    u, v = projection.coordinates(directions.vectors().reshape(rows, columns, 3)).unbind(-1)
    off = plane.u - u
    if plane.period is not None:
        off = off - plane.period * (off / plane.period).round()
    require_close(
        off, torch.zeros_like(off), 1e-9, "plane.u must be coordinates' u at the pixels' directions"
    )
    require_close(
        plane.v.expand_as(v), v, 1e-9, "plane.v must be coordinates' v at the pixels' directions"
    )


def _check_footprints(projection: Projection, device: torch.device | str) -> None:
    """Values and gradients at hard places, among them the receiver's own."""
    places: list[tuple[float, float, float]]
    places = [
        (0, 0, 3),
        (0, 0, -3),
        (1e-5, 0, 3),
        (3, 0, 0),
        (-3, 0, 0),
        (-3, -1e-6, 0),
        (0, -3, 0),
    ]
    places += [(3 * NEAR, 0, 4 * NEAR), (-3e4, 2e4, 1e4), (0, 0, 0)]
    identity = Pose(torch.zeros(3), torch.eye(3))
    for dtype in (torch.float64, torch.float32):
        means = torch.tensor(places, dtype=dtype, device=device).requires_grad_()
        semi_axes = (
            (0.1 * torch.eye(3, dtype=dtype, device=device))
            .repeat(2, len(places), 1, 1)
            .requires_grad_()
        )
        splats = projection.project(means, semi_axes, identity)
        shapes = {
            "means2d": (len(places), 2),
            "factors": (2, len(places), 3),
            "depths": (len(places),),
        }
        for name, shape in shapes.items():
            require_tensor(f"{name} at hard places", getattr(splats, name), shape, dtype, device)
        hidden = [place == (0, 0, 0) for place in places]
        require(
            (~splats.visible).tolist() == hidden,
            "a Gaussian must be hidden if it sits on the receiver, else not",
        )
        require_close(
            splats.depths, means.norm(dim=-1), 1e-5, "depths must be distances to the receiver"
        )
        require_gradients(
            [splats.means2d, splats.factors], {"means": means, "semi_axes": semi_axes}
        )
        require(splats.factors[..., [0, 2]].gt(0).all(), "p and r of factors must be above 0")
        shared = projection.project(means, semi_axes[:1], identity).factors
        require_close(
            shared, splats.factors[:1], 1e-6, "factors must not depend on the other transmitters"
        )


def _check_frames(projection: Projection, points: Tensor) -> None:
    """A projection commutes with a common rotation and shift of receiver and Gaussians."""
    n, exact = len(points), {"dtype": points.dtype, "device": points.device}
    turn = quaternions_to_rotations(torch.tensor([0.4, -0.2, 0.7, 0.1], **exact))
    receiver = Pose(torch.tensor([1.0, -2.0, 0.5], **exact), turn)
    semi_axes = torch.diag(torch.tensor([0.1, 0.14, 0.22], **exact))
    here = projection.project(
        points, semi_axes.expand(1, n, 3, 3), Pose(torch.zeros(3), torch.eye(3))
    )
    there = projection.project(
        receiver.world(points), (turn @ semi_axes).expand(1, n, 3, 3), receiver
    )
    for name in ("means2d", "factors", "depths"):
        rule = f"{name} must be those in the receiver's own frame"
        require_close(getattr(there, name), getattr(here, name), 1e-9, rule)
