"""Planes whose positions a placement learns, and the sequences of planes of its paths."""

import logging
import math
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.splatting.placement import Placement
from gaigs.splatting.placement.mirrored.reflections import (
    all_sequences,
    largest_order,
    seen_from,
)
from gaigs.splatting.placement.mirrored.walls import read_planes

log = logging.getLogger(__name__)


class MovablePlanes(Placement):
    """Trainable planes of a room, and the sequences in which paths meet them.

    Offsets of planes are measured from the middle of the room. Rounding and rotations of a plane
    therefore do not depend on the world's origin.

    Attributes:
        middle: Middle of the room [m].
        diagonal: Diagonal of the box that holds transmitters and receivers [m].
        turn: Rotation from the world's axes to the first planes' axes.
        origin: Normals and offsets (w, 4) to which ``shifts`` are added: the first planes, or the
            planes at the last change of ``step``. Offsets are from ``middle`` [m].
        first: ``origin`` before any training; ``fit`` compares it to find new planes.
        shifts: Learnt changes of normals and offsets (w, 4). The unit is ``step`` for normals, and
            ``step`` times ``unit`` diagonals for offsets.
        step: Size of a unit of ``shifts``; proportional to the wavelength once paths interfere.
        sequences: Planes of each path, -1 for no plane (n, order).
        kept: True for paths in use (n,); pruning drops paths.
        most: Number of paths in use at the start.
        is_new: True until the planes have been trained; set by ``fit``.

    Args:
        scene: Its box and receivers give the first planes.
        planes: Largest number of planes; ``faces`` at the start.
        order: Largest number of reflections of a path.
        walls: File of the first planes, see ``read_planes``. None: the faces of the box.
        fixed: True if planes are not trained.
    """

    faces = 6
    """Planes at the start: one beyond each face of the box, if it has this side."""
    margin = 0.04
    """Distance of these planes from the box [diagonals]."""
    unit = 0.12
    """Unit of plane offsets [diagonals]: learning rates suit rooms of any size."""

    middle: Tensor
    turn: Tensor
    origin: Tensor
    first: Tensor
    step: Tensor
    sequences: Tensor
    kept: Tensor
    most: Tensor

    def __init__(self, scene: Scene, planes: int, order: int, walls: str | None, fixed: bool):
        super().__init__()
        self._check_number("planes", planes, self.faces)
        self._check_number("order", order, 0)
        max_sequences = 100_000  # each has parameters; 10 planes of order 5
        highest = largest_order(planes, max_sequences)
        if order > highest:
            raise ValueError(
                f"placement.order={order} gives more than {max_sequences:,} sequences of {planes} "
                "planes, each with parameters\n"
                f"set placement.order={highest} or less, or fewer placement.planes"
            )
        self.scene = scene
        self.order = order
        self.walls = walls
        self.fixed = fixed
        self.box = scene.box
        self.is_new = False
        lower, upper = self.box
        half = (upper - lower) / 2
        self.diagonal = 2 * float(half.norm())
        self.register_buffer("middle", lower + half, persistent=False)
        self.register_buffer("turn", torch.eye(3), persistent=False)
        self.register_buffer("origin", self._first_planes(planes, half))
        # ``fit`` turns the planes only while the two are equal: a checkpoint's origin differs.
        self.register_buffer("first", self.origin.clone(), persistent=False)
        self.register_buffer("step", torch.ones(()))
        self.register_buffer("sequences", all_sequences(planes, order), persistent=False)
        self.register_buffer("kept", self._first_paths())
        self.register_buffer("most", self.kept.sum())
        self.shifts = nn.Parameter(torch.zeros(planes, 4), requires_grad=not fixed)

    @staticmethod
    def _check_number(option: str, value: int, least: int) -> None:
        if value < least:
            raise ValueError(f"placement.{option} must be at least {least}, got {value}")

    def _first_planes(self, planes: int, half: Float[Tensor, "3"]) -> Float[Tensor, "w 4"]:
        """Normals and offsets at the start: the faces of a box, then planes through its middle.

        Args:
            planes: Number of planes w.
            half: Half of the box's edge lengths [m].
        """
        further = planes - self.faces
        axes = torch.eye(3)
        repeated_axes = axes.repeat(math.ceil(further / 3), 1)
        normals = torch.cat((axes, -axes, repeated_axes))[:planes]
        face_offsets = half + self.margin * self.diagonal  # (3,)
        offsets = torch.cat((face_offsets, face_offsets, torch.zeros(further)))
        # A random tilt: parallel planes would have equal gradients.
        normals = normals + 0.05 * torch.randn(planes, 3)
        return torch.cat((normals, offsets[:, None]), 1)

    def _first_paths(self) -> Bool[Tensor, " n"]:
        """True for the paths in use at the start: paths that meet only faces of the box.

        Faces across an axis are left out if all transmitters and receivers share a coordinate on
        this axis, such as the height. Labels then do not depend on the distance of such a face.
        """
        axes = [flat.axis for flat in self.scene.flat_axes if flat.is_common]
        # Planes 0 to 5 are the faces +x, +y, +z, -x, -y, -z.
        face_axes = torch.arange(self.faces) % 3
        is_unseen = torch.isin(face_axes, torch.tensor(axes, dtype=torch.long))
        unseen_faces = is_unseen.nonzero()[:, 0]
        has_faces_only = (self.sequences < self.faces).all(1)  # (n,); -1 is no plane
        return has_faces_only & ~torch.isin(self.sequences, unseen_faces).any(1)

    def fit(self, links: Links) -> None:
        """Sets the first planes: the user's walls, or the faces of the places' smallest box.

        Planes that have been trained are not changed. ``is_new`` and ``turn`` are set, too, unless
        there are walls.
        """
        if self.walls is not None:
            self._place_walls(Path(self.walls))
            return
        self.is_new = torch.equal(self.origin, self.first) and not self.shifts.any()
        places = links.query.transmitters[links.split.train]
        self.turn = upright_turn(places).to(self.origin)
        is_turned = not torch.equal(self.turn, torch.eye(3).to(self.turn))
        if self.is_new and is_turned:
            faces = torch.cat((self.turn.mT, -self.turn.mT))  # outward normals (6, 3)
            points = torch.cat((places, self.scene.positions(places))).to(self.origin)
            farthest = ((points - self.middle) @ faces.mT).amax(0)  # (6,) [m]
            self.origin[: self.faces, :3] = self.first[: self.faces, :3] @ self.turn.mT
            self.origin[: self.faces, 3] = farthest + self.margin * self.diagonal

    def _place_walls(self, file: Path) -> None:
        """Sets the first planes to the largest planes of a file of walls.

        Paths at other planes are not in use.
        """
        planes = read_planes(file, *self.box).to(self.origin)
        most = len(self.origin)
        if len(planes) > most:
            log.warning(
                "placement.planes: %s has %d planes, the first %d are taken",
                file,
                len(planes),
                most,
            )
        planes = planes[:most]
        for number, plane in enumerate(planes):
            self.place(number, plane)
        self.kept.copy_(self.sequences_of(torch.arange(len(planes))))
        self.most.copy_(self.kept.sum())

    @property
    def normals(self) -> Float[Tensor, "w 3"]:
        """Unit normals of all planes."""
        return functional.normalize(self.origin[:, :3] + self.step * self.shifts[:, :3], dim=1)

    @property
    def offsets(self) -> Float[Tensor, " w"]:
        """Offsets of all planes along their normals, from the middle of the room [m]."""
        return self.origin[:, 3] + self.step * self.unit * self.diagonal * self.shifts[:, 3]

    @property
    def planes(self) -> Float[Tensor, "w 4"]:
        """Normals and offsets of all planes in the world frame [m]."""
        return seen_from(torch.cat((self.normals, self.offsets[:, None]), 1).double(), -self.middle)

    @property
    def used(self) -> Int[Tensor, " k"]:
        """Numbers of the planes of all kept paths, ascending."""
        numbers = self.sequences[self.kept].unique()
        return numbers[numbers >= 0]

    def sequences_of(self, planes: Int[Tensor, " k"]) -> Bool[Tensor, " n"]:
        """True for sequences without other planes than these; also for the direct path."""
        allowed = torch.cat((planes, planes.new_tensor([-1])))  # -1 is no plane
        return torch.isin(self.sequences, allowed.to(self.sequences.device)).all(1)

    @torch.no_grad()
    def place(self, number: int, plane: Float[Tensor, "4"]) -> None:
        """Replaces a plane by one in the world frame (normal, offset [m])."""
        self.origin[number] = seen_from(plane.double(), self.middle)
        self.shifts[number] = 0

    @property
    def room_axes(self) -> Float[Tensor, "3 3"]:
        """Axes of an upright room in columns; the third is the z axis.

        The first axis is the normal of the first vertical plane in use, or the world's x axis if
        there is none.
        """
        normals = self.normals[self.used]
        upright = normals[normals[:, 2].abs() < 0.1]  # normals of vertical planes
        first = upright[0] if len(upright) else normals.new_tensor([1.0, 0.0, 0.0])
        up = first.new_tensor([0.0, 0.0, 1.0])
        across = functional.normalize(torch.linalg.cross(up, first), dim=0)
        return torch.stack((torch.linalg.cross(across, up), across, up), 1)

    @torch.no_grad()
    def move_by_wavelengths(self, wavelength: float) -> None:
        """Sets ``step`` in proportion to the wavelength [m], and restarts ``shifts`` at 0.

        The planes stay where they are: moves so far go into ``origin``.
        """
        self.origin.copy_(torch.cat((self.normals, self.offsets[:, None]), 1))
        self.shifts.zero_()
        # 2.2 wavelengths: a usual step of 0.01 then turns a phase by a tenth of a radian.
        self.step.fill_(min(1.0, 2.2 * wavelength / (self.unit * self.diagonal)))


