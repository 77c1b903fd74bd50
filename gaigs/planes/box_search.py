"""Search for boxes that explain shadows: tomography with few, sharp obstacles."""

import contextlib
import math
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from gaigs.core import stages
from gaigs.core.geometry import FAINTEST
from gaigs.splatting.placement.mirrored.obstacles import passes_box
from gaigs.splatting.placement.mirrored.reflections import Folded


class ChannelErrors(NamedTuple):
    """Errors of measured channels h if obstacles attenuate each path by a depth [Np].

    The error of a link is the logarithm of |h - F a|² / |h|². The columns of F are the paths'
    fields without obstacles, and a = exp(-depths):

        |h - F a|² = |h|² - 2 a' Re(F^H h) + a' Re(F^H F) a
    """

    products: Float[Tensor, "b n n"]  # Re(F^H F) / |h|²
    matches: Float[Tensor, "b n"]  # Re(F^H h) / |h|²
    floor: float = 1e-3  # relative error, -30 dB, below which a change hardly counts

    @classmethod
    def of(
        cls, fields: Complex[Tensor, "b n e s"], channels: Complex[Tensor, "b e s"]
    ) -> "ChannelErrors":
        """The function for measured channels, from the field of each path without obstacles."""
        fields = fields.flatten(2)  # (b, n, numbers)
        channels = channels.flatten(1)[..., None]  # (b, numbers, 1)
        power = channels.abs().square().sum((1, 2))[:, None].clamp_min(FAINTEST)  # (b, 1)
        products = (fields.conj() @ fields.mT).real / power[..., None]
        matches = (fields.conj() @ channels)[..., 0].real / power
        return cls(products, matches)

    def __call__(self, depths: Float[Tensor, "b n"]) -> Float[Tensor, " b"]:
        """Error of each link if its paths are attenuated by ``depths`` [Np]."""
        a = (-depths).exp()
        # |h - F a|² / |h|² = 1 + a' (products a - 2 matches)
        terms = (self.products @ a[..., None])[..., 0] - 2 * self.matches
        errors = (1 + (a * terms).sum(1)).clamp_min(0)
        # A logarithm that hardly changes below ``floor`` and above 1 / ``floor``.
        return (errors / self.floor).log1p() - (errors * self.floor).log1p()


class LevelErrors(NamedTuple):
    """Errors of measured levels if obstacles attenuate each path by a depth [Np].

    The error of a link is the logarithm of 1 + its squared error over ``scale``². The mean error of
    each receiver is subtracted first, since its gain is not yet right while obstacles are wrong.
    """

    powers: Float[Tensor, "b n"]  # of each path without obstacles
    levels: Float[Tensor, " b"]  # [dB]
    receivers: Int[Tensor, " b"]
    scale: float = 6.0  # [dB]; a change of a larger error counts less

    def __call__(self, depths: Float[Tensor, "b n"]) -> Float[Tensor, " b"]:
        """Error of each link if its paths are attenuated by ``depths`` [Np]."""
        power = (self.powers * (-2 * depths).exp()).sum(1).clamp_min(FAINTEST)  # (b,)
        errors = 10 * power.log10() - self.levels
        counts = self.receivers.bincount()
        sums = errors.new_zeros(len(counts)).index_add(0, self.receivers, errors)
        means = sums / counts.clamp_min(1)  # of each receiver
        errors = errors - means[self.receivers]
        return (errors / self.scale).square().log1p()


class Cuboid(NamedTuple):
    """A cuboid that attenuates each path through it, equally for any length inside."""

    corners: Float[Tensor, "2 3"]  # least and largest coordinates [m]
    loss: float  # [Np]


class Segments(NamedTuple):
    """Straight segments of paths that cross a cuboid."""

    low: Float[Tensor, "3"]  # least coordinates of the cuboid [m]
    high: Float[Tensor, "3"]
    start: Float[Tensor, "s 3"]
    end: Float[Tensor, "s 3"]
    path: Int[Tensor, " s"]  # number among the paths of all links


