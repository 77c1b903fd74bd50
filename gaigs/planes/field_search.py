"""Search for planes in channels with few values at each place."""

import logging
import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gaigs.data import Links
from gaigs.planes.axis_planes import room_axes
from gaigs.planes.channel_links import ChannelData, ChannelOptions
from gaigs.planes.field_room import FieldRoom, Variation
from gaigs.planes.field_score import FieldScore
from gaigs.planes.search import PlaneSearch
from gaigs.splatting.gaussians import fibonacci_lattice
from gaigs.splatting.placement.mirrored.movable_planes import upright_turn
from gaigs.splatting.placement.mirrored.reflections import distinct

log = logging.getLogger(__name__)


class PlaneGrid(NamedTuple):
    """A grid of candidate planes: normals, and offsets along each."""

    title: str  # for the log
    normals: Float[Tensor, "n 3"]
    offsets: int  # number of offsets of each normal
    groups: int  # number of groups of neighbouring places
    turn: float  # angle between neighbouring normals [rad]
    shift: float  # distance of neighbouring offsets [m]

    @property
    def size(self) -> int:
        """Number of planes."""
        return len(self.normals) * self.offsets


class FieldSearch:
    """Search for planes whose images explain channels with few values at each place.

    All places share one unknown phase. Planes along the axes of the room are searched first, then
    vertical ones, then tilted ones, since more candidates explain more by chance. If a grid of
    planes is too large for all places at once, a coarser grid is rated by groups of neighbouring
    places, without the phases between groups. Planes around its maxima are then rated by all
    places.

    Args:
        links: Links of task ``csi`` with a known phase, of which the training links are used.
        sign: Sign of the channels' phases.
        order: Largest number of reflections of a path.
        most: Largest number of planes.
        start: Initial planes (w, 4).
        options: Options of the search.
        smallest: Smallest number of places in a group.
        fewest: Smallest number of channel values for a search, ten for each plane of a box. With 22
            values a false plane explained more than its price.

    Source: ours.
    """

    def __init__(
        self,
        links: Links,
        sign: int,
        order: int,
        most: int,
        start: Float[Tensor, "w 4"],
        options: ChannelOptions | None = None,
        smallest: int = 16,
        fewest: int = 60,
    ):
        self.data = ChannelData(links, sign, True, order, options or ChannelOptions())
        self.score = FieldScore(self.data)
        self.frame = self.data.frame
        self.most = most
        self.start = self.frame.from_world(start)
        self.smallest = smallest
        self.fewest = fewest

    @torch.no_grad()
    def run(self) -> FieldRoom:
        """The room in the frame, initial planes first."""
        fit = self.score.fit
        room = fit.start(self.start)
        fit.choose_variation(room)
        if fit.count < self.fewest:
            log.info("%d numbers tell no planes; a search takes %d", fit.count, self.fewest)
            return room
        grids = [grid for grid in (self._make_upright(), self._make_tilted()) if grid is not None]
        largest = max([grid.size for grid in grids], default=0)
        log.info(
            "search of planes by %d numbers together: at most %d times %d planes",
            fit.count,
            self.most,
            largest + self._make_axes(room).size,
        )
        alone = self.score.error(room)
        room = self._grow(room, grids)
        if len(room.planes) == len(self.start):
            # Kriging may have taken the reflections for variations of the direct path. Other
            # paths vary more: the largest variation leaves a further plane its part.
            fit.variations = [Variation(share=0.5, length=2.0, noise=0.1)] * len(fit.bands)
            varied = self._grow(room, grids)
            room = varied if self.score.error(varied) < alone else room
        if not len(room.planes):
            log.info("no plane explains more of %d numbers than chance would", fit.count)
            return room
        return self.score.square(room)

    def _grow(self, room: FieldRoom, grids: list[PlaneGrid]) -> FieldRoom:
        """The room with the planes that lower the error."""
        search = PlaneSearch(self.frame, self.score)
        room = search.grow(room, self.most, lambda room: self._extend(room, grids))
        return self.score.refine(search.prune(room, len(self.start)))

    def _extend(self, room: FieldRoom, grids: list[PlaneGrid]) -> FieldRoom | None:
        """The room with one more plane; None if no plane lowers the error.

        Grids are tried in order, up to the first with such a plane.
        """
        score = self.score
        for grid in [self._make_axes(room), *grids]:
            normals = grid.normals.to(self.frame.points)
            lines = self.frame.grid(normals, grid.offsets, self.data.options.margin)
            shift = grid.shift / self.frame.diagonal
            search = PlaneSearch(self.frame, score, grid.turn / 2, shift / 2)
            trials = []
            for rated in self._rated():
                score.groups = grid.groups
                score.rated = rated
                trials += search.list_extensions(room, lines)
            larger = min(trials, key=score.error, default=None)
            if larger is None:
                continue
            larger = score.refine(larger)
            # The best of n false planes lowers the sum by the logarithm of n; the price has some.
            doubt = max(0.0, math.log(grid.size / 3000)) / score.fit.count
            if score.error(larger) + doubt < score.error(room):
                words = self.frame.describe(larger.planes[-1])
                log.info("%s, %s: error %.3f", words, grid.title, score.error(larger))
                score.fit.choose_variation(larger)
                return larger
        return None

    def _rated(self) -> list[Bool[Tensor, " bands"]]:
        """Masks of the bands that rate planes: all bands, and each alone if there are several.

        Shadows and wavelengths differ between bands, so the noise of other bands may hide a plane
        that one band shows.
        """
        alone = torch.eye(len(self.score.fit.bands), dtype=torch.bool)
        together = torch.ones_like(alone[:1])
        return [*together, *(alone if len(alone) > 1 else alone[:0])]

    # --- grids ---

    def _make_axes(self, room: FieldRoom) -> PlaneGrid:
        """Planes along the axes of the room's planes, of the places' box and of the coordinates."""
        turn = upright_turn(self.frame.points).to(self.frame.points)
        axes = torch.cat((room_axes(room.planes), torch.eye(3).to(turn), turn.mT))
        normals = torch.stack(distinct(axes, 2e-4))
        return self._make_grid("along the axes", 1, lambda turn: normals)

    def _make_upright(self) -> PlaneGrid | None:
        """Vertical planes with evenly spaced normals."""

        def make(turn: float) -> Float[Tensor, "n 3"]:
            angles = torch.arange(0, math.pi, turn)
            return torch.stack((angles.cos(), angles.sin(), 0 * angles), 1)

        return self._choose_grid("upright", make)

    def _make_tilted(self) -> PlaneGrid | None:
        """Planes with normals evenly spread over half of the sphere."""

        def make(turn: float) -> Float[Tensor, "n 3"]:
            count = math.ceil(2 * math.pi / turn**2)
            return fibonacci_lattice(min(count, 1_000_000), 0.0, math.pi / 2)

        return self._choose_grid("of any tilt", make)

    def _choose_grid(
        self, title: str, make: Callable[[float], Float[Tensor, "n 3"]]
    ) -> PlaneGrid | None:
        """The grid with the fewest groups of places whose ratings cost at most ``most_waves``.

        More groups allow a coarser grid. None if groups would have fewer than ``smallest`` places.

        Args:
            title: Name of the grid for the log.
            make: Function from the angle between neighbouring normals [rad] to the normals.
        """
        groups = 1
        places = max(len(receiver.places) for receiver in self.data.receivers)
        while places >= groups * self.smallest:
            grid = self._make_grid(title, groups, make)
            if grid.size * self.score.fit.count <= self.data.options.most_waves:
                return grid
            groups *= 2
        return None

    def _make_grid(
        self, title: str, groups: int, make: Callable[[float], Float[Tensor, "n 3"]]
    ) -> PlaneGrid:
        """A grid whose steps change phases within a group of places by less than half a turn.

        Groups are smaller than the room by the cube root of their number, so more groups allow
        larger steps.
        """
        part = groups ** (-1 / 3)  # diagonal of a group over the room's
        turn = self.data.wavelength / (part * self.frame.diagonal)
        shift = self.data.wavelength / (8 * part)
        extent = (1 + 2 * self.data.options.margin) * self.frame.diagonal
        return PlaneGrid(title, make(turn), math.ceil(extent / shift), groups, turn, shift)