def upright_turn(
    places: Float[Tensor, "n 3"], smaller: float = 0.85, width: float = 0.25, enough: int = 40
) -> Float[Tensor, "3 3"]:
    """Rotation about z from the world's axes to those of the smallest upright box of the places.

    Args:
        places: Transmitters [m].
        smaller: Largest ratio of the box's area to the area of the box along the world's axes. With
            a larger ratio there is no rotation.
        width: Smallest ratio of the box's width to its length, since places along a line do not
            show the orientation of walls.
        enough: Smallest number of places for a rotation. In a room along the world's axes, a false
            rotation is very rare with 40 places, and occurs in a quarter of cases with 10.
    """
    turn = torch.eye(3, dtype=torch.float64)
    if len(places.unique(dim=0)) < enough:
        return turn.to(places)
    angles = torch.arange(0, 90, dtype=torch.float64).deg2rad()
    cos, sin = angles.cos(), angles.sin()
    rows = torch.stack((cos, -sin), 1), torch.stack((sin, cos), 1)  # of the rotation matrices
    axes = torch.stack(rows, 1)  # (angles, 2, 2)
    along = places[:, :2].double() @ axes  # (angles, n, 2)
    edges = along.amax(1) - along.amin(1)  # of the box at each angle (angles, 2) [m]
    areas = edges.prod(1)
    best = int(areas.argmin())
    if areas[best] < smaller * areas[0] and edges[best].min() > width * edges[best].max():
        turn[:2, :2] = axes[best]
    return turn.to(places)