class BoxSearch:
    """Search for boxes whose attenuation of all receivers' paths lowers the errors of links.

    A box starts as one of the grid's cells whose loss lowers the errors most. Its faces then move
    to the least mean error. No transmitter or receiver may lie in a box, since these stand in the
    open. The box that lowers the error most is added if the fall is significant. Then all boxes are
    adjusted in turn, and a gap is cut through a box that covers two obstacles.

    Attributes:
        most: Number of boxes at which the search ends; cuts may double it.
        seeds: Number of cells from which a new box is tried.
        steps: Moves of a face [cells]; the last is also the shortest edge.
        losses: Least and largest loss of a box [Np]. A loss below 3 dB may also be a wrong material
            or gain.
        clear: Least fall of the mean error [standard errors].
        price: Least fall of the mean error by a box or a cut.

    Args:
        folded: Paths of the links.
        errors: Function from the depths of paths [Np] to the error of each link.
        places: Transmitters and receivers, in the paths' frame [m].

    Source: ours; for the idea Wilson and Patwari, Radio Tomographic Imaging, 2010.
    """

    most = 10
    seeds = 6
    steps = (1.0, 0.5, 0.25)
    losses = (0.35, 6.0)
    clear = 3.0
    price = 0.004

    def __init__(
        self,
        folded: Folded,
        errors: ChannelErrors | LevelErrors,
        places: Float[Tensor, "k 3"],
    ):
        self.errors = errors
        self.places = places
        count, n = folded.exists.shape
        self.free = places.new_zeros(count, n)  # depths without boxes
        # Segments of existing paths, over all links; a path is numbered link * n + path.
        first_paths = n * torch.arange(count, device=folded.path.device)[:, None]  # (b, 1)
        path = folded.path + first_paths  # (b, s)
        exists = folded.exists[:, folded.path].flatten().nonzero()[:, 0]
        self.path = path.flatten()[exists]
        self.start = folded.start.flatten(0, 1)[exists]
        self.end = folded.end.flatten(0, 1)[exists]
        lower, upper = places.amin(0), places.amax(0)
        self.cell = float((upper - lower).norm()) / 45  # 0.2 m in a room of 7 by 5 m
        self.lower = lower - 2 * self.cell
        self.upper = upper + 2 * self.cell
        nowhere = self.lower + math.inf  # the first box is outside, which updates the segments
        self.near = Segments(nowhere, nowhere, self.start, self.end, self.path)
        self.common = 0.0  # depth of all paths, while gains are not yet right [Np]
        self.boxes: list[Cuboid] = []

    @torch.no_grad()
    def run(self) -> list[Cuboid]:
        """The boxes found until the time is up; empty if no box helps significantly."""
        with contextlib.suppress(TimeoutError):
            for _ in range(self.most):
                if len(self.boxes) >= self.most or not self._add():
                    break
            self._adjust_all((*self.steps, 0.1), 5)
        return self.boxes

    def _add(self) -> bool:
        """Adds the box that lowers the mean error most; False if no fall is significant."""
        depths = self._depths(self.boxes)
        before = self.errors(depths)
        best = None
        least = before.mean() - self.price
        for seed in self._seeds(depths):
            box = self._adjust(depths, seed, self.steps[:2], 30)
            fall = before - self.errors(depths + self._depth(box))  # (b,)
            standard_error = fall.std() / len(fall) ** 0.5
            is_clear = fall.mean() > self.clear * standard_error
            error = before.mean() - fall.mean()
            if is_clear and error < least:
                best, least = box, error
        if best is None:
            return False
        self.boxes.append(best)
        self._adjust_all(self.steps[1:], 1)
        for box in [*self.boxes]:
            self._cut(box)
        return True

    @torch.no_grad()
    def gain(self, boxes: list[Cuboid]) -> float:
        """Fall of the mean error by ``boxes``, of any search; 0 if the time is up."""
        with contextlib.suppress(TimeoutError):
            return self._error(self.free, []) - self._error(self.free, boxes)
        return 0.0

    def _depth(self, box: Cuboid) -> Float[Tensor, "b n"]:
        """Attenuation of all paths by one box [Np]."""
        hit = self._hit(box)
        losses = self.free.new_full((len(hit),), box.loss)
        return self.free.flatten().index_add(0, hit, losses).view_as(self.free)

    def _hit(self, box: Cuboid) -> Int[Tensor, " h"]:
        """Number of the path of each segment that crosses a box.

        Raises:
            TimeoutError: The time is up.
        """
        if stages.is_up():
            raise TimeoutError
        # Only segments near the last boxes are tested; a box beyond their region replaces them.
        if (self.near.low > box.corners[0]).any() or (self.near.high < box.corners[1]).any():
            self.near = self._segments_near(box)
        return self.near.path[passes_box(self.near.start, self.near.end, box.corners)]

    def _segments_near(self, box: Cuboid) -> Segments:
        """Segments that cross a box enlarged by a margin, within which its faces will be moved."""
        margin = 3 * self.cell
        low, high = box.corners[0] - margin, box.corners[1] + margin
        rows = passes_box(self.start, self.end, torch.stack((low, high))).nonzero()[:, 0]
        return Segments(low, high, self.start[rows], self.end[rows], self.path[rows])

    def _depths(self, boxes: list[Cuboid]) -> Float[Tensor, "b n"]:
        """Attenuation of all paths by boxes [Np], plus the depth that all paths share."""
        depths = self.free + self.common
        return sum((self._depth(box) for box in boxes), start=depths)

    def _error(self, depths: Float[Tensor, "b n"], boxes: list[Cuboid]) -> float:
        """Mean error of all links if ``boxes`` add to ``depths`` [Np]."""
        # Both have the common depth, which must count once.
        return self.errors(depths + self._depths(boxes) - self.common).mean().item()

    @cached_property
    def cells(self) -> list[tuple[Cuboid, Int[Tensor, " h"]]]:
        """Cells in which no place lies, a cell apart, and numbers of the paths through each."""
        axes = []
        for low, high in zip(self.lower, self.upper, strict=True):
            axes.append(torch.arange(low, high, 2 * self.cell))
        cells = []
        for corner in torch.cartesian_prod(*axes).to(self.free):
            box = Cuboid(torch.stack((corner, corner + self.cell)), 1.5)
            if self._is_free(box):
                cells.append((box, self._hit(box)))
        return cells

    def _seeds(self, depths: Float[Tensor, "b n"]) -> list[Cuboid]:
        """The cells with the largest mean fall of the errors over its standard deviation."""
        before = self.errors(depths)
        rated = []
        for box, hit in self.cells:
            losses = depths.new_full((len(hit),), box.loss)
            with_box = depths.flatten().index_add(0, hit, losses).view_as(depths)
            fall = before - self.errors(with_box)
            rated.append((fall.mean() / (fall.std() + FAINTEST), box))
        rated.sort(key=lambda pair: -pair[0])
        return [box for _, box in rated[: self.seeds]]

    def _is_free(self, box: Cuboid) -> bool:
        """True for a box in the room, above the smallest size, with no transmitter or receiver."""
        low, high = box.corners
        inside = ((self.places > low) & (self.places < high)).all(1)
        is_large = (high - low >= self.steps[-1] * self.cell).all()
        within = (low >= self.lower).all() & (high <= self.upper).all()
        return bool(is_large & within & ~inside.any())

    def _adjust(
        self, depths: Float[Tensor, "b n"], box: Cuboid, steps: tuple[float, ...], rounds: int
    ) -> Cuboid:
        """The box after changes of each face, its position and its loss, while the error falls.

        Args:
            depths: Attenuation of all paths without the box [Np].
            box: Initial box.
            steps: Moves of a face [cells].
            rounds: Largest number of rounds of changes.
        """
        least = self._error(depths, [box])
        for _ in range(rounds):
            before = least
            for degree in range(10):  # of freedom
                for variant in self._list_changes(box, degree, steps):
                    error = self._error(depths, [variant])
                    if error < least - 1e-5:
                        box, least = variant, error
            if before - least < 1e-4:
                break
        return box

    def _list_changes(self, box: Cuboid, degree: int, steps: tuple[float, ...]) -> list[Cuboid]:
        """Variants of a box in one degree of freedom; no place lies in them.

        Degrees 0 to 2 move a lower face, 3 to 5 an upper face, 6 to 8 the box along an axis.
        Degree 9 is the loss.
        """
        if degree == 9:
            losses = box.loss * torch.tensor([0.5, 0.7, 0.85, 1.2, 1.4, 2.0])
            return [Cuboid(box.corners, loss) for loss in losses.clamp(*self.losses).tolist()]
        axis = degree % 3
        sides = [degree // 3] if degree < 6 else [0, 1]  # rows of ``corners``
        variants = []
        negative = [-step for step in steps]
        for step in (*steps, *negative):
            corners = box.corners.clone()
            corners[sides, axis] += step * self.cell
            variants.append(Cuboid(corners, box.loss))
        return [variant for variant in variants if self._is_free(variant)]

    def _adjust_all(self, steps: tuple[float, ...], rounds: int) -> None:
        """Adjusts each box while the others stay, then the depth that all paths share."""
        for number, box in enumerate(self.boxes):
            others = self._depths(self.boxes[:number] + self.boxes[number + 1 :])
            self.boxes[number] = self._adjust(others, box, steps, rounds)
        depths = self._depths(self.boxes)
        changes = torch.linspace(-0.1, 0.1, 9).tolist()  # within 1 dB
        self.common += min(changes, key=lambda change: self._error(depths + change, []))

    def _cut(self, box: Cuboid) -> None:
        """Replaces a box by nothing, itself or two parts of it, in favour of the lowest error.

        Each trial, the box first, must be better than the best so far by ``price``.
        """
        others = [other for other in self.boxes if other is not box]
        depths = self._depths(others)
        best: list[Cuboid] = []
        least = self._error(depths, [])
        for trial in [[box], *self._halves(box)]:
            error = self._error(depths, trial)
            if error < least - self.price:
                best, least = trial, error
        self.boxes = others + best

    def _halves(self, box: Cuboid) -> list[list[Cuboid]]:
        """Pairs of boxes that remain when a slice across an axis is cut out of a box."""
        pairs = []
        for axis in range(3):
            low, high = box.corners[:, axis].tolist()
            count = min(20, int((high - low) / self.cell * 2) + 1)  # half a cell apart
            cuts = torch.linspace(low, high, count)
            for begin, end in torch.combinations(cuts[1:-1]).tolist():
                below = Cuboid(box.corners.clone(), box.loss)
                above = Cuboid(box.corners.clone(), box.loss)
                below.corners[1, axis] = begin
                above.corners[0, axis] = end
                if self._is_free(below) and self._is_free(above):
                    pairs.append([below, above])
        return pairs
