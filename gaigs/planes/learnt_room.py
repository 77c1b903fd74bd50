"""The learnt room of mirrored Gaussians: planes as polygons, obstacles and paths, for figures."""

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from gaigs.core.propagation import fresnel
from gaigs.core.results import plot
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.planes.room_paths import (
    LearntPath,
    TracedPaths,
    list_paths,
    spread_links,
    thin_links,
    trace_paths,
)
from gaigs.splatting.placement.mirrored.paths import Mirrored

NEPER = 20 / math.log(10)
"""One neper of a field [dB]."""


class PlaneTable(NamedTuple):
    """All learnt planes, float64."""

    normals: Float[ndarray, "w 3"]  # unit normals out of the room
    offsets: Float[ndarray, " w"]  # along the normals from the world's origin [m]
    losses: Float[ndarray, " w"]  # least losses of a reflection at normal incidence [dB]
    middles: Float[ndarray, "w 3"]  # points with the least losses [m]
    # Standard deviations of the reflecting areas along the world's axes [m].
    extents: Float[ndarray, "w 3"]


class LearntPlane(NamedTuple):
    """A learnt plane as a polygon for figures."""

    number: int  # as in ``metrics.json``
    # A convex polygon, counterclockwise as seen from outside the room [m].
    corners: Float[ndarray, "c 3"]
    normal: Float[ndarray, "3"]  # unit normal out of the room
    share: float  # share of the paths at the plane in the received power


class Matter(NamedTuple):
    """Learnt obstacles of a room: k Gaussians of matter, and m boxes with sharp edges."""

    centres: Float[ndarray, "k 3"]  # [m]
    widths: Float[ndarray, "k 3"]  # standard deviations along the world's axes [m]
    densities: Float[ndarray, " k"]  # densities at the centres [dB/m]
    boxes: Float[ndarray, "m 8 3"] = np.zeros((0, 8, 3))  # corners [m]
    # Losses by the boxes, however long the way inside [dB].
    losses: Float[ndarray, " m"] = np.zeros(0)


class LearntRoom(NamedTuple):
    """The parts of a learnt room in figures."""

    planes: list[LearntPlane]  # strongest first
    matter: Matter | None  # None without obstacles
    paths: list[LearntPath]  # a transmitter's strongest paths

    def plot(self, ax: Any = None, **options: Any) -> Any:
        """Draws the room by ``gaigs.plot``, which lists the options."""
        return plot(self, ax, **options)


@torch.no_grad()
def build_room(placement: Mirrored, links: Links | None = None) -> LearntRoom:
    """The learnt room, from paths of links.

    Paths of some training links outline the planes; without links, paths of ``spread_links`` do.
    With links, the paths of the first test transmitter are drawn.
    """
    if links is None:
        query = spread_links(placement.scene)
    else:
        query = thin_links(links.query[links.split.train])
    planes = outline_planes(placement, trace_paths(placement, query))
    matter = None
    if placement.obstacles is not None:
        obstacles = placement.obstacles
        columns = [
            obstacles.centres + placement.middle,
            obstacles.widths,
            NEPER * obstacles.densities,
            obstacles.box_corners + placement.middle,
            NEPER * obstacles.box_depths[obstacles.used].clamp_min(0),
        ]
        matter = Matter(*(column.cpu().double().numpy() for column in columns))
    paths: list[LearntPath] = []
    if links is not None:
        test = links.query[links.split.test]
        is_first_place = (test.transmitters == test.transmitters[:1]).all(1)
        if test.frequencies is not None:
            is_first_place &= test.frequencies == test.frequencies[:1]
        paths = list_paths(placement, test[is_first_place])
    return LearntRoom(planes, matter, paths)


@torch.no_grad()
def tabulate_planes(placement: Mirrored, ends: Float[ndarray, "k 3"]) -> PlaneTable:
    """All planes of a placement, with normals away from the middle of the paths' ``ends``."""
    real = 1 + placement.log_permittivities.exp()
    permittivities = torch.complex(real, -placement.log_conductivities.exp())
    reflected, _ = fresnel(permittivities, torch.ones_like(real))
    gains = reflected.abs().log() + placement.plane_gains  # [Np]
    middles = placement.middles + placement.middle.double()  # from the world's origin
    columns = placement.normals, placement.planes[:, 3], gains, middles, placement.log_extents.exp()
    normals, offsets, gains, middles, extents = (part.double().cpu().numpy() for part in columns)
    # The middle of the reflecting area need not lie on the plane: take the plane's point x with
    # the least loss |E^-1 (x - middle)|² / 2 [Np], where E = diag(extents). By Lagrange's
    # multiplier it is middle + apart / spread steep, with steep = E² n and spread = n' E² n.
    steep = extents**2 * normals
    spread = (steep * normals).sum(1)
    apart = offsets - (normals * middles).sum(1)
    middles = middles + (apart / spread)[:, None] * steep
    losses = NEPER * (apart**2 / spread / 2 - gains)
    centre = (ends.min(0) + ends.max(0)) / 2
    signs = np.where(normals @ centre > offsets, -1.0, 1.0)
    return PlaneTable(signs[:, None] * normals, signs * offsets, losses, middles, extents)


def other_offset(scene: Scene, planes: PlaneTable, number: int) -> float | None:
    """The second offset [m] at which a plane would give all paths the same lengths.

    A plane has such an offset if its normal is an axis along which places do not vary, see
    ``FlatAxis``. The result is None for any other plane.
    """
    normal = planes.normals[number]
    for flat in scene.flat_axes:
        if abs(normal[flat.axis]) > 0.99:
            heights = flat.transmitters + flat.receivers
            return float(normal[flat.axis] * heights - planes.offsets[number])
    return None


