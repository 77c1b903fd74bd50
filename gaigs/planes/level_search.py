"""Search for planes in received levels: interference with known paths, one plane at a time."""

import itertools
import logging
import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Complex, Float, Int
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core import stages
from gaigs.core.geometry import sinc
from gaigs.core.query import Query
from gaigs.data import Links
from gaigs.planes.lag_score import LagOptions, LinkPaths
from gaigs.planes.lag_search import frame_of, group_links, list_bandwidths
from gaigs.planes.lags import ArrayPaths, FurtherWave, ReceiverLags, reflection
from gaigs.planes.periodogram import TilePeak
from gaigs.planes.search import Score
from gaigs.splatting.placement.mirrored.paths import Mirrored
from gaigs.splatting.placement.mirrored.reflections import square_normals

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class LevelOptions:
    """Options of the search for planes in received levels."""

    clear: float = 3.0  # least fall of the errors by which a plane is located [standard errors]
    # Least ratio of this fall to the largest fall by chance. With few links some plane always
    # explains much.
    chance: float = 1.1
    shuffles: int = 4  # number of trials for the fall by chance, each with errors shuffled
    maxima: int = 4  # number of maxima of the periodograms whose errors are compared


@dataclass(frozen=True)
class ReceiverLevels(ReceiverLags):
    """Training levels of one receiver at one carrier; ``lags`` are the received powers (b, 1)."""

    @cached_property
    def levels(self) -> Float[Tensor, " b"]:
        """Received levels [dB]."""
        return 10 * self.lags[:, 0].real.log10()

    def errors(self, lags: Complex[Tensor, "b 1"]) -> Float[Tensor, " b"]:
        """Log of 1 + the squared error of each level, independent of the receiver's gain."""
        scale = 3.0  # [dB]; larger errors hardly count
        errors = 10 * lags[:, 0].real.clamp_min(1e-12).log10() - self.levels
        return ((errors - errors.detach().median()) / scale).square().log1p()


class LevelRoom(NamedTuple):
    """Planes of the room, and what obstacles transmit of their paths.

    The transmitted fractions come from a model that adds the powers of paths.
    """

    planes: Float[Tensor, "w 4"]  # normals and offsets [m]
    located: Bool[Tensor, " w"]  # True for planes whose paths interfere
    # Share of the direct path's field, and of the field at each plane, that obstacles let through
    # at each link (b, w + 1).
    passing: Float[Tensor, "b v"]
    gain: float = 0.0  # fall of the errors by the plane located last [standard errors]
    number: int = 0  # number of the plane located last
    bandwidth: float = 0.0  # band over which powers were averaged [Hz]


