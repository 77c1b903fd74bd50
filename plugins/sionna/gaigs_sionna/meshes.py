"""Rooms of any shape as meshes of planar faces."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from gaigs.core.geometry import Pose
from gaigs.io.meshes import Mesh

THICKNESS = {
    "concrete": 0.2,
    "brick": 0.12,
    "plasterboard": 0.0125,
    "wood": 0.018,
    "glass": 0.008,
    "ceiling_board": 0.02,
    "metal": 0.002,
}
"""Thickness of the slab behind a face of each material [m]; furniture is hollow, of boards."""

WALL_MARGIN = 0.3
"""Smallest distance of transmitters from walls [m]."""

FURNITURE_MARGIN = 0.05
"""Smallest distance of transmitters from furniture [m]."""


@dataclass(frozen=True)
class Cuboid:
    """An upright piece of furniture, or a part of one.

    Attributes:
        material: Material of its sides, one of ``THICKNESS``.
        lower, upper: Opposite corners before the rotation, world frame [m].
        turn: Rotation about the vertical through its middle, counterclockwise [deg].
    """

    name: str
    material: str
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    turn: float = 0.0

    def mesh(self) -> Mesh:
        """The closed mesh of its six sides; seen from outside they run counterclockwise."""
        cos, sin, (u, v, _) = self._frame()
        corners = []
        for z, y, x in itertools.product(*zip(self.lower[::-1], self.upper[::-1], strict=True)):
            across = x - u
            along = y - v
            turned_x = round(u + cos * across - sin * along, 6)
            turned_y = round(v + sin * across + cos * along, 6)
            corners.append((turned_x, turned_y, z))
        sides = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5))
        return Mesh(self.name, self.material, tuple(corners), sides)

    def contains(self, points: Float[Tensor, "k 3"], margin: float) -> Bool[Tensor, " k"]:
        """True for points [m] within it, or less than a margin [m] from it along its axes."""
        cos, sin, middle = self._frame()
        x, y, z = (points - points.new_tensor(middle)).unbind(-1)
        local = torch.stack((cos * x + sin * y, cos * y - sin * x, z), -1)  # (k, 3)
        half = (points.new_tensor(self.upper) - points.new_tensor(self.lower)) / 2
        return (local.abs() <= half + margin).all(-1)

    def _frame(self) -> tuple[float, float, tuple[float, ...]]:
        """Cosine and sine of the rotation, and the middle [m]."""
        middle = tuple((low + high) / 2 for low, high in zip(self.lower, self.upper, strict=True))
        return math.cos(math.radians(self.turn)), math.sin(math.radians(self.turn)), middle


@dataclass(frozen=True)
class MeshRoom:
    """A room between a floor and a ceiling with as many corners, with furniture and receivers.

    Attributes:
        floor: Corners (x, y) of the floor, counterclockwise [m].
        ceiling: Corners (x, y) of the ceiling, one for each of the floor's; walls lean between
            different ones [m].
        height: Height of the ceiling [m].
        convex: Corners of the convex parts of floor and ceiling.
        walls: Material of each wall, from a corner to the next.
        slabs: Materials of floor and ceiling.
        antenna: Position of the array [m], the point that it faces [m], and its rotation about the
            normal [deg].
        gateways: Positions of the receivers with a single antenna, by name [m].
    """

    floor: tuple[tuple[float, float], ...]
    ceiling: tuple[tuple[float, float], ...]
    height: float
    convex: tuple[tuple[int, ...], ...]
    walls: tuple[str, ...]
    slabs: tuple[str, str]
    furniture: tuple[Cuboid, ...]
    antenna: tuple[tuple[float, float, float], tuple[float, float, float], float]
    gateways: dict[str, tuple[float, float, float]]

    def meshes(self) -> list[Mesh]:
        """Walls, floor, ceiling and furniture.

        Neighbouring walls of one material are one mesh, with a true edge.
        """
        count = len(self.floor)
        corners = (
            *((x, y, 0.0) for x, y in self.floor),
            *((x, y, self.height) for x, y in self.ceiling),
        )
        sides: dict[str, list[tuple[int, ...]]] = {}
        for k, material in enumerate(self.walls):
            after = (k + 1) % count
            sides.setdefault(material, []).append((k, after, count + after, count + k))
        above = []
        for part in self.convex:
            above.append(tuple(count + k for k in part))
        shell = [
            Mesh(f"{material} walls", material, corners, tuple(faces))
            for material, faces in sides.items()
        ]
        shell += [
            Mesh("floor", self.slabs[0], corners, self.convex),
            Mesh("ceiling", self.slabs[1], corners, tuple(above)),
        ]
        return [*(mesh.compact() for mesh in shell), *(cuboid.mesh() for cuboid in self.furniture)]

    def pose(self) -> Pose:
        """Pose of the receiver with the array: its normal points at the point that it faces."""
        return facing(*self.antenna)

    def is_free(self, points: Float[Tensor, "k 3"]) -> Bool[Tensor, " k"]:
        """True for points [m] inside, with the margins from walls and furniture."""
        start = self.outline(points[:, 2:, None])  # ends of each wall, at each point's height
        end = start.roll(-1, 1)  # (k, walls, 2)
        along = end - start
        to = points[:, None, :2] - start
        # Even-odd rule: the number of walls that a ray along x meets.
        above = start[..., 1] > points[:, None, 1]
        below = end[..., 1] > points[:, None, 1]
        cross = along[..., 0] * to[..., 1] - along[..., 1] * to[..., 0]
        meets = (above != below) & ((cross > 0) == (end[..., 1] > start[..., 1]))
        nearest = ((to * along).sum(-1) / along.square().sum(-1)).clamp(0, 1)
        distances = (to - nearest[..., None] * along).norm(dim=-1).amin(1)
        free = (meets.sum(1) % 2 == 1) & (distances >= WALL_MARGIN)
        return free & ~self.is_furnished(points)

    def outline(self, heights: float | Tensor) -> Float[Tensor, "*k walls 2"]:
        """Corners of the walls at heights (*k, 1, 1) [m], counterclockwise [m]."""
        dtype = heights.dtype if isinstance(heights, Tensor) else torch.float64
        ends = [torch.tensor(corners, dtype=dtype) for corners in (self.floor, self.ceiling)]
        return torch.lerp(*ends, heights / self.height)

    def is_furnished(self, points: Float[Tensor, "k 3"]) -> Bool[Tensor, " k"]:
        """True for points [m] in furniture, or less than a margin from it."""
        is_inside = torch.zeros(len(points), dtype=torch.bool)
        for cuboid in self.furniture:
            is_inside |= cuboid.contains(points, FURNITURE_MARGIN)
        return is_inside


def facing(position: Sequence[float], target: Sequence[float], turn: float = 0.0) -> Pose:
    """Pose at a position [m] with its normal towards a target [m], turned about it [deg]."""
    normal = torch.tensor(target, dtype=torch.float64) - torch.tensor(position, dtype=torch.float64)
    azimuth = torch.atan2(normal[1], normal[0])
    depression = torch.atan2(-normal[2], normal[:2].norm())
    angles = [azimuth.item(), math.pi / 2 + depression.item(), math.radians(turn)]
    return Pose.from_xyzw(position, Rotation.from_euler("ZYZ", angles).as_quat())


def edges(meshes: Sequence[Mesh]) -> Float[Tensor, "k 2 3"]:
    """Outlines of meshes [m]: each edge once, except between two coplanar faces of a mesh."""
    lines: dict[tuple, None] = {}
    for mesh in meshes:
        corners = torch.tensor(mesh.vertices, dtype=torch.float64)
        normals: dict[tuple[int, int], list[Tensor]] = {}
        for face in mesh.faces:
            normal = torch.linalg.cross(
                corners[face[1]] - corners[face[0]], corners[face[2]] - corners[face[0]]
            )
            for start, end in zip(face, (*face[1:], face[0]), strict=True):
                normals.setdefault((min(start, end), max(start, end)), []).append(
                    normal / normal.norm()
                )
        for (start, end), beside in normals.items():
            # The product of coplanar faces' normals is 1 or -1, up to rounding.
            if len(beside) < 2 or (beside[0] @ beside[1]).abs() < 1 - 1e-9:
                lines[tuple(sorted((mesh.vertices[start], mesh.vertices[end])))] = None
    return torch.tensor([*lines])
