"""Search for planes in complex channels: a Hough transform, variable projection, and slabs that
explain the phases.
"""

import logging
import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Complex, Float, Int
from scipy.constants import speed_of_light
from torch import Tensor
from torch.nn import functional

from gaigs.core.propagation import NEAREST, slab
from gaigs.core.query import evenly
from gaigs.core.stages import is_up, track
from gaigs.core.task.csi import Csi
from gaigs.data import Links
from gaigs.planes.plane_search import PlaneSearch
from gaigs.splatting.gaussians import fibonacci_lattice
from gaigs.splatting.placement.mirrored.reflections import (
    all_sequences,
    distinct,
    fold,
    images,
    polarised,
    reflect,
    seen_from,
    tangents,
)

log = logging.getLogger(__name__)

RIDGE = 1e-3
"""Ridge of free path strengths over their mean power: images closer than the resolution share their
power.
"""

FLOOR = 1e-3
"""Share of a channel's power below which a residual hardly counts: 30 dB."""

LEAST, FAINTEST = 0.006, 0.003
"""Least share of the power that a plane takes; the second one if the rest falls by ``DROP``.
Validation drops planes later; a few too many cost time alone."""

DROP = 0.5
"""Fall of the mean log of the power that is left, by a true plane behind others: false ones reach
0.3.
"""

PRICE = 0.02
"""Least fall of the mean log of what neighbours do not predict by a true plane: walls have 0.05 and
more, false planes up to 0.02, furniture 0.01 to 0.06."""

NEIGHBOURS, TESTED = 8, 250
"""Places whose strengths predict a place, and most places that are predicted."""

SMALL = 0.05
"""Least share of what is left that a candidate along the room's axes explains."""

BEYOND = 0.3
"""Largest distance of a plane from all transmitters and receivers [diagonals of the room]."""

CELLS = 64, 40
"""Most steps of the periodogram over offset and over each tilt, on either side. Steps follow the
wavelength, of a tilt over the room's diagonal; cells its cube. At 60 GHz they reach 2 cm, and 0.004
rad in a room of 10 m; in a hall of 100 m 0.007 rad at 3.5 GHz."""

ENTRIES = 100_000_000
"""Most waves of ``aligned``, some seconds' work for each plane: offsets times places times numbers.
"""

DRAWN = 0.2
"""Largest error of a wall in a floor plan [m]."""

CHANCE = 6.0
"""Share of what is left that the best of thousands of planes explains by chance, times the number
of places.
"""

FEW = 37
"""Numbers of a channel, elements times delays that its band tells apart in the room, below which
free strengths explain it by any planes: a room of six has as many paths of up to two
reflections."""

FEWEST = 8
"""Fewest numbers of a channel in which planes can be searched: one path explains any single number.
"""

SLABS = (
    torch.tensor(
        [(1.5, 0.3, 1.0), (4.0, 0.3, 1.0), *((2.0, 0.05, 0.005 * k) for k in range(1, 13))]
    )
    .double()
    .log()
)
"""Slabs that are tried: logarithms of the relative permittivity's real part over 1 and imaginary
part, and of the thickness [m]; a metre is a half-space."""


@dataclass(frozen=True)
class ReceiverChannels:
    """The training channels of one receiver, thinned to some elements and subcarriers.

    Attributes:
        places: Transmitters (b, 3) [m].
        channels: With phases as of exp(-j 2 pi f t) (b, e, s).
        position: Middle of the array (3,) [m].
        elements: World frame (e, 3) [m].
        frequencies: (s,) [Hz].
    """

    places: Float[Tensor, "b 3"]
    channels: Complex[Tensor, "b e s"]
    position: Float[Tensor, "3"]
    elements: Float[Tensor, "e 3"]
    frequencies: Float[Tensor, " s"]

    @classmethod
    def of(
        cls, links: Links, number: int, sign: int, elements: int = 16, subcarriers: int = 32
    ) -> "ReceiverChannels":
        receiver, query = links.receivers[number], links.query
        own = links.split.train[query.receivers[links.split.train] == number]
        task: Csi = links.task
        which = evenly(torch.arange(len(receiver.array)), elements)
        when = evenly(torch.arange(len(task.frequencies)), subcarriers)
        channels = links.labels[own][:, which][:, :, when].to(torch.complex128)
        heard = channels.abs().amax((1, 2)) > 0
        pose = receiver.pose.to(torch.zeros((), dtype=torch.float64))
        return cls(
            query.transmitters[own][heard].double(),
            (channels.conj() if sign > 0 else channels)[heard],
            pose.position,
            pose.world(receiver.array.elements[which].double()),
            task.frequencies[when],
        )

    def about(self, middle: Float[Tensor, "3"]) -> "ReceiverChannels":
        """The same seen from a point."""
        points = {name: getattr(self, name) - middle for name in ("places", "position", "elements")}
        return replace(self, **points)

    def some(self, index: object, when: object = slice(None)) -> "ReceiverChannels":
        """The channels of some places at some subcarriers."""
        channels = self.channels[index][:, :, when]
        return replace(
            self, places=self.places[index], channels=channels, frequencies=self.frequencies[when]
        )

    def single(self) -> "ReceiverChannels":
        """In single precision, for descents."""
        parts = {
            name: part.float()
            for name, part in vars(self).items()
            if isinstance(part, Tensor) and part.is_floating_point()
        }
        return replace(self, **parts, channels=self.channels.to(torch.complex64))

    @cached_property
    def flat(self) -> Complex[Tensor, "b k"]:
        return self.channels.flatten(1)

    def images(
        self, planes: Float[Tensor, "w 4"], sequences: Int[Tensor, "n order"]
    ) -> Float[Tensor, "b n 3"]:
        return images(self.places, sequences, planes[:, :3], planes[:, 3])[-1]

    def waves(self, points: Float[Tensor, "b n 3"]) -> Complex[Tensor, "b n k"]:
        """Unit sources at points as the elements receive them."""
        lengths = (points[..., None, :] - self.elements).norm(dim=-1).clamp_min(NEAREST)[..., None]
        turns = lengths * (self.frequencies / speed_of_light)
        turns = turns - turns.detach().round()
        return torch.polar((1 / lengths).expand_as(turns), -2 * math.pi * turns).flatten(-2)

    def reflected(
        self,
        planes: Float[Tensor, "w 4"],
        slabs: Float[Tensor, "w 3"],
        sequences: Int[Tensor, "n order"],
        at: Float[Tensor, " s"] | None = None,
    ) -> Complex[Tensor, "b n k"]:
        """Waves of all paths after their reflections at slabs; 0 for a path that does not meet its
        planes.

        Slabs reflect as ``at`` some frequencies; None: at each one's own. Half-spaces reflect all
        alike.
        """
        at = self.frequencies if at is None else at
        planes, slabs = planes.to(self.places), slabs.to(self.places)
        normals, offsets = planes[:, :3], planes[:, 3]
        seen = images(self.places, sequences, normals, offsets)
        folded = fold(seen, self.position.expand(len(self.places), 3), sequences, normals, offsets)
        permittivities, thickness = _materials(slabs)
        depths = thickness[:, None] * at / speed_of_light
        gains = folded.exists[..., None].to(self.channels.dtype).expand(-1, -1, len(at))
        materials = (
            permittivities[folded.planes, None],
            folded.cosines[..., None].clamp(1e-3, 1),
            depths[folded.planes],
        )
        gains = folded.reflected(gains, polarised(folded.normals[:, None], *slab(*materials)))
        waves = self.waves(seen[-1]).unflatten(-1, (len(self.elements), -1))
        return (waves * gains[:, :, None]).flatten(-2)