class LevelScore(Score[LevelRoom]):
    """Score of planes by received levels.

    Paths at located planes interfere; powers of other paths add. A plane is located once the phases
    of its paths are known, since a wrong phase is worse than no phase. The error is the negative
    gain of the plane located last.
    """

    def __init__(self, paths: LinkPaths, options: LevelOptions):
        self.paths = paths
        self.options = options

    def error(self, room: LevelRoom) -> float:
        return -room.gain

    def move(self, room: LevelRoom, number: int) -> LevelRoom:
        """The room with a plane moved to where its phases lower the errors most clearly.

        ``gain`` of the result is 0 if no position of the plane lowers the errors.
        """
        sequences = self.paths.sequences(room.planes)
        phased = is_phased(sequences, room.located)  # (n,)
        interfering = phased & ~(sequences == number).any(1)  # with paths at the plane (n,)
        waves = []
        before = []  # powers of each receiver's links while the plane has no phase
        for receiver, passing in self.paths.split(room.passing):
            paths = receiver.paths(room.planes, sequences, passing)
            powers = self.add_powers(paths, phased)
            before.append(powers)
            # The wave of a path that interferes with paths at located planes, times the share of
            # the plane's paths that obstacles let through.
            slopes = receiver.slopes(powers)[:, 0]  # (b, 1)
            weights = slopes * paths.fields * interfering * passing[:, number + 1, None]
            waves.append(FurtherWave(weights[..., None], paths.lengths))
        located = room.located.index_fill(0, torch.tensor(number), True)
        best = room._replace(gain=0.0, number=number, bandwidth=self.paths.bandwidth)
        for peak in self._find_peaks(room.planes, waves, number)[: self.options.maxima]:
            planes = torch.cat((room.planes[:number], peak.plane[None], room.planes[number + 1 :]))
            trial = best._replace(planes=planes, located=located)
            trial = trial._replace(gain=self._measure_gain(trial, before, sequences))
            best = min(best, trial, key=self.error)
        return best

    def _find_peaks(
        self, planes: Float[Tensor, "w 4"], waves: list[FurtherWave], number: int
    ) -> list[TilePeak]:
        """Maxima of the periodograms for normals near a plane's normal, highest first."""
        peaks = []
        for normal in square_normals(planes[:, :3], number):
            peaks += self.paths.periodogram.find_peaks(
                waves, self.paths.bandwidth, normal, planes[number]
            )
        return sorted(peaks, key=lambda peak: -peak.height)

    def _measure_gain(
        self,
        room: LevelRoom,
        before: list[Complex[Tensor, "b 1"]],
        sequences: Int[Tensor, "n order"],
    ) -> float:
        """Mean fall of the errors [standard errors] if the room's powers replace ``before``."""
        phased = is_phased(sequences, room.located)
        gains = []
        for (receiver, passing), old in zip(self.paths.split(room.passing), before, strict=True):
            new = self.add_powers(receiver.paths(room.planes, sequences, passing), phased)
            # Half of the interference: errors then follow its phase more than its strength, which
            # is uncertain.
            gains.append(receiver.errors(old) - receiver.errors((old + new) / 2))
        deviation, mean = torch.std_mean(torch.cat(gains))
        return mean.item() / max(deviation.item(), 1e-12) * math.sqrt(len(room.passing))

    def add_powers(self, paths: ArrayPaths, phased: Bool[Tensor, " n"]) -> Complex[Tensor, "b 1"]:
        """Powers of paths: ``phased`` paths interfere, powers of the others add."""
        waves = paths.fields[:, phased]
        lengths = paths.lengths[:, phased]
        gaps = lengths[:, :, None] - lengths[:, None]  # (b, n, n)
        coherence = sinc(self.paths.bandwidth / speed_of_light * gaps)
        interfering = ((coherence * waves[:, None]).sum(2) * waves.conj()).sum(1)  # (b,)
        powers = (paths.fields[:, ~phased].abs().square()).sum(1) + interfering
        return powers[:, None]

    def measure_chance(self, room: LevelRoom, numbers: list[int], enough: float) -> float:
        """Largest gain that chance gives one of the planes ``numbers`` [standard errors].

        Ratios of measured to predicted power are shuffled among links, so no plane explains them.
        Trials end at the first gain above ``enough``. The result is infinite if the time is up.
        """
        sequences = self.paths.sequences(room.planes)
        phased = is_phased(sequences, room.located)
        generator = torch.Generator().manual_seed(0)
        largest = 0.0
        for _ in stages.track(range(self.options.shuffles), "search of planes"):
            shuffled = []
            for receiver, passing in self.paths.split(room.passing):
                paths = receiver.paths(room.planes, sequences, passing)
                powers = self.add_powers(paths, phased)
                ratios = receiver.lags / powers.real.clamp_min(1e-12)
                ratios = ratios[torch.randperm(len(ratios), generator=generator)]
                shuffled.append(replace(receiver, lags=powers * ratios))
            score = LevelScore(self.paths.with_receivers(shuffled), self.options)
            for number in numbers:
                if stages.is_up():
                    return math.inf
                largest = max(largest, score.move(room, number).gain)
                if largest > enough:
                    return largest
        return largest


