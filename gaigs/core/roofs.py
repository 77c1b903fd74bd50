"""Buildings and ground between the ends of a link: blocking of the direct path, loss over edges."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from matplotlib.path import Path as Outline
from numpy import ndarray
from torch import Tensor
from torch.nn import functional


class Building(NamedTuple):
    """A block with a flat roof."""

    rings: list[Float[ndarray, "_ 2"]]  # footprint: the outline and its holes [m]
    height: float  # of the roof above the ground [m]
    ground: float = math.nan  # height of the ground, world frame; NaN: that of the grid [m]


class SiteGrid(NamedTuple):
    """Square cells over an area."""

    lower: tuple[float, float]  # lower corner, x and y [m]
    cell: float  # edge of a cell [m]
    rows: int  # along y
    columns: int  # along x


class Roofs(NamedTuple):
    """Heights of roofs and of the ground on a grid."""

    # Height of the roof above each cell's middle, world frame, far below it without a building [m].
    heights: Float[Tensor, "rows columns"]
    lower: tuple[float, float]  # lower corner of the grid, x and y [m]
    cell: float  # edge of a cell [m]
    ground: Float[Tensor, "rows columns"] | None = None  # None: no terrain is known [m]

    def ground_at(self, points: Float[Tensor, "b 3"]) -> Float[Tensor, " b"]:
        """Height of the ground below points [m], interpolated linearly between cells.

        Outside the grid it is the height at the nearest margin; without a terrain it is 0.
        """
        if self.ground is None:
            return torch.zeros_like(points[:, 0])
        sides = self.cell * torch.tensor(self.ground.shape[::-1]).to(points)
        corner = torch.tensor(self.lower).to(points)
        places = 2 * (points[:, :2] - corner) / sides - 1  # (b, 2), from -1 to 1 within the grid
        ground = self.ground.to(points)[None, None]  # (1, 1, rows, columns)
        options = {"padding_mode": "border", "align_corners": False}
        return functional.grid_sample(ground, places[None, None], **options)[0, 0, 0]


def plan_grid(
    lower: Float[ndarray, "2"],
    upper: Float[ndarray, "2"],
    cell: float = 1.0,  # [m]; footprints are seldom known better
    most: float = 4e6,  # cells; 16 MB of a checkpoint
) -> SiteGrid:
    """A grid over a box [m]; cells are enlarged if there would be more than ``most``."""
    size = upper - lower
    cell = max(cell, math.sqrt(size.prod() / most))
    columns, rows = np.ceil(size / cell).astype(int) + 1  # at least one
    return SiteGrid((float(lower[0]), float(lower[1])), cell, int(rows), int(columns))


def rasterize_roofs(
    buildings: Sequence[Building],
    grid: SiteGrid,
    ground: Float[ndarray, "rows columns"] | None = None,
    nothing: float = -1e4,  # [m], without a building; a checkpoint takes finite numbers alone
) -> Roofs:
    """The roofs on a grid; where buildings overlap, the highest one.

    Args:
        buildings: Buildings, of which parts outside the grid are left out.
        grid: Cells of the result.
        ground: Height of the ground in each cell [m]. A building whose ground is unknown stands on
            the mean below its footprint, or at 0 without ``ground``.
        nothing: Height of a cell without a building.
    """
    heights = np.full((grid.rows, grid.columns), nothing, dtype=np.float32)
    for building in buildings:
        corners = (building.rings[0] - grid.lower) / grid.cell  # in cells
        # Columns and rows of the cells that the outline may cover, the last ones excluded.
        first = np.floor(corners.min(0)).astype(int).clip(0)
        last = np.ceil(corners.max(0)).astype(int).clip(max=(grid.columns, grid.rows))
        if (first >= last).any():  # outside the grid
            continue
        x, y = np.meshgrid(np.arange(first[0], last[0]), np.arange(first[1], last[1]))
        middles = np.stack((x.ravel(), y.ravel()), 1) + 0.5  # (k, 2)
        is_inside = Outline(corners).contains_points(middles)
        for hole in building.rings[1:]:
            is_inside &= ~Outline((hole - grid.lower) / grid.cell).contains_points(middles)
        if not is_inside.any():  # smaller than a cell
            continue
        is_inside = is_inside.reshape(x.shape)
        area = slice(first[1], last[1]), slice(first[0], last[0])
        base = building.ground
        if math.isnan(base):
            base = 0.0 if ground is None else float(ground[area][is_inside].mean())
        roof = np.where(is_inside, base + building.height, nothing)
        heights[area] = np.maximum(heights[area], roof)
    below = None if ground is None else torch.from_numpy(ground)
    return Roofs(torch.from_numpy(heights), grid.lower, grid.cell, below)


def obstruct(
    roofs: Roofs,
    starts: Float[Tensor, "b 3"],
    ends: Float[Tensor, "b 3"],
    wavelength: float,
    most: int = 2**21,  # samples at a time; a temporary of 8 MB
) -> Float[Tensor, "b 4"]:
    """Obstruction of the direct paths from ``starts`` to ``ends`` [m] by roofs and ground.

    Paths are sampled about once in each cell. Samples within 1.5 cells of an end do not count,
    since the cell of an antenna at a wall may belong to the building. The knife-edge loss depends
    on the ``wavelength`` [m]. The curvature of the earth, with an effective radius of 8,500 km,
    raises obstacles between the ends.

    Returns:
        Four numbers for each path: 1 if a roof is above it, else 0; its length inside buildings
        [m]; the number of walls that it crosses; its knife-edge loss over roofs and ground [dB].

    Source: ITU-R P.526-15, sections 4.1 and 4.5.1.
    """
    # Horizontal lengths of the paths (b, 1) [m].
    plan = (ends - starts)[:, :2].norm(dim=1, keepdim=True).clamp_min(1e-3)
    count = max(2, math.ceil(plan.max().item() / roofs.cell)) if len(plan) else 2  # samples a path
    if len(plan) * count > most and len(plan) > 1:
        halves = zip(starts.tensor_split(2), ends.tensor_split(2), strict=True)
        return torch.cat([obstruct(roofs, *half, wavelength, most) for half in halves])
    fractions = (torch.arange(count).to(starts) + 0.5) / count  # (k,)
    # Coordinates and height of the samples (b, k) each.
    x, y, path = torch.lerp(starts.T[..., None], ends.T[..., None], fractions)
    before = plan * fractions  # horizontal distance from the start (b, k)
    rows, columns = roofs.heights.shape
    column = ((x - roofs.lower[0]) / roofs.cell).floor().long()
    row = ((y - roofs.lower[1]) / roofs.cell).floor().long()
    # True for samples that count: on the grid, and away from the ends.
    counts = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    counts &= torch.minimum(before, plan - before) > 1.5 * roofs.cell
    cells = row.clamp(0, rows - 1), column.clamp(0, columns - 1)
    bulge = before * (plan - before) / (2 * 8.5e6)  # of the earth (b, k)
    roof = (roofs.heights.to(x)[cells] + bulge).where(counts, -math.inf)
    surface = roof
    if roofs.ground is not None:
        points = torch.stack((x, y, path), -1).flatten(0, 1)  # (b k, 3)
        ground = (roofs.ground_at(points).view_as(x) + bulge).where(counts, -math.inf)
        surface = torch.maximum(roof, ground)
    is_blocked = roof > path  # (b, k)
    inside = is_blocked.sum(1) * (ends - starts).norm(dim=1) / count
    walls = (is_blocked[:, 1:] != is_blocked[:, :-1]).sum(1).to(path)
    loss = knife_edge(_bullington(surface, starts[:, 2:], ends[:, 2:], before, plan, wavelength))
    # The correction of Bullington's method for further edges.
    loss += (1 - (-loss / 6).exp()) * (10 + 2e-5 * plan[:, 0])
    return torch.stack((is_blocked.any(1).to(path), inside, walls, loss), 1)


def _bullington(
    surface: Float[Tensor, "b k"],
    start: Float[Tensor, "b 1"],
    end: Float[Tensor, "b 1"],
    before: Float[Tensor, "b k"],
    plan: Float[Tensor, "b 1"],
    wavelength: float,
) -> Float[Tensor, " b"]:
    """Parameter v of ``knife_edge`` for each path, if one edge replaces all its obstacles.

    If the surface blocks the path, the edge is where the steepest lines from both ends meet.
    Otherwise it is the sample with the largest v.

    Args:
        surface: Heights at the samples of the path [m], -inf where nothing counts.
        start, end: Heights of the ends [m].
        before: Horizontal distance of each sample from the start [m].
        plan: Horizontal distance between the ends [m].
        wavelength: Wavelength [m].

    Source: ITU-R P.526-15, section 4.5.1.
    """
    # Slopes of the steepest lines from the start and from the end to a sample (b, 1).
    up = ((surface - start) / before).amax(1, keepdim=True)
    down = ((surface - end) / (plan - before)).amax(1, keepdim=True)
    is_free = up <= (end - start) / plan
    # Distance from the start to the edge, and height of the edge: one for a blocked path, one for
    # each sample of a free one.
    to_edge = (end - start + down * plan) / (up + down)  # (b, 1)
    to_edge = torch.where(is_free, before, to_edge)  # (b, k)
    edge = torch.where(is_free, surface, start + up * to_edge)
    from_edge = plan - to_edge
    above = edge - (start * from_edge + end * to_edge) / plan  # above the direct path
    v = above * (2 * plan / (wavelength * to_edge * from_edge)).sqrt()
    return v.amax(1).clamp_min(-1.0)


def knife_edge(v: Tensor) -> Tensor:
    """J(v) = 6.9 + 20 log10(sqrt((v - 0.1)² + 1) + v - 0.1) [dB], 0 below v = -0.78.

    v = h sqrt(2 / lambda (1 / d1 + 1 / d2)), with h the height of the edge above the direct path
    and d1, d2 its distances from the ends.

    Source: ITU-R P.526-15, equations (29) and (31).
    """
    shifted = v - 0.1
    loss = 6.9 + 20 * ((shifted.square() + 1).sqrt() + shifted).log10()
    return torch.where(v > -0.78, loss, 0).clamp_min(0)
