"""Search for further planes parallel or perpendicular to a room's known planes."""

import logging

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from gaigs.core import stages
from gaigs.planes.channel_links import SLABS, ChannelData, SlabRoom
from gaigs.planes.channel_score import ChannelScore
from gaigs.planes.phase_proposals import propose_by_phases
from gaigs.planes.search import Candidate, PlaneSearch
from gaigs.splatting.placement.mirrored.reflections import distinct

log = logging.getLogger(__name__)


class AxisPlanes(PlaneSearch[SlabRoom]):
    """Search for planes whose normals are axes of a room, see ``room_axes``.

    Only the offsets along these axes are searched. With so few candidates, faint planes exceed the
    noise, and walls behind the array differ from the direct path. Walls are added before other
    planes. After each addition all planes are adjusted slightly.
    """

    score: ChannelScore

    def __init__(self, data: ChannelData, score: ChannelScore):
        super().__init__(data.frame, score)
        self.data = data

    def find_upright(self, room: SlabRoom) -> SlabRoom:
        """A room with one plane: the vertical plane that explains most of the channels.

        Its normal is one of the ``room_axes`` of ``room``. The result is empty if no such plane
        explains anything.
        """
        axes = room_axes(room.planes)
        horizontal = axes[axes[:, 2].abs() < 0.01]
        empty = SlabRoom(room.planes[:0], room.slabs[:0])
        walls, between = self.propose_along(empty, horizontal, least=0.0)
        trials = []
        for candidate in walls + between:
            for moved, material in self._propose_by_phases(candidate[None], 0, tilt=0.04):
                # Without its vertical part; the horizontal part of the normal gets length 1.
                upright = moved * moved.new_tensor([1.0, 1.0, 0.0, 1.0]) / moved[:2].norm()
                trials.append(SlabRoom(upright[None], material[None]))
        polished = [self.score.refine(trial) for trial in self.score.choose_best(trials)]
        return min(polished, key=self.score.error, default=empty)

    def grow_along(
        self, room: SlabRoom, most: int, others: Float[Tensor, "v 4"] | None = None
    ) -> SlabRoom:
        """The room after the addition of planes, with at most ``most`` planes in total.

        Walls with normals along the room's axes are added first. Planes with these normals between
        the places follow, then planes of ``others``.
        """
        count = len(room.planes)

        def extend(room: SlabRoom) -> SlabRoom | None:
            before = self.score.error(room)
            walls, between = self.propose_along(
                room, room_axes(room.planes), self.data.options.added_share
            )
            unused = []
            for plane in others if others is not None else []:
                if not self.frame.is_like(room.planes, plane).any():
                    unused.append(plane)
            for candidates in (walls, between, unused):
                if not candidates:
                    continue
                larger = self.add_best(room, candidates)
                if self.score.error(larger) < before:
                    larger = self.settle(larger)
                    log.info("%s, square to others", self.frame.describe(larger.planes[-1]))
                    return larger
            return None

        room = self.grow(room, most, extend)
        return self.settle(room, polishes=True) if len(room.planes) > count else room

    def propose_along(
        self, room: SlabRoom, normals: Float[Tensor, "k 3"], least: float
    ) -> tuple[list[Float[Tensor, "4"]], list[Float[Tensor, "4"]]]:
        """Planes with these normals that explain more than the fraction ``least`` of the residual.

        Returns:
            At most four walls, which have all places on one side, and at most four planes between
            the places, each list best first. In a single list planes between would displace walls.
        """
        walls: list[Candidate] = []
        between: list[Candidate] = []
        # 400 planes for each normal, evenly over the box and its margin (k, 400, 4).
        lines = self.frame.grid(normals, 400, self.data.options.margin)
        for line, shares in zip(lines, self.score.rate(room, lines).ratings, strict=True):
            for plane in room.planes:
                shares[self.frame.is_like(line, plane)] = 0
            heights = self.frame.points.to(line) @ line[0, :3]  # of places along the normal
            is_wall = (line[:, 3] < heights.min()) | (line[:, 3] > heights.max())
            for candidates, rated in ((walls, shares * is_wall), (between, shares * ~is_wall)):
                for row in find_maxima(rated, 11):
                    candidates.append(Candidate(line[row], rated[row].item()))
        return _strongest(walls, least), _strongest(between, least)

    def add_best(self, room: SlabRoom, candidates: list[Float[Tensor, "4"]]) -> SlabRoom:
        """The room with the best candidate, after a move to where phases agree.

        The room is unchanged if every candidate moves onto a known plane.
        """
        trials = []
        number = len(room.planes)
        for plane in candidates:
            planes = torch.cat((room.planes, plane[None]))
            for moved, material in self._propose_by_phases(planes, number, tilt=1e-4):
                if not self.frame.is_like(room.planes, moved).any():
                    trials.append(room.with_plane(moved, material))
        best = self.score.choose_best(trials)
        return self.score.polish(best[0], steps=12, rate=5e-4, only=number) if best else room

    def settle(self, room: SlabRoom, polishes: bool = False) -> SlabRoom:
        """The room after each plane moves once more, given the present positions of the others.

        ``polishes`` adds a gradient descent to each move.
        """
        move = self.score.move_and_polish if polishes else self.score.move
        room = self.sweep(room, range(len(room.planes)), move=move)
        if stages.is_up():
            return room
        return self.score.choose_best([room, self.score.polish(room, steps=30, rate=3e-4)])[0]

    def _propose_by_phases(self, planes: Float[Tensor, "w 4"], number: int, tilt: float) -> list:
        """Planes near plane ``number`` and their slabs, by ``propose_by_phases``.

        Planes turn by at most ``tilt`` [rad]. Every third of ``SLABS`` is tried.
        """
        return propose_by_phases(self.data, planes, number, self.data.reach, tilt, SLABS[::3])


def _strongest(candidates: list[Candidate], least: float) -> list[Float[Tensor, "4"]]:
    """Planes of the best four candidates, without ratings up to ``least``; best first."""
    candidates = sorted(candidates, key=lambda candidate: -candidate.rating)[:4]
    return [candidate.plane for candidate in candidates if candidate.rating > least]


def room_axes(planes: Float[Tensor, "w 4"]) -> Float[Tensor, "k 3"]:
    """Normals along which a room may have further planes.

    These are the normals of the planes, the vertical, the horizontal parts of steep planes'
    normals, and the horizontal normals perpendicular to these parts.
    """
    normals = planes[:, :3]
    up = planes.new_tensor([0.0, 0.0, 1.0])
    is_steep = normals[:, 2].abs() < 0.5
    horizontal = functional.normalize(normals[is_steep] * (1 - up), dim=1)
    across = torch.linalg.cross(up.expand_as(horizontal), horizontal)
    return torch.stack(distinct(torch.cat((normals, up[None], horizontal, across)), 2e-4))


def is_square(planes: Float[Tensor, "w 4"]) -> bool:
    """True if planes are level or upright, and pairwise parallel or square, to about a degree."""
    normals = torch.cat((planes[:, :3], planes.new_tensor([[0.0, 0.0, 1.0]])))
    cosines = (normals @ normals.mT).abs()
    return bool(((cosines < 0.02) | (cosines > 0.9998)).all())


def find_maxima(ratings: Float[Tensor, " k"], width: int) -> list[int]:
    """Indices of at most two local maxima above 0, each the largest of ``width`` neighbours."""
    largest_nearby = functional.max_pool1d(ratings[None], width, 1, width // 2)[0]
    peaks = ratings * (largest_nearby == ratings)  # 0 beside the maxima
    highest = peaks.topk(2)
    return highest.indices[highest.values > 0].tolist()