class LevelSearch:
    """Search for planes whose reflections interfere in received levels.

    A level is a single number, so interference shows only after a model has learnt the losses by
    obstacles. Then planes are located one after the other, the one with the largest gain first
    (``LevelScore``).

    Args:
        links: Links of task ``rssi``, of which the training links are used. Readings at one place
            count as one.
        frequencies: Carrier of each link [Hz].
        trend: Levels to which the paths' powers are relative [dB].
        planes: Initial normals and offsets (w, 4) [m]. Each plane is searched near its start.
        numbers: Numbers of the planes in the placement.
        order: Largest number of reflections of a path; more than 2 count as 2.
        most: Largest number of links, of all receivers together.
        options: Options of the search.

    Source: ours.
    """

    def __init__(
        self,
        links: Links,
        frequencies: Float[Tensor, " n"],
        trend: Float[Tensor, " n"],
        planes: Float[Tensor, "w 4"],
        numbers: list[int],
        order: int,
        most: int = 1500,
        options: LevelOptions | None = None,
    ):
        self.options = options or LevelOptions()
        self.lag_options = LagOptions()
        self.numbers = numbers
        self.known_bandwidth = links.scene.bandwidth
        self.queries: list[Query] = []
        self.frame = frame_of(links)
        self.wavelength = speed_of_light / frequencies.max().item()
        receivers: list[ReceiverLags] = []
        relative_levels = links.labels - trend
        for group in group_links(links, frequencies, self.frame, most, self.lag_options.pairs):
            rows = group.rows
            transmitters = links.query.transmitters[rows]
            places, place_of_row = transmitters.unique(dim=0, return_inverse=True)
            # The mean of the readings at each place.
            sums = relative_levels.new_zeros(len(places))
            sums = sums.index_add(0, place_of_row, relative_levels[rows])
            levels = sums / place_of_row.bincount()
            powers = 10 ** ((levels - levels.median()) / 10)
            # The array is a single point, whose only lag is the power.
            array = group.receiver.array
            point = replace(array, elements=array.elements.new_zeros(1, 3))
            lags = powers[:, None].to(torch.complex64)
            places = places - self.frame.middle
            receivers.append(ReceiverLevels(places, lags, group.carrier, group.pose, point))
            # The first link of each place: of several copies to a place the last one stays, so
            # links are copied in reversed order.
            first = rows.new_zeros(len(places))
            first = first.index_copy(0, place_of_row.flip(0), rows.flip(0))
            self.queries.append(links.query[first])
        self.paths = LinkPaths(
            self.frame, receivers, self.wavelength, order, self.lag_options.faint
        )
        self.score = LevelScore(self.paths, self.options)
        self.start = self.frame.from_world(planes).float()

    @torch.no_grad()
    def locate(self, placement: Mirrored) -> list[int]:
        """Moves planes of the placement to significant maxima, one by one.

        Paths at a moved plane interfere from then on.

        Returns:
            Numbers of the moved planes in the placement.
        """
        numbers: list[int] = []
        threshold = 0.0  # ``chance`` times the largest gain by chance; 0 until it is measured
        while True:
            # Rows of the search's planes that are not yet located.
            waiting = [row for row, k in enumerate(self.numbers) if not placement.located[k]]
            if not waiting:
                return numbers
            room = self.room_of(placement)
            is_unknown = self.known_bandwidth is None and not room.located.any()
            if is_unknown:
                bandwidths = list_bandwidths(None, self.frame, self.lag_options)
            else:
                learnt = placement.log_bandwidth
                bandwidths = [0.0 if learnt is None else learnt.exp().item()]
            best = self.locate_one(room, waiting, bandwidths)
            if best is None:
                return numbers
            if best.gain >= self.options.clear and not threshold:
                # The measurement may end once the gain by chance is enough to reject this plane.
                chance = self.options.chance
                enough = best.gain / chance
                threshold = chance * self.score.measure_chance(room, waiting, enough)
            if best.gain < max(self.options.clear, threshold):
                return numbers
            if is_unknown:
                placement.log_bandwidth.fill_(math.log(best.bandwidth))
            number = self.numbers[best.number]
            plane = best.planes[best.number]
            placement.place(number, self.frame.to_world(plane.double()))
            placement.locate(number)
            numbers.append(number)
            log.info("%s, by %.1f standard errors", self.frame.describe(plane), best.gain)

    def locate_one(
        self, room: LevelRoom, numbers: list[int], bandwidths: list[float]
    ) -> LevelRoom | None:
        """The room after the move of the one plane of ``numbers`` with the largest gain.

        Each plane is tried with each of ``bandwidths`` [Hz]. The best bandwidth stays set in
        ``paths``. The result is None if the time is up.
        """
        trials = []
        pairs = [*itertools.product(bandwidths, numbers)]
        for bandwidth, number in stages.track(pairs, "search of planes"):
            if stages.is_up():
                return None
            self.paths.bandwidth = bandwidth
            trials.append(self.score.move(room, number))
        best = min(trials, key=self.score.error)
        self.paths.bandwidth = best.bandwidth
        return best

    def room_of(self, placement: Mirrored) -> LevelRoom:
        """The room of a placement: located planes at their position, others at their start."""
        located = placement.located[self.numbers].cpu()
        placed = self.frame.from_world(placement.planes[self.numbers].cpu()).float()
        planes = torch.where(located[:, None], placed, self.start)
        return LevelRoom(planes, located, self.passing(placement, planes))

    def passing(self, placement: Mirrored, planes: Float[Tensor, "w 4"]) -> Float[Tensor, "b v"]:
        """Fractions of fields that a model's obstacles transmit, see ``LevelRoom.passing``.

        They are the model's fields over the fields without obstacles, limited to 1: near Brewster's
        angle planes reflect almost nothing, and the quotient is meaningless.
        """
        columns = [0, *(number + 1 for number in self.numbers)]  # direct path, searched planes
        fractions = []
        for receiver, query in zip(self.paths.receivers, self.queries, strict=True):
            cosines = receiver.reflect_once(planes).cosines.abs()
            reflected = reflection(planes[:, :3], cosines).abs()  # (b, w)
            expected = torch.cat((torch.ones_like(reflected[:, :1]), reflected), 1)  # (b, w + 1)
            fields = placement.passing(query.to(placement.origin.device))
            fields = fields.cpu().float()[:, columns]
            fraction = torch.where(fields > 0, fields / expected.clamp_min(1e-6), 1)
            fractions.append(fraction.clamp_max(1))
        return torch.cat(fractions)


def is_phased(sequences: Int[Tensor, "n order"], located: Bool[Tensor, " w"]) -> Bool[Tensor, " n"]:
    """True for paths whose planes are all located."""
    columns = torch.cat((located, located.new_ones(1)))  # number -1, no plane, is the last one
    return columns[sequences].all(1)