Room = tuple[Float[Tensor, "_ 4"], Float[Tensor, "_ 3"]]
"""Planes, and their slabs as in ``SLABS``."""


def half_spaces(planes: Float[Tensor, "w 4"]) -> Room:
    """A room with walls without a far side."""
    return planes, SLABS[1].repeat(len(planes), 1)


class ChannelSearch(PlaneSearch):
    """Planes whose images explain the training channels.

    A candidate is a plane (normal, offset). Its score is the share of the residual's power that its
    image explains, summed over places and receivers: a Hough transform over all normals and
    offsets, without a guess of the room. The best candidate is refined by variable projection,
    together with the planes before it: strengths of paths are free at each place, so neither phases
    nor blockage are assumed. Then phases count: a periodogram over offset and two tilts proposes
    planes and slabs whose reflections have like phases at all places, and the residual decides,
    with strengths that are real and not negative. It sees delays too, so it tells planes half a
    wavelength apart. Planes with which neighbouring places do not predict each other better are
    dropped, and what they explained is searched anew. Where planes are tilted, or walls known, a
    second room has walls along the axes of coordinates, see ``aligned``. At last the room grows
    along its axes, which shows planes that hide behind the direct path.

    Args:
        links: Their training links count; of the task ``csi``.
        sign: Sign of the channels' phases.
        common: True if channels have a phase in common.
        order: Largest number of reflections of a path; more than 2 count as 2, as longer paths
            hardly locate a plane.
        most: Largest number of planes.
        start: Planes known before (w, 4).

    Source: ours; Hough, Method and means for recognizing complex patterns, 1962; Golub and Pereyra,
    The differentiation of pseudo-inverses and nonlinear least squares problems whose variables
    separate, 1973.
    """

    def __init__(
        self,
        links: Links,
        sign: int,
        common: bool,
        order: int,
        most: int,
        start: Float[Tensor, "w 4"],
    ):
        self.common, self.order, self.most = common, min(order, 2), most
        numbers = links.query.receivers[links.split.train].unique().tolist()
        heard = [
            receiver
            for number in numbers
            if len((receiver := ReceiverChannels.of(links, number, sign)).places)
        ]
        super().__init__(
            torch.cat([part for one in heard for part in (one.places, one.position[None])])
        )
        self.receivers = [receiver.about(self.middle) for receiver in heard]
        self.start = seen_from(start.double(), self.middle)
        self.wavelength = speed_of_light / float(self.receivers[0].frequencies.mean())
        # [m] Peaks of delay profiles are off by a part of the resolution, where paths are close.
        band = max(
            float(receiver.frequencies.max() - receiver.frequencies.min())
            for receiver in self.receivers
        )
        self.reach = max(0.07, speed_of_light / 8 / max(band, 1.0))
        # Profiles of a gigabyte at most, also in a hall with a large band.
        size = max(
            receiver.channels.shape[1] * self.delays(receiver) for receiver in self.receivers
        )
        # Delays are an eighth of the resolution apart, over four diagonals.
        self.numbers = min(size / 32, max(receiver.flat.shape[1] for receiver in self.receivers))
        self.many = self.drawn(min(200, 60_000_000 // size))

    @torch.no_grad()
    def run(self) -> Room:
        """Planes, first those of the start, and their slabs as in ``SLABS``."""
        planes, slabs = self.found()
        return seen_from(planes, -self.middle), slabs

    def found(self) -> Room:
        """``run`` about the middle of the room."""
        planes = self.find(self.start)
        best = planes, planes[:, :3]
        if len(planes):
            best = self.without_false(*self.resolve(self.refine(planes, 300, 5e-3)))
        if is_up():
            return best
        # Free strengths may find tilted planes in place of upright ones, or none, and move known
        # walls away.
        if not len(best[0]) or (self.numbers < FEW and (len(self.start) or not is_square(best[0]))):
            walls = self.aligned()
            if len(walls[0]) and self.cost(walls) < self.cost(best):
                moved = self.without_false(*self.grown(*self.settled(*walls, polishes=True)))
                return min(walls, moved, key=self.cost)
        if not len(best[0]):
            return best
        if not is_square(best[0]):
            first = half_spaces(self.start) if len(self.start) else self.seed(best)
            upright = self.without_false(*self.grown(*first, best[0]))
            if self.cost(upright) < self.cost(best):
                return upright
        if len(best[0]) < len(planes):  # what the false ones explained is searched anew
            again = self.resolve(self.refine(self.find(self.refine(best[0], 100, 1e-2)), 300, 5e-3))
            best = min(best, self.without_false(*again), key=self.cost)
            best = min(
                best, self.resolve(best[0]), key=self.cost
            )  # false planes had moved the others
        return self.without_false(*self.grown(*best))

    def cost(self, room: Room) -> float:
        """Mean log of the share of power that strengths of the nearest places leave, and a price of
        the planes.

        Strengths vary little from place to place. A false plane that explains one place by chance
        fails at the next.

        Source: Stone, Cross-validatory choice and assessment of statistical predictions, 1974.
        """
        planes, slabs = room
        sequences, shares = self.sequences(planes), []
        phases = self.phases(planes, [part for part, *_ in self.neighbours])
        for phase, (part, targets, near, counts) in zip(phases, self.neighbours, strict=True):
            part = part.some(slice(None), thinned(part)).single()
            channels = part.flat * phase[:, None].conj().to(part.flat)
            power = part.flat.abs().square().sum(1)[:, None, None]
            waves = part.reflected(planes, slabs, sequences)
            weights = torch.where(power > 0, 1 / power, 0)  # silent at these subcarriers
            gram = weights * (waves.conj() @ waves.mT).real
            right = weights * (waves.conj() @ channels[..., None]).real
            gram, right = ((counts[..., None, None] * some[near]).sum(1) for some in (gram, right))
            strengths = real_strengths(_ridged(gram, RIDGE), right)
            found, channels = (strengths.mT.to(waves) @ waves[targets])[:, 0], channels[targets]
            found = found * (power[targets, 0] > 0)  # a silent target says nothing
            if not self.common:
                channels = in_phase(channels, found)
            shares.append(log_share(channels - found, channels))
        return torch.cat(shares).mean().item() + PRICE * len(planes)

    @cached_property
    def neighbours(
        self,
    ) -> list[tuple[ReceiverChannels, Int[Tensor, " t"], Int[Tensor, "t k"], Bool[Tensor, "t k"]]]:
        """Of each receiver: channels, which of these are predicted, the nearest to each, and which
        of them count.

        Those at least a wavelength away do: closer ones share the interference of all paths.
        """
        found = []
        for receiver in map(one_of_each_place, self.receivers):
            targets = evenly(
                torch.arange(len(receiver.places)), max(8, TESTED // len(self.receivers))
            )
            apart = torch.cdist(receiver.places[targets], receiver.places)
            apart[apart < self.wavelength] = math.inf
            apart, near = apart.topk(min(NEIGHBOURS, apart.shape[1]), largest=False)
            rows = torch.cat((targets, near.flatten())).unique()
            targets, near = (torch.searchsorted(rows, some) for some in (targets, near))
            found.append((receiver.some(rows), targets, near, apart.isfinite()))
        return found

    # --- walls along the axes of coordinates ---

    def aligned(self) -> Room:
        """Planes square to the axes of coordinates, one after the other: a matching pursuit.

        Each image has one real gain for all places, as by a half-space. One gain explains hardly
        anything by chance, so offsets show to millimetres also where free strengths at each place
        explain any few numbers of a channel. Walls of the start come first. One is moved along its
        normal if that explains more than by chance.

        Source: Mallat and Zhang, Matching pursuits with time-frequency dictionaries, 1993.
        """
        steps = (
            10
            * (self.points.amax(0) - self.points.amin(0) + 2 * BEYOND * self.diagonal)
            / self.wavelength
        )
        elements = max(len(receiver.elements) for receiver in self.receivers)
        subcarriers = max(4, 32 // elements)
        most = min(200, ENTRIES // (int(steps.sum()) * elements * subcarriers))
        parts = [
            part
            for part in map(one_of_each_place, self.drawn(most, subcarriers, 1))
            if len(part.places)
        ]
        if most < 50 or not parts:  # too few places for the many wavelengths of a large hall
            return half_spaces(self.start[:0])
        axes = torch.eye(3).to(self.points).split(1)
        lines = torch.cat(
            [
                self.grid(axis, int(count), BEYOND)[0]
                for axis, count in zip(axes, steps, strict=True)
            ]
        )
        by_chance = CHANCE / sum(len(part.places) for part in parts)
        planes, waiting = self.start.clone(), list(range(len(self.start)))
        while waiting:  # walls of a drawing, those that explain most first
            placed = planes[[number for number in range(len(planes)) if number not in waiting]]
            tried = [
                (*self.moved(parts, placed, planes[number], by_chance), number)
                for number in waiting
            ]
            _, moved, number = max(tried, key=lambda found: found[0])
            planes[number] = moved
            waiting.remove(number)
        while len(planes) < self.most:
            left, rests = self.in_common(parts, *half_spaces(planes))
            shares = self.explained(parts, rests, lines)
            for plane in planes:
                shares[self.alike(lines, plane)] = 0
            if shares.max() < by_chance * left:
                break
            planes = torch.cat((planes, lines[shares.argmax(), None]))
        for number in range(len(planes)):  # once more, as the others are known now
            others = torch.cat((planes[:number], planes[number + 1 :]))
            bonus = by_chance if number < len(self.start) else 0.0
            _, planes[number] = self.moved(parts, others, planes[number], bonus)
        planes = self.in_best_lobes(parts, planes, by_chance)
        for number in reversed(range(len(self.start), len(planes))):
            others = torch.cat((planes[:number], planes[number + 1 :]))
            left, without = (
                self.in_common(parts, *half_spaces(some))[0] for some in (planes, others)
            )
            planes = others if without < (1 + by_chance) * left else planes
        return half_spaces(planes)

    def in_best_lobes(
        self, parts, planes: Float[Tensor, "w 4"], by_chance: float
    ) -> Float[Tensor, "w 4"]:
        """The planes, each in the lobe of its phases, and there at the place, where paths of all
        orders leave least.

        Walls of the start move at most ``DRAWN`` in all, and only if that lowers what is left by
        more than chance.
        """
        left = lambda tried: self.in_common(parts, *half_spaces(tried), self.order)[0]
        least = left(planes)
        for step in (1 / 16, 1 / 32, 1 / 64):
            for number in range(len(planes)):
                moves = self.wavelength * planes.new_tensor(
                    [-step, step, -0.5, 0.5, -1, 1, -1.5, 1.5]
                )
                if is_known := number < len(self.start):
                    moves = moves[
                        (planes[number, 3] + moves - self.start[number, 3]).abs() <= DRAWN
                    ]
                tried = planes.repeat(len(moves), 1, 1)
                tried[:, number, 3] += moves
                lefts = [left(one) for one in tried]
                if lefts and min(lefts) < least * (1 - by_chance * is_known):
                    least, planes = min(lefts), tried[lefts.index(min(lefts))]
        return planes

    def moved(
        self, parts, others: Float[Tensor, "v 4"], plane: Float[Tensor, "4"], bonus: float
    ) -> tuple[float, Float[Tensor, "4"]]:
        """Share that a plane explains where it explains most near its place, beside others; and the
        plane there.

        The place itself has a bonus, as a share of what the others leave.
        """
        left, rests = self.in_common(parts, *half_spaces(others))
        moves = torch.cat((torch.zeros(1), torch.arange(-DRAWN, DRAWN, self.wavelength / 16))).to(
            plane
        )
        line = plane.repeat(len(moves), 1)
        line[:, 3] += moves
        shares = self.explained(parts, rests, line)
        shares[0] += bonus * left
        return shares.max().item(), line[shares.argmax()]

    def in_common(
        self, receivers, planes, slabs, order: int = 1
    ) -> tuple[float, list[Complex[Tensor, "b k"]]]:
        """Mean share of power that paths with a real gain each for all places leave, and what they
        leave.
        """
        sequences = all_sequences(len(planes), order)
        waves, channels, powers = [], [], []
        for receiver, turn in zip(receivers, self.phases(planes[:0], receivers), strict=True):
            waves.append(receiver.single().reflected(planes, slabs, sequences))
            channels.append((receiver.flat * turn[:, None].conj()).to(torch.complex64))
            powers.append(receiver.flat.abs().square().sum(1).float()[:, None, None])
        rests = []
        for _ in range(1 if self.common else 3):
            gram, right = torch.zeros(1, 1), torch.zeros(1, 1)
            for w, channel, power in zip(waves, channels, powers, strict=True):
                gram = gram + ((w.conj() @ w.mT).real / power).sum(0, keepdim=True)
                right = right + ((w.conj() @ channel[..., None]).real / power).sum(0, keepdim=True)
            gains = real_strengths(_ridged(gram, 1e-6), right).mT.to(
                waves[0]
            )  # slabs have the signs
            known = [(gains @ w)[:, 0] for w in waves]
            if not self.common:  # phases of the places follow what is known of them
                channels = [in_phase(*pair) for pair in zip(channels, known, strict=True)]
            rests = [channel - one for channel, one in zip(channels, known, strict=True)]
        shares = [
            rest.abs().square().sum(1) / power[:, 0, 0]
            for rest, power in zip(rests, powers, strict=True)
        ]
        return torch.cat(shares).mean().item(), rests

    def explained(self, receivers, rests, line: Float[Tensor, "k 4"]) -> Float[Tensor, " k"]:
        """Share of power that one more image explains with a gain in common, for planes of a line."""
        total, size = line.new_zeros(2, len(line))
        for receiver, rest in zip(receivers, rests, strict=True):
            one, middle = receiver.single(), receiver.frequencies.mean().float()[None]
            powers = receiver.flat.abs().square().sum(1, keepdim=True).float()
            for rows in torch.arange(len(line)).split(64):
                waves = one.reflected(
                    *half_spaces(line[rows]), torch.arange(len(rows))[:, None], middle
                )
                total[rows] += ((waves.conj() @ rest[..., None]).real[..., 0] / powers).sum(0)
                size[rows] += (torch.view_as_real(waves).square().sum((2, 3)) / powers).sum(0)
        found = total.clamp_min(0).square() / size.clamp_min(torch.finfo(line.dtype).tiny)
        return found / sum(len(receiver.places) for receiver in receivers)

    # --- planes along axes ---

    def seed(self, room: Room) -> Room:
        """The upright plane along the axes of a room that explains most alone, if there is any."""
        none, normals, trials = (room[0][:0], room[1][:0]), axes(room[0]), []
        walls, amid = self.along(*none, normals[normals[:, 2].abs() < 0.01], 0.0)
        for plane in walls + amid:
            for moved, material in self.proposals(plane[None], 0, self.reach, 0.04, SLABS[::3]):
                upright = moved * moved.new_tensor([1.0, 1.0, 0.0, 1.0]) / moved[:2].norm()
                trials.append((upright[None], material[None]))
        return min(
            (self.polish(*trial, 60, 3e-4) for trial in self.least(trials)),
            key=self.cost,
            default=none,
        )

    def grown(self, planes, slabs, others: Float[Tensor, "v 4"] | tuple[()] = ()) -> Room:
        """The planes, and further ones along the axes of the room or, where none is left, near
        others.

        Only offsets are searched, so fainter planes stand out from noise, and walls behind the
        array from the direct path. Walls go first. All planes move a little whenever there is one
        more.
        """
        count = len(planes)
        for _ in track(range(self.most - len(planes)), "search of planes"):
            if is_up():
                break
            before = self.cost((planes, slabs))
            new = [plane for plane in others if not self.alike(planes, plane).any()]
            for candidates in (*self.along(planes, slabs, axes(planes), SMALL), new):
                if (
                    candidates
                    and self.cost(found := self.with_best(planes, slabs, candidates)) < before
                ):
                    break
            else:
                break
            planes, slabs = self.settled(*found)
            log.info("%s, square to others", self.words(planes[-1]))
        return (
            self.settled(planes, slabs, polishes=True) if len(planes) > count else (planes, slabs)
        )

    def along(
        self, planes, slabs, normals: Float[Tensor, "k 3"], least: float
    ) -> tuple[list[Float[Tensor, "4"]], list[Float[Tensor, "4"]]]:
        """Planes with these normals that explain a share of what is left, the best first.

        At most four that have all places on one side, as walls have, and as many amid the places:
        these score higher by what is left of others.
        """
        walls: list[tuple[float, Tensor]] = []
        amid: list[tuple[float, Tensor]] = []
        lines = self.grid(normals, 400, BEYOND)
        shares = self.added_shares(planes, slabs, lines.flatten(0, 1)).view(lines.shape[:2])
        for line, scores in zip(lines, shares, strict=True):
            for plane in planes:
                scores[self.alike(line, plane)] = 0
            heights = self.points.to(line) @ line[0, :3]
            is_wall = (line[:, 3] < heights.min()) | (line[:, 3] > heights.max())
            for found, own in ((walls, scores * is_wall), (amid, scores * ~is_wall)):
                found += [(own[at].item(), line[at]) for at in maxima(own, 11)]
        best = lambda found: [
            plane for share, plane in sorted(found, key=lambda pair: -pair[0])[:4] if share > least
        ]
        return best(walls), best(amid)

    def added_shares(self, planes, slabs, tried: Float[Tensor, "k 4"]) -> Float[Tensor, " k"]:
        """Mean share, 0 to 1, of what known paths leave that one more image explains beside them.

        The image in a wall behind the array resembles the direct path, so the residual hides it:
        only the part of its wave that known paths do not explain counts, in power too. Strengths of
        known paths are free, or real where free ones would explain channels of few numbers. 0 for a
        plane between the ends.
        """
        total, count, is_free = tried.new_zeros(len(tried)), 0, self.numbers >= FEW
        taken = lambda x: x if is_free else x.real.to(x)
        for receiver, turn in zip(*self.some(planes), strict=True):
            known = receiver.reflected(planes, slabs, self.sequences(planes))
            if known.shape[1] >= (1 if is_free else 2) * known.shape[2]:
                continue
            inverse = torch.linalg.solve(
                _ridged(taken(known.conj() @ known.mT), RIDGE), known.conj()
            )
            channels = (receiver.flat * turn[:, None].conj().to(receiver.flat))[..., None]
            rest = channels - known.mT @ taken(inverse @ channels)
            power = rest.abs().square().sum((1, 2)).clamp_min(torch.finfo(torch.float32).tiny)
            count += len(rest)
            for rows in torch.arange(len(tried)).split(64):
                normals, offsets = tried[rows, :3].float(), tried[rows, 3].float()
                heights = receiver.places @ normals.mT - offsets
                waves = receiver.waves(receiver.places[:, None] - 2 * heights[..., None] * normals)
                size = waves.abs().square().sum(2)
                strengths = (inverse @ waves.mT).mT
                # The image's own phase is unknown: its wave and the one a quarter of a turn behind.
                ahead, aside = (
                    waves - taken(strengths) @ known,
                    1j * waves - taken(1j * strengths) @ known,
                )
                aa, bb = (part.abs().square().sum(2) + RIDGE * size for part in (ahead, aside))
                ab = (ahead.conj() * aside).real.sum(2)
                a, b = ((part.conj() @ rest)[..., 0].real for part in (ahead, aside))
                share = (
                    (bb * a.square() - 2 * ab * a * b + aa * b.square())
                    / (aa * bb - ab.square())
                    / power[:, None]
                )
                total[rows] += (
                    share * (heights * (normals @ receiver.position - offsets) > 0)
                ).sum(0)
        return total / max(count, 1)

    def with_best(self, planes, slabs, candidates: list[Float[Tensor, "4"]]) -> Room:
        """The planes with the best candidate, which may not move to another plane; or the planes
        alone.
        """
        trials = []
        for plane in candidates:
            tried = torch.cat((planes, plane[None]))
            for moved, material in self.proposals(tried, len(planes), self.reach, 1e-4, SLABS[::3]):
                if not self.alike(planes, moved).any():
                    trials.append(
                        (torch.cat((planes, moved[None])), torch.cat((slabs, material[None])))
                    )
        best = self.least(trials)
        return self.polish(*best[0], 12, 5e-4, len(planes)) if best else (planes, slabs)

    def settled(self, planes, slabs, polishes: bool = False) -> Room:
        """Each plane once more at its best offset and tilt, as the others are known now."""
        for k in range(len(planes)):
            if is_up():
                return planes, slabs
            trials = [(planes, slabs)]
            for plane, material in self.proposals(planes, k, self.reach, 0.006, SLABS):
                trials.append((planes.clone(), slabs.clone()))
                trials[-1][0][k], trials[-1][1][k] = plane, material
            best = self.least(trials)
            if polishes:  # a slab that does not fit yet may hide the best offset
                best = self.least(best + [self.polish(*trial, 12, 5e-4, k) for trial in best])
            planes, slabs = best[0]
        return self.least([(planes, slabs), self.polish(planes, slabs, 30, 3e-4)])[0]

    def least(self, rooms: list[Room]) -> list[Room]:
        """At most three rooms that leave least, the best first. Few places choose these three."""
        if not rooms:
            return []
        parts, turns = self.some(rooms[0][0])
        left = lambda room: self.left(parts, turns, *room).item()
        if len(rooms) > 3:
            few = [part.some(slice(None, None, 3)) for part in parts]
            some = [turn if len(turn) == 1 else turn[::3] for turn in turns]
            rooms = sorted(rooms, key=lambda room: self.left(few, some, *room).item())[:3]
        return sorted(rooms, key=left)

    def without_false(self, planes: Float[Tensor, "w 4"], slabs: Float[Tensor, "w 3"]) -> Room:
        """Planes of which each explains something that the others do not, and their slabs."""
        while len(planes) > len(self.start) and not is_up():
            without = [torch.arange(len(planes)) != k for k in range(len(self.start), len(planes))]
            best = min(((planes[kept], slabs[kept]) for kept in without), key=self.cost)
            if self.cost(best) > self.cost((planes, slabs)):
                break
            planes, slabs = self.polish(*best, 60, 3e-4)
        return planes, slabs

    def sequences(self, planes: Float[Tensor, "w 4"]) -> Int[Tensor, "n order"]:
        return all_sequences(len(planes), self.order)

    def drawn(
        self, count: int, subcarriers: int | None = None, least: int = 8
    ) -> list[ReceiverChannels]:
        """All receivers with about ``count`` places together, ``least`` each, at some subcarriers."""
        each = max(least, count // len(self.receivers))
        parts = []
        for receiver in self.receivers:
            places, when = (
                torch.randperm(size, generator=self.generator)[:most].sort().values
                for size, most in (
                    (len(receiver.places), each),
                    (len(receiver.frequencies), subcarriers),
                )
            )
            parts.append(receiver.some(places, when))
        return parts

    # --- Hough transform ---

    def find(self, known: Float[Tensor, "v 4"]) -> Float[Tensor, "w 4"]:
        """Known planes and others, found one after the other, each refined with those before."""
        normals = torch.cat((fibonacci_lattice(400, 0.0, math.pi / 2), torch.eye(3)))
        grid = self.grid(normals.to(self.points), 80, BEYOND)
        planes = known
        for _ in track(range(self.most - len(planes)), "search of planes"):
            if is_up() or not (tried := self.with_one_more(planes, grid)):
                break
            _, share, planes = min(tried, key=lambda found: found[0])
            planes = self.refine(planes, 60, 1e-2)
            log.info("%s: %.1f %% of the power", self.words(planes[-1]), 100 * share)
        for _ in track(
            range(len(planes) - len(known)), "search of planes"
        ):  # each once more, as others are known now
            if is_up():
                break
            others = torch.cat((planes[: len(known)], planes[len(known) + 1 :]))
            kept = torch.cat((others, planes[len(known), None]))
            tried = [*self.with_one_more(others, grid), (self.unexplained(kept), 0.0, kept)]
            planes = min(tried, key=lambda found: found[0])[2]
        return planes

    def with_one_more(
        self, planes: Float[Tensor, "w 4"], grid: Float[Tensor, "n k 4"]
    ) -> list[tuple[float, float, Float[Tensor, "w+1 4"]]]:
        """Refined planes with each of the best candidates, what they leave, and the candidate's
        share of power.
        """
        rests = [
            self.profiles(receiver, self.projected(receiver, planes)[0]) for receiver in self.many
        ]
        few = [receiver.some(slice(None, None, 3)) for receiver in self.many]
        scores = self.scores(few, [rest[::3] for rest in rests], grid).flatten()
        score = lambda near: self.scores(self.many, rests, near[:, None])[:, 0]
        # Of noise a wave explains one part in as many as a channel has numbers; the best of a grid
        # somewhat more.
        places = sum(len(receiver.places) for receiver in self.many)
        numbers = min(receiver.flat.shape[1] for receiver in self.many)
        before = self.unexplained(planes)
        by_chance = math.exp(before) * (1 + 5 / math.sqrt(places)) / numbers
        found = []
        for plane, share in self.best(grid.flatten(0, 1), scores, score, planes):
            if share >= max(FAINTEST, by_chance):
                refined = self.refine(torch.cat((planes, plane[None])), 30, 1e-2)
                after = self.unexplained(refined)
                if share >= LEAST or before - after >= DROP:
                    found.append((after, share, refined))
        return found

    def unexplained(self, planes: Float[Tensor, "w 4"]) -> float:
        """Mean log of the share of power that free strengths leave."""
        shares = []
        for receiver in self.many:
            shares.append(log_share(self.projected(receiver, planes)[0], receiver.flat))
        return torch.cat(shares).mean().item()

    def projected(
        self, receiver: ReceiverChannels, planes: Float[Tensor, "w 4"], ridge: float = RIDGE
    ) -> tuple[Complex[Tensor, "b k"], Complex[Tensor, "b n"]]:
        """What free strengths leave, and these strengths."""
        return project(
            receiver.waves(receiver.images(planes, self.sequences(planes))), receiver.flat, ridge
        )

    def profiles(
        self, receiver: ReceiverChannels, rest: Complex[Tensor, "b k"]
    ) -> Float[Tensor, "b e t 2"]:
        """Delay profiles of a residual at each element, over the square root of the channel's
        power.

        A candidate then costs a look-up of each element in place of a sum over subcarriers.
        """
        rest = rest / (receiver.flat.norm(dim=1, keepdim=True) * math.sqrt(rest.shape[1]))
        centre, farthest = float(receiver.frequencies.mean()), 4 * self.diagonal / speed_of_light
        delays = torch.linspace(0, farthest, self.delays(receiver)).double()
        turns = 2 * math.pi * torch.outer(receiver.frequencies - centre, delays)
        found = rest.unflatten(1, (len(receiver.elements), -1)) @ torch.polar(
            torch.ones_like(turns), turns
        )
        # Single precision: of a path of 30 m it leaves a hundredth of a radian at 10 GHz.
        return torch.view_as_real(found.to(torch.complex64))

    def delays(self, receiver: ReceiverChannels) -> int:
        """Number of delays of a profile, over four diagonals of the room and at an eighth of the
        resolution.
        """
        band = float(receiver.frequencies.max() - receiver.frequencies.min())
        return 2 + math.ceil(8 * band * 4 * self.diagonal / speed_of_light)

    def scores(self, receivers, rests, grid: Float[Tensor, "w k 4"]) -> Float[Tensor, "w k"]:
        """Mean share of power that one more image explains; 0 for a plane between the ends."""
        total = grid.new_zeros(grid.shape[:2])
        for receiver, rest in zip(receivers, rests, strict=True):
            count = rest.shape[2]
            rate = (count - 1) * speed_of_light / (4 * self.diagonal)
            centre = float(receiver.frequencies.mean())
            first = (
                torch.arange(rest.shape[0] * rest.shape[1]).view(rest.shape[:2])[:, None] * count
            )
            values = rest.flatten(0, 2)
            places, antennas = (
                (points - receiver.position).float()
                for points in (receiver.places, receiver.elements)
            )
            for number, own in enumerate(grid):
                normal = own[0, :3]
                heights = (receiver.places @ normal)[:, None] - own[:, 3]
                points = places[:, None] - 2 * heights[..., None].float() * normal.float()
                square = (
                    points.square().sum(-1, keepdim=True)
                    - 2 * points @ antennas.T
                    + antennas.square().sum(1)
                )
                delay = square.clamp_min_(0).sqrt_().div_(speed_of_light)
                at = (delay * rate).clamp_max_(count - 1.001)
                before = at.long()
                part = (at - before)[..., None]
                before += first
                real, imaginary = torch.lerp(values[before], values[before + 1], part).unbind(-1)
                turns = (delay * centre).frac_().mul_(2 * math.pi)
                cos, sin = turns.cos(), turns.sin()
                real, imaginary = (
                    (real * cos - imaginary * sin).sum(-1),
                    (real * sin + imaginary * cos).sum(-1),
                )
                power = real.square() + imaginary.square()
                total[number] += (
                    power * (heights * (receiver.position @ normal - own[:, 3]) > 0)
                ).sum(0)
        return total / sum(len(receiver.places) for receiver in receivers)

    # --- variable projection ---

    def refine(self, planes: Float[Tensor, "w 4"], steps: int, rate: float) -> Float[Tensor, "w 4"]:
        """Descends on the log of what free strengths leave."""
        sequences = self.sequences(planes)

        def loss(planes: Float[Tensor, "w 4"]) -> Float[Tensor, ""]:
            shares = []
            for receiver in self.drawn(24, 8):
                receiver = receiver.single()
                points = receiver.images(planes.to(receiver.places), sequences)
                shares.append(
                    log_share(project(receiver.waves(points), receiver.flat)[0], receiver.flat)
                )
            return torch.cat(shares).mean()

        return self.descend(loss, planes, [], steps, rate)[0]

    # --- phases ---

    def resolve(self, planes: Float[Tensor, "w 4"]) -> Room:
        """Moves planes to where real strengths of slabs leave least. Planes not yet resolved keep
        complex strengths.
        """
        (planes, slabs), resolved = half_spaces(planes), torch.zeros(len(planes), dtype=torch.bool)
        parts = self.some(planes)
        for reach, tilt, materials in (
            (0.07, 0.04, SLABS[::3]),
            (0.05, 0.006, SLABS),
            (0.05, 0.006, SLABS),
        ):
            for k in track(range(len(planes)), "places of planes"):
                if is_up():
                    return planes, slabs
                resolved[k] = True
                trials: list[tuple[float, Tensor, Tensor]] = []
                for about in (planes, *(self.squared(planes, k) if tilt > 0.01 else ())):
                    for plane, material in self.proposals(about, k, reach, tilt, materials):
                        tried, own = planes.clone(), slabs.clone()
                        tried[k], own[k] = plane, material
                        trials.append((self.left(*parts, tried, own, resolved).item(), tried, own))
                trials.sort(key=lambda trial: trial[0])
                if resolved.all():
                    for _, tried, own in trials[:3]:
                        moved = self.polish(tried, own, 12, 5e-4, k)
                        trials.append((self.left(*parts, *moved, resolved).item(), *moved))
                _, planes, slabs = min(trials, key=lambda trial: trial[0])
        return self.polish(planes, slabs, 60, 3e-4)

    def squared(self, planes: Float[Tensor, "w 4"], k: int) -> list[Float[Tensor, "w 4"]]:
        """The planes, with plane k parallel or at right angles to others and at the best two
        offsets near its own.

        A plane that is tilted may stand for two parallel ones.
        """
        known = torch.arange(len(planes)) != k
        normals = planes[known, :3]
        pairs = torch.combinations(torch.arange(len(normals)))
        crossed = torch.linalg.cross(normals[pairs[:, 0]], normals[pairs[:, 1]])
        axes = torch.cat((functional.normalize(crossed[crossed.norm(dim=1) > 0.5], dim=1), normals))
        cosines = axes @ planes[k, :3]
        axes = (axes * cosines.sign()[:, None])[(cosines.abs() > 0.9) & (cosines.abs() < 0.9995)]
        axes = distinct(axes, 2e-4)[:3]
        rests = [
            self.profiles(receiver, self.projected(receiver, planes[known])[0])
            for receiver in self.many
            if len(axes)
        ]
        turned = []
        for axis in axes:
            offsets = planes[k, 3] + 0.1 * self.diagonal * torch.linspace(-1, 1, 81).double()
            line = torch.cat((axis.expand(81, 3), offsets[:, None]), 1)
            scores = self.scores(self.many, rests, line[None])[0]
            for at in maxima(scores, 5):
                turned.append(planes.clone())
                turned[-1][k] = line[at]
        return turned

    def some(
        self, planes: Float[Tensor, "w 4"]
    ) -> tuple[list[ReceiverChannels], list[Complex[Tensor, " c"]]]:
        """About a hundred places at some subcarriers, a fifth or 64 numbers of a channel, and their
        phases.
        """
        parts, turns = [], []
        for receiver, phase in zip(
            self.receivers, self.phases(planes, self.receivers), strict=True
        ):
            every = slice(None, None, max(1, len(receiver.places) * len(self.receivers) // 100))
            parts.append(receiver.some(every, thinned(receiver)).single())
            turns.append(phase if len(phase) == 1 else phase[every])
        return parts, turns

    def phases(
        self, planes: Float[Tensor, "w 4"], receivers: list[ReceiverChannels]
    ) -> list[Complex[Tensor, " c"]]:
        """Phase of each receiver's direct paths: one in common, or one for each place."""
        found = []
        for receiver in receivers:
            if self.common:  # a hundred places say it
                receiver = receiver.some(slice(None, None, max(1, len(receiver.places) // 100)))
            # One place alone does not tell direct paths from those beside them: they share their
            # power, and so a phase.
            direct = self.projected(receiver, planes, 1e-4 if self.common else 1e-2)[1][:, 0]
            strong = direct.abs() >= direct.abs().median()
            found.append((direct.sgn() * strong).sum()[None].sgn() if self.common else direct.sgn())
        return found

    def proposals(
        self, planes, k: int, reach: float, tilt: float, materials
    ) -> list[tuple[Tensor, Tensor]]:
        """Planes near plane k, and slabs, with which its reflections have like phases: maxima of a
        periodogram.
        """
        normal, offset, sequences = planes[k, :3], planes[k, 3], self.sequences(planes)
        across = tangents(normal)
        steps = (
            min(self.wavelength / 16, reach / 4),
            min(self.wavelength / 5 / self.diagonal, tilt / 4),
        )
        counts = (
            min(round(r / s), most) for r, s, most in zip((reach, tilt), steps, CELLS, strict=True)
        )
        offset_grid, tilt_grid = (
            s * torch.arange(-n, n + 1).double() for n, s in zip(counts, steps, strict=True)
        )
        grids = [offset_grid, tilt_grid, tilt_grid]

        def moved(q: Float[Tensor, "3"]) -> Float[Tensor, "4"]:
            turned = functional.normalize(normal + q[1] * across[0] + q[2] * across[1], dim=0)
            return torch.cat((turned, (offset + q[0])[None]))

        own = int((sequences[:, :-1].lt(0).all(1) & (sequences[:, -1] == k)).nonzero())
        found = []
        for receiver, phase in zip(
            self.receivers, self.phases(planes, self.receivers), strict=True
        ):
            waves = receiver.waves(receiver.images(planes, sequences))
            _, strengths = project(
                waves.to(torch.complex64), receiver.flat.to(torch.complex64), 1e-4
            )

            def length(q: Float[Tensor, "3"], receiver=receiver) -> Float[Tensor, " b"]:
                plane = moved(q)
                return (reflect(receiver.places, plane[:3], plane[3]) - receiver.position).norm(
                    dim=1
                )

            slope = torch.autograd.functional.jacobian(length, torch.zeros(3).double())
            ways = reflect(receiver.places, normal, offset) - receiver.position
            cosines = (functional.normalize(ways, dim=1) @ normal).abs().clamp(1e-3, 1)
            weights = (
                strengths[:, own].abs() * waves[:, own].norm(dim=1) / receiver.flat.norm(dim=1)
            )
            phasors = weights * strengths[:, own].sgn() * phase.conj()
            strongest = weights.argsort(descending=True)[: max(16, 120 // len(self.receivers))]
            found.append((phasors[strongest], slope[strongest], cosines[strongest]))
        phasors, slope, cosines = (torch.cat(part) for part in zip(*found, strict=True))
        turns = [
            2 * math.pi / self.wavelength * slope[:, axis, None] * grid
            for axis, grid in enumerate(grids)
        ]
        offsets, *tilts = (torch.polar(torch.ones_like(turn), turn) for turn in turns)
        trials = []
        for material in materials:
            permittivity, thickness = _materials(material)
            te, tm = slab(permittivity, cosines, thickness / self.wavelength)
            expected = polarised(normal, te, tm)
            left = ((phasors * expected.conj())[:, None] * offsets)[:, :, None] * tilts[0][:, None]
            sums = (left.flatten(1).mT @ tilts[1]).real.unflatten(0, (len(grids[0]), -1)).flatten(1)
            highest, at = sums.max(1)  # of each offset
            highest = highest / (phasors.abs() * expected.abs()).sum()
            for move in range(len(highest)):
                if highest[move] == highest[max(0, move - 2) : move + 3].max():
                    q = (
                        grids[0][move],
                        grids[1][at[move] // len(grids[2])],
                        grids[2][at[move] % len(grids[2])],
                    )
                    trials.append((highest[move].item(), torch.stack(q), material))
        trials.sort(key=lambda trial: -trial[0])
        kept: list[tuple[float, Tensor, Tensor]] = []
        for trial in trials:  # the best half-space and the best slab of each lobe
            alike = [other for other in kept if (other[2][2] < 0) == (trial[2][2] < 0)]
            if len(alike) < 8 and all(
                (trial[1] - other[1])[0].abs() > self.wavelength / 6 for other in alike
            ):
                kept.append(trial)
        return [(moved(q), material) for _, q, material in kept]

    def left(
        self, receivers, phases, planes, slabs, resolved: Bool[Tensor, " w"] | bool = True
    ) -> Float[Tensor, ""]:
        """Mean log of the share of power that real strengths leave; complex ones of paths at planes
        not resolved.
        """
        rests = self.rests(receivers, phases, planes, slabs, resolved)
        shares = [
            log_share(rest, receiver.flat) for receiver, rest in zip(receivers, rests, strict=True)
        ]
        return torch.cat(shares).mean()

    def rests(
        self, receivers, phases, planes, slabs, resolved: Bool[Tensor, " w"] | bool = True
    ) -> list[Complex[Tensor, "b k"]]:
        """What these strengths leave of each receiver's channels."""
        sequences = self.sequences(planes)
        resolved = torch.as_tensor(resolved).expand(len(planes))
        free = torch.isin(sequences, (~resolved).nonzero()).any(1)
        found = []
        for receiver, phase in zip(receivers, phases, strict=True):
            channels = receiver.flat * phase[:, None].conj().to(receiver.flat)
            waves = receiver.reflected(planes, slabs, sequences)
            waves, signed = (
                torch.cat((waves, 1j * waves[:, free]), 1),
                torch.cat((free, free[free])),
            )
            rest = real_residual(waves, channels, signed)
            if not self.common:  # once more with the phase of each place that explains most
                rest = real_residual(waves, in_phase(channels, channels - rest), signed)
            found.append(rest)
        return found

    def polish(
        self, planes, slabs, steps: int, rate: float, only: int | None = None
    ) -> tuple[Tensor, Tensor]:
        """Descends on ``left`` with all planes, or with one."""
        moves = (
            torch.arange(len(planes)) == only
            if only is not None
            else torch.ones(len(planes), dtype=torch.bool)
        )
        phases = self.phases(planes, self.receivers)

        def loss(tried: Float[Tensor, "w 4"], own: Float[Tensor, "w 3"]) -> Float[Tensor, ""]:
            tried, own = (
                torch.where(moves[:, None], new, old)
                for new, old in ((tried, planes), (own, slabs))
            )
            parts, turns = [], []
            for receiver, phase in zip(self.receivers, phases, strict=True):
                count = max(8, 40 // len(self.receivers))
                index = torch.randperm(len(receiver.places), generator=self.generator)[:count]
                when = torch.randperm(len(receiver.frequencies), generator=self.generator)[:6]
                parts.append(receiver.some(index, when).single())
                turns.append(phase if len(phase) == 1 else phase[index])
            return self.left(parts, turns, tried, own)

        moved, own = self.descend(loss, planes, [slabs], steps, rate)
        return torch.where(moves[:, None], moved, planes), torch.where(moves[:, None], own, slabs)


def one_of_each_place(receiver: ReceiverChannels) -> ReceiverChannels:
    """One link of each place that is heard: links of one place have one channel, and explain each
    other.
    """
    receiver = receiver.some(receiver.channels.abs().amax((1, 2)) > 0)
    _, which = receiver.places.unique(dim=0, return_inverse=True)
    first = {place: row for row, place in reversed([*enumerate(which.tolist())])}
    return receiver.some(torch.tensor(sorted(first.values()), dtype=torch.long))


def thinned(receiver: ReceiverChannels) -> slice:
    """A fifth of the subcarriers, or as many as leave 64 numbers of a channel."""
    return slice(None, None, min(5, max(1, receiver.flat.shape[1] // 64)))


def in_phase(
    channels: Complex[Tensor, "b k"], known: Complex[Tensor, "b k"]
) -> Complex[Tensor, "b k"]:
    """Channels with the phase of what is known of each; their own where that is nothing."""
    turn = (known * channels.conj()).sum(1, keepdim=True).sgn()
    return torch.where(turn == 0, channels, channels * turn)


def project(
    waves: Complex[Tensor, "b n k"], channels: Complex[Tensor, "b k"], ridge: float = RIDGE
) -> tuple[Complex[Tensor, "b k"], Complex[Tensor, "b n"]]:
    """Residual of the channels after the best strength of each wave at each place, and these
    strengths.
    """
    gram = _ridged(waves.conj() @ waves.mT, ridge)
    strengths = torch.linalg.solve(gram, waves.conj() @ channels[..., None])[..., 0]
    return channels - (strengths[:, None] @ waves)[:, 0], strengths


def real_residual(
    waves: Complex[Tensor, "b n k"], channels: Complex[Tensor, "b k"], signed: Bool[Tensor, " n"]
) -> Complex[Tensor, "b k"]:
    """Residual after the best real strengths; those that would be negative and are not ``signed``
    are left out.
    """
    gram = _ridged((waves.conj() @ waves.mT).real, RIDGE)
    strengths = real_strengths(gram, (waves.conj() @ channels[..., None]).real, signed)
    return channels - (strengths.mT.to(waves) @ waves)[:, 0]


def real_strengths(
    gram: Float[Tensor, "b n n"],
    right: Float[Tensor, "b n 1"],
    signed: Bool[Tensor, " n"] | bool = False,
) -> Float[Tensor, "b n 1"]:
    """Solutions of linear systems; those that would be negative and are not ``signed`` are 0, and
    the others follow.
    """
    kept = ((torch.linalg.solve(gram, right) >= 0) | torch.as_tensor(signed)[..., None]).to(gram)
    return torch.linalg.solve(
        gram * kept * kept.mT + torch.diag_embed(1 - kept[..., 0]), right * kept
    )


def log_share(part: Complex[Tensor, "b k"], whole: Complex[Tensor, "b k"]) -> Float[Tensor, " b"]:
    power = whole.abs().square().sum(-1)
    return (part.abs().square().sum(-1) / torch.where(power > 0, power, 1) + FLOOR).log()


def axes(planes: Float[Tensor, "w 4"]) -> Float[Tensor, "k 3"]:
    """Normals of planes and of others that a room may have: level, upright and at right angles to
    upright ones.
    """
    normals, up = planes[:, :3], planes.new_tensor([0.0, 0.0, 1.0])
    upright = functional.normalize(normals[normals[:, 2].abs() < 0.5] * (1 - up), dim=1)
    across = torch.linalg.cross(up.expand_as(upright), upright)
    return torch.stack(distinct(torch.cat((normals, up[None], upright, across)), 2e-4))


def is_square(planes: Float[Tensor, "w 4"]) -> bool:
    """True if planes are level or upright, and parallel or at right angles to each other, to a
    degree or so.
    """
    normals = torch.cat((planes[:, :3], planes.new_tensor([[0.0, 0.0, 1.0]])))
    cosines = (normals @ normals.mT).abs()
    return bool(((cosines < 0.02) | (cosines > 0.9998)).all())


def maxima(scores: Float[Tensor, " k"], width: int) -> Int[Tensor, " n"]:
    """Indices of at most two maxima over 0, each the largest of ``width`` neighbours."""
    peaks = functional.max_pool1d(scores[None], width, 1, width // 2)[0] == scores
    at = (scores * peaks).topk(2).indices
    return at[scores[at] * peaks[at] > 0]


def _ridged(gram: Tensor, ridge: float) -> Tensor:
    power = gram.diagonal(dim1=1, dim2=2).real.mean(1)
    power = torch.where(power > 0, power, 1)[:, None, None]  # nothing is heard: strengths are 0
    return gram + ridge * power * torch.eye(gram.shape[-1], dtype=gram.real.dtype)


def _materials(slabs: Float[Tensor, "*w 3"]) -> tuple[Complex[Tensor, "*w"], Float[Tensor, "*w"]]:
    """Permittivities, and thicknesses [m]."""
    real, imaginary, thickness = slabs.exp().unbind(-1)
    return torch.complex(1 + real, -imaginary), thickness
