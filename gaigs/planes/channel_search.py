"""Search for planes in complex channels: delays and elements first, then phases."""

import logging
import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from gaigs.core import stages
from gaigs.data import Links
from gaigs.planes.axis_planes import AxisPlanes, find_maxima, is_square
from gaigs.planes.channel_links import SLABS, ChannelData, ChannelOptions, SlabRoom, half_spaces
from gaigs.planes.channel_score import ChannelScore
from gaigs.planes.common_gains import CommonGains
from gaigs.planes.free_strengths import FreeRoom, FreeScore
from gaigs.planes.phase_proposals import propose_by_phases
from gaigs.planes.search import PlaneSearch
from gaigs.splatting.gaussians import fibonacci_lattice
from gaigs.splatting.placement.mirrored.reflections import distinct

log = logging.getLogger(__name__)


class ChannelSearch:
    """Planes whose images explain the training channels.

    1. ``FreeScore`` finds planes one after the other, without an initial room.
    2. A periodogram over offset and two tilts proposes planes and slabs whose reflections have
       equal phases at all places. The residual, which includes delays, decides between them, so
       planes half a wavelength apart differ.
    3. Planes that do not improve the prediction between neighbouring places are dropped
       (``ChannelScore``). The search is repeated for the power that they explained.
    4. If planes are tilted, or walls known, a second room along the axes is searched. For channels
       with few values ``CommonGains`` finds its planes.
    5. ``AxisPlanes`` adds planes along the room's axes, such as planes hidden behind the direct
       path.

    Args:
        links: Links of task ``csi``, of which the training links are used.
        sign: Sign of the channels' phases.
        has_common_phase: True if all channels share one unknown phase.
        order: Largest number of reflections of a path.
        most: Largest number of planes.
        start: Initial planes (w, 4).
        options: Options of the search.

    Source: ours.
    """

    def __init__(
        self,
        links: Links,
        sign: int,
        has_common_phase: bool,
        order: int,
        most: int,
        start: Float[Tensor, "w 4"],
        options: ChannelOptions | None = None,
    ):
        options = options or ChannelOptions()
        self.data = ChannelData(links, sign, has_common_phase, order, options)
        self.frame = self.data.frame
        self.most = most
        self.start = self.frame.from_world(start)
        self.free = FreeScore(self.data)
        # Free strengths explain channels with few values by any planes.
        self.has_few_numbers = self.free.numbers < options.fewest_free
        self.score = ChannelScore(self.data, not self.has_few_numbers)
        self.along_axes = AxisPlanes(self.data, self.score)

    @torch.no_grad()
    def run(self) -> SlabRoom:
        """Planes in the world frame, initial ones first, and their slabs as in ``SLABS``."""
        room = self.find_room()
        return SlabRoom(self.frame.to_world(room.planes), room.slabs)

    def find_room(self) -> SlabRoom:
        """The room of ``run``, in the frame of the search instead of the world.

        The steps are those of the class. If the time is up, the best room so far is returned.
        """
        with stages.portion(0.6):  # the rest of the time is kept to resolve the planes' offsets
            planes = self.find_free(self.start)
        best = half_spaces(planes)
        if len(planes):
            best = self.prune(self.resolve(self.free.descend(planes, steps=300, rate=5e-3)))
        if stages.is_up():
            return best
        # A search with free strengths may find tilted planes in place of upright ones, no plane at
        # all, or known walls at wrong places. Then walls along the coordinate axes are searched.
        is_doubtful = len(self.start) or not is_square(best.planes)
        if not len(best.planes) or (self.has_few_numbers and is_doubtful):
            walls = self.find_axis_walls()
            if len(walls.planes) and self.score.error(walls) < self.score.error(best):
                settled = self.along_axes.settle(walls, polishes=True)
                moved = self.prune(self.along_axes.grow_along(settled, self.most))
                return min(walls, moved, key=self.score.error)
        if not len(best.planes):
            return best
        if not is_square(best.planes):
            if len(self.start):
                first = half_spaces(self.start)
            else:
                first = self.along_axes.find_upright(best)
            upright = self.prune(self.along_axes.grow_along(first, self.most, best.planes))
            if self.score.error(upright) < self.score.error(best):
                return upright
        if len(best.planes) < len(planes):  # ``prune`` has dropped false planes
            best = self.search_anew(best)
        return self.prune(self.along_axes.grow_along(best, self.most))

    def search_anew(self, room: SlabRoom) -> SlabRoom:
        """The best of a pruned room and two variants.

        In the first, further planes are searched for the power that the dropped planes explained.
        In the second, the better room so far is resolved again, since false planes had moved the
        true ones.
        """
        planes = self.find_free(self.free.descend(room.planes, steps=100, rate=1e-2))
        again = self.prune(self.resolve(self.free.descend(planes, steps=300, rate=5e-3)))
        room = min(room, again, key=self.score.error)
        return min(room, self.resolve(room.planes), key=self.score.error)

    def prune(self, room: SlabRoom) -> SlabRoom:
        """The room without planes whose removal lowers the error; known planes stay."""
        return self.along_axes.prune(room, len(self.start))

    def find_axis_walls(self) -> SlabRoom:
        """Walls along the coordinate axes, by ``CommonGains``."""
        return CommonGains(self.data, self.start, self.most).find_axis_walls()

    def find_free(self, known: Float[Tensor, "v 4"]) -> Float[Tensor, "w 4"]:
        """Known planes and further ones by ``FreeScore``; each addition refines all planes."""
        normals = torch.cat((fibonacci_lattice(400, 0.0, math.pi / 2), torch.eye(3)))
        grid = self.frame.grid(normals.to(self.frame.points), 80, self.data.options.margin)
        search = PlaneSearch(self.frame, self.free)

        def extend(room: FreeRoom) -> FreeRoom | None:
            trials = search.list_extensions(room, grid)
            if not trials:
                return None
            best = self.free.refine(min(trials, key=self.free.error))
            plane = self.frame.describe(best.planes[-1])
            log.info("%s: %.1f %% of the power", plane, 100 * best.share)
            return best

        def replace(room: FreeRoom, number: int) -> FreeRoom:
            """The room with plane ``number`` replaced by the best one, which becomes the last."""
            others = self.free.remove(room, number)
            plane = room.planes[number, None]
            unchanged = self.free.evaluate(torch.cat((others.planes, plane)))
            return min([*search.list_extensions(others, grid), unchanged], key=self.free.error)

        room = search.grow(self.free.evaluate(known), self.most, extend)
        # Each new plane is searched again, given all others. It becomes the last plane, so the next
        # plane to search is always the first one after the known planes.
        numbers = [len(known)] * (len(room.planes) - len(known))
        return search.sweep(room, numbers, "search of planes", replace).planes

    def resolve(self, planes: Float[Tensor, "w 4"]) -> SlabRoom:
        """A room in which each plane has a slab, and an offset exact to a part of a wavelength.

        Planes are moved one after the other, in three rounds. Until its first move a plane has
        complex strengths, see ``ChannelScore.measure``.
        """
        room = half_spaces(planes)
        resolved = torch.zeros(len(planes), dtype=torch.bool)
        sample = self.data.sample(planes)

        def measured(room: SlabRoom) -> tuple[float, SlabRoom]:
            """The residual of a room, and the room."""
            return self.score.measure(sample, room, resolved).item(), room

        # Reaches [m] and tilts [rad] of the three rounds. The first also turns planes square, and
        # tries every third slab, as the slab hardly matters before the offset is known.
        for reach, tilt, slabs in (
            (0.07, 0.04, SLABS[::3]),
            (0.05, 0.006, SLABS),
            (0.05, 0.006, SLABS),
        ):
            for number in stages.track(range(len(planes)), "places of planes"):
                if stages.is_up():
                    return room
                resolved[number] = True
                variants = [room.planes]
                if tilt > 0.01:
                    variants += self.square_variants(room.planes, number)
                trials = []
                for variant in variants:
                    proposed = propose_by_phases(self.data, variant, number, reach, tilt, slabs)
                    for plane, material in proposed:
                        trials.append(measured(room.replace_plane(number, plane, material)))
                trials.sort(key=lambda trial: trial[0])
                if resolved.all():  # a descent on phases needs the phases of all planes
                    for _, trial in trials[:3]:
                        polished = self.score.polish(trial, steps=12, rate=5e-4, only=number)
                        trials.append(measured(polished))
                _, room = min(trials, key=lambda trial: trial[0])
        return self.score.refine(room)

    def square_variants(
        self, planes: Float[Tensor, "w 4"], number: int
    ) -> list[Float[Tensor, "w 4"]]:
        """Copies of the planes in which plane ``number`` is parallel or perpendicular to others.

        Each possible normal gives two copies, at the best two offsets nearby, since a tilted plane
        may be a compromise between two parallel planes.
        """
        is_other = torch.arange(len(planes)) != number
        axes = _square_axes(planes, number, is_other)
        if not axes:
            return []
        profiles = []
        for receiver in self.free.links:
            residual = self.data.fit_free(receiver, planes[is_other]).residual
            profiles.append(self.free.compute_profile(receiver, residual))
        variants = []
        for normal in axes:
            steps = 0.1 * self.frame.diagonal * torch.linspace(-1, 1, 81).double()
            offsets = planes[number, 3] + steps
            line = torch.cat((normal.expand(81, 3), offsets[:, None]), 1)  # (81, 4)
            ratings = self.free.rate_lines(self.free.links, profiles, line[None])[0]
            for step in find_maxima(ratings, 5):
                variant = planes.clone()
                variant[number] = line[step]
                variants.append(variant)
        return variants


def _square_axes(
    planes: Float[Tensor, "w 4"], number: int, is_other: Bool[Tensor, " w"]
) -> list[Float[Tensor, "3"]]:
    """At most three normals near plane ``number``'s, parallel or perpendicular to other planes.

    They differ from the normal of the plane by 2 to 26 degrees.
    """
    normals = planes[is_other, :3]
    pairs = torch.combinations(torch.arange(len(normals)))
    crossed = torch.linalg.cross(normals[pairs[:, 0]], normals[pairs[:, 1]])  # square to both
    is_clear = crossed.norm(dim=1) > 0.5  # nearly parallel planes have no exact cross product
    crossed = functional.normalize(crossed[is_clear], dim=1)
    axes = torch.cat((crossed, normals))
    cosines = axes @ planes[number, :3]
    is_near = (cosines.abs() > 0.9) & (cosines.abs() < 0.9995)
    axes = (axes * cosines.sign()[:, None])[is_near]
    return distinct(axes, 2e-4)[:3]