class HalfSpace(NamedTuple):
    """Points x with normal . x <= offset [m]."""

    normal: Float[ndarray, "3"]
    offset: np.floating


def outline_planes(placement: Mirrored, traced: TracedPaths) -> list[LearntPlane]:
    """The planes as convex polygons, strongest first.

    A wall has all transmitters and receivers on one side. It extends to the other walls, to the
    edge of its reflecting area, or to the box around the paths' ends, whichever is nearest. Any
    other plane, such as furniture, is the rectangle around its reflection points, cut by walls and
    box. Planes without paths, or outside the box, are omitted.
    """
    table = tabulate_planes(placement, traced.ends)
    plane_shares = traced.plane_shares
    shares = traced.shares
    # Bounces with at least a hundredth of a link's power count as points of their planes.
    bounces = traced.bounces[shares >= 0.01].reshape(-1, 3)
    points = np.concatenate((traced.ends, bounces))
    points = points[~np.isnan(points).any(1)]
    lower, upper = points.min(0), points.max(0)
    diagonal = np.linalg.norm(upper - lower)
    margin = 0.1 * diagonal  # so large that planes meet within the box
    box = _sides(lower - margin, upper + margin)
    tolerance = 0.02 * diagonal  # places and walls are uncertain
    walls = []
    for number in plane_shares:
        heights = traced.ends @ table.normals[number] - table.offsets[number]
        if (heights <= tolerance).all():
            walls.append(number)
    drawn = []
    for number, share in plane_shares.items():
        if not ((traced.sequences == number).any(1) & (shares > 0)).any():
            continue
        normal = table.normals[number]
        sides = [*box]
        for wall in walls:
            # Walls that face the same way, such as one behind another, do not cut each other.
            if wall != number and table.normals[wall] @ normal < 0.9:
                sides.append(HalfSpace(table.normals[wall], table.offsets[wall]))
        if number in walls:
            edge = 2 * table.extents[number]  # there it reflects 17 dB less than in its middle
            sides += _sides(table.middles[number] - edge, table.middles[number] + edge)
            # A square about the foot of the room's centre, so large that the sides cut it.
            centre = (lower + upper) / 2
            middle = centre - (centre @ normal - table.offsets[number]) * normal
            half = np.full(2, 2 * diagonal)
            corners = _rectangle(middle, normal, -half, half)
        else:
            corners = _furniture_corners(table, number, traced, tolerance)
        for side in sides:
            corners = _cut(corners, side)
        if len(corners):
            drawn.append(LearntPlane(number, corners, normal, share))
    return drawn


def _furniture_corners(
    table: PlaneTable, number: int, traced: TracedPaths, tolerance: np.floating
) -> Float[ndarray, "4 3"]:
    """The rectangle around the reflection points of a plane, with a margin ``tolerance`` [m].

    Paths with less than 1 % of the strongest share do not count.
    """
    shares = traced.shares
    # Each reflection at the plane: number of the link, of the path, and position in its sequence.
    link, path, step = np.nonzero((traced.sequences == number) & (shares > 0)[..., None])
    share = shares[link, path]
    points = traced.bounces[link, path, step][share >= 0.01 * share.max()]
    normal = table.normals[number]
    middle = table.offsets[number] * normal
    flat = (points - middle) @ _basis(normal)  # (points, 2)
    return _rectangle(middle, normal, flat.min(0) - tolerance, flat.max(0) + tolerance)


def _basis(normal: Float[ndarray, "3"]) -> Float[ndarray, "3 2"]:
    """Two unit vectors of a plane, right-handed with its normal; the first is horizontal."""
    level = np.cross((0.0, 0.0, 1.0), normal)
    length = np.linalg.norm(level)
    level = level / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
    return np.stack((level, np.cross(normal, level)), 1)


def _rectangle(
    middle: Float[ndarray, "3"],
    normal: Float[ndarray, "3"],
    low: Float[ndarray, "2"],
    high: Float[ndarray, "2"],
) -> Float[ndarray, "4 3"]:
    """Corners of a rectangle on a plane, counterclockwise when seen against the normal.

    ``low`` and ``high`` are bounds from ``middle`` along ``_basis`` [m].
    """
    flat = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])])
    return middle + flat @ _basis(normal).T


def _sides(lower: Float[ndarray, "3"], upper: Float[ndarray, "3"]) -> list[HalfSpace]:
    """The six sides of a box [m]."""
    axes = np.eye(3)
    above = [HalfSpace(axis, offset) for axis, offset in zip(axes, upper, strict=True)]
    below = [HalfSpace(-axis, -offset) for axis, offset in zip(axes, lower, strict=True)]
    return above + below


def _cut(corners: Float[ndarray, "c 3"], side: HalfSpace) -> Float[ndarray, "k 3"]:
    """The part of a convex polygon in a half-space.

    Source: Sutherland and Hodgman, Reentrant polygon clipping, 1974.
    """
    heights = corners @ side.normal - side.offset  # above 0 outside
    remaining = []
    for k in range(len(corners)):
        start, end = corners[k - 1], corners[k]
        start_height, end_height = heights[k - 1], heights[k]
        if (start_height > 0) != (end_height > 0):  # the edge crosses the side
            fraction = start_height / (start_height - end_height)
            remaining.append(start + fraction * (end - start))
        if end_height <= 0:
            remaining.append(end)
    return np.array(remaining).reshape(-1, 3)
