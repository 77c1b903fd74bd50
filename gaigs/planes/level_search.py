"""Search for planes in received levels: interference with known paths, one plane after the other."""

import itertools
import logging
import math
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Complex, Float, Int
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.geometry import sinc
from gaigs.core.query import Query
from gaigs.core.stages import is_up, track
from gaigs.data import Links
from gaigs.planes.lag_search import LagSearch, ReceiverLags, reflection
from gaigs.splatting.placement.mirrored.paths import Mirrored
from gaigs.splatting.placement.mirrored.reflections import seen_from, square_normals

log = logging.getLogger(__name__)

SCALE = 3.0
"""Error of a level beyond which it hardly counts [dB]."""

CLEAR = 3.0
"""Least fall of the errors by a plane whose phases count [standard errors]."""

CHANCE, SHUFFLES = 1.1, 4
"""Least ratio of this fall to the largest one by chance, and how often that is tried: with errors
that have changed their links. Of few links some plane always explains much."""

TRIED = 4
"""Maxima of the periodograms whose errors are compared."""


@dataclass(frozen=True)
class ReceiverLevels(ReceiverLags):
    """Training levels of one receiver of one carrier; ``lags`` are powers (b, 1)."""

    @cached_property
    def levels(self) -> Float[Tensor, " b"]:
        """[dB]."""
        return 10 * self.lags[:, 0].real.log10()

    def errors(self, lags: Complex[Tensor, "b 1"]) -> Float[Tensor, " b"]:
        """Log of 1 + the squared error of each level over ``SCALE``; the receiver's gain does not
        count.
        """
        errors = 10 * lags[:, 0].real.clamp_min(1e-12).log10() - self.levels
        return ((errors - errors.detach().median()) / SCALE).square().log1p()


class LevelSearch(LagSearch):
    """Planes whose reflections interfere in received levels.

    A level is one number, so phases say nothing before a model knows from powers what obstacles let
    through. Then planes are located one after the other, the clearest first, by the periodogram of
    ``LagSearch``. Only paths at located planes interfere; the others add as powers, because a wrong
    phase would be worse than none.

    Args:
        links: Their training links count; of the task ``rssi``. Readings at one place count as one.
        frequencies: Carrier of each link [Hz].
        trend: Levels on which the paths' powers stand [dB].
        planes: Normals and offsets at the start (w, 4) [m]. Each is searched near its start.
        numbers: Of these planes in the placement.
        order: As of ``LagSearch``.
        most: Links that count, of all receivers together.

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
    ):
        self.order, self.numbers, self.known = min(order, 2), numbers, links.scene.bandwidth
        self.queries: list[Query] = []
        for own, carrier, pose, receiver in self.parts(links, frequencies, most):
            places, which = links.query.transmitters[own].unique(dim=0, return_inverse=True)
            values = (links.labels - trend)[own]
            levels = values.new_zeros(len(places)).index_add(0, which, values) / which.bincount()
            powers = 10 ** ((levels - levels.median()) / 10)
            point = replace(receiver.array, elements=receiver.array.elements.new_zeros(1, 3))
            lags = powers[:, None].to(torch.complex64)
            self.receivers.append(ReceiverLevels(places - self.middle, lags, carrier, pose, point))
            first = own.new_zeros(len(places)).index_copy(0, which.flip(0), own.flip(0))
            self.queries.append(links.query[first])
        self.start = seen_from(planes.double(), self.middle).float()

    @torch.no_grad()
    def locate(self, placement: Mirrored) -> list[int]:
        """Puts planes where they are clear, and lets paths at them interfere; the result are their
        numbers.
        """
        found: list[int] = []
        least = 0.0
        while left := [k for k, number in enumerate(self.numbers) if not placement.located[number]]:
            located = placement.located[self.numbers].cpu()
            own = seen_from(placement.planes[self.numbers].cpu(), self.middle).float()
            planes = torch.where(located[:, None], own, self.start)
            passing = self.passing(placement, planes)
            is_unknown = self.known is None and not located.any()
            learnt = (
                0.0 if placement.log_bandwidth is None else placement.log_bandwidth.exp().item()
            )
            bandwidths = self.bandwidths(None if is_unknown else learnt)
            trials = []
            for self.bandwidth, k in track(
                [*itertools.product(bandwidths, left)], "search of planes"
            ):
                if is_up():
                    return found
                trials.append((*self.clearest(planes, passing, located, k), self.bandwidth, k))
            gain, plane, self.bandwidth, k = max(trials, key=lambda trial: trial[0])
            if gain >= CLEAR and not least:
                least = CHANCE * self.by_chance(planes, passing, located, left, gain / CHANCE)
            if gain < max(CLEAR, least):
                break
            if is_unknown:
                placement.log_bandwidth.fill_(math.log(self.bandwidth))
            placement.place(self.numbers[k], seen_from(plane.double(), -self.middle))
            placement.locate(self.numbers[k])
            found.append(self.numbers[k])
            log.info("%s, by %.1f standard errors", self.words(plane), gain)
        return found

    def passing(self, placement: Mirrored, planes: Float[Tensor, "w 4"]) -> Float[Tensor, "b v"]:
        """Field of the direct path and of that at each plane in a model, over what this search
        expects; at most 1.

        Near Brewster's angle the search expects next to nothing, which another plane would
        multiply.
        """
        parts = []
        for receiver, query in zip(self.receivers, self.queries, strict=True):
            expected = reflection(planes[:, :3], receiver.single(planes)[3].abs()).abs()
            expected = torch.cat((torch.ones_like(expected[:, :1]), expected), 1)
            own = placement.passing(query.to(placement.origin.device)).cpu().float()
            own = own[:, [0, *(number + 1 for number in self.numbers)]]
            parts.append(torch.where(own > 0, own / expected.clamp_min(1e-6), 1).clamp_max(1))
        return torch.cat(parts)

    def by_chance(
        self,
        planes: Float[Tensor, "w 4"],
        passing: Float[Tensor, "b v"],
        located: Bool[Tensor, " w"],
        left: list[int],
        enough: float,
    ) -> float:
        """Largest gain of ``clearest`` where the errors of each receiver's links are shuffled.

        The first gain above ``enough`` ends the trials; if the time is up, it is infinite.
        """
        real, sequences, largest = self.receivers, self.sequences(planes), 0.0
        generator = torch.Generator().manual_seed(0)
        for _ in track(range(SHUFFLES), "search of planes"):
            shuffled = []
            for receiver, own in self.each(passing):
                powers = self.received(
                    receiver.paths(planes, sequences, own), self.phased(sequences, located)
                )
                errors = receiver.lags / powers.real.clamp_min(1e-12)
                errors = errors[torch.randperm(len(errors), generator=generator)]
                shuffled.append(replace(receiver, lags=powers * errors))
            for k in left:
                if is_up():
                    return math.inf
                self.receivers = shuffled
                largest = max(largest, self.clearest(planes, passing, located, k)[0])
                self.receivers = real
                if largest > enough:
                    return largest
        return largest

    def clearest(
        self,
        planes: Float[Tensor, "w 4"],
        passing: Float[Tensor, "b v"],
        located: Bool[Tensor, " w"],
        k: int,
    ) -> tuple[float, Float[Tensor, "4"]]:
        """Where plane k makes the errors fall most clearly if its phases count, and by how many
        standard errors.
        """
        sequences = self.sequences(planes)
        phased = self.phased(sequences, located)
        known, before, waves = phased & ~(sequences == k).any(1), [], []
        for receiver, own in self.each(passing):
            fields, _, lengths = paths = receiver.paths(planes, sequences, own)
            before.append(self.received(paths, phased))
            slopes = receiver.slopes(before[-1])[:, 0]
            waves.append(((slopes * fields * known * own[:, k + 1, None])[..., None], lengths))
        peaks = [
            peak
            for normal in square_normals(planes[:, :3], k)
            for peak in self.peaks(waves, normal, planes[k])
        ]
        peaks.sort(key=lambda peak: -peak.score)
        phased, found = (
            self.phased(sequences, located.index_fill(0, torch.tensor(k), True)),
            [(0.0, planes[k])],
        )
        for peak in peaks[:TRIED]:
            moved, gains = torch.cat((planes[:k], peak.plane[None], planes[k + 1 :])), []
            for (receiver, own), old in zip(self.each(passing), before, strict=True):
                new = self.received(receiver.paths(moved, sequences, own), phased)
                # Half of the interference: errors then follow its phase more than its strength,
                # which is uncertain.
                gains.append(receiver.errors(old) - receiver.errors((old + new) / 2))
            mean, deviation = (part.item() for part in reversed(torch.std_mean(torch.cat(gains))))
            found.append((mean / max(deviation, 1e-12) * math.sqrt(len(passing)), peak.plane))
        return max(found, key=lambda trial: trial[0])

    def phased(
        self, sequences: Int[Tensor, "n order"], located: Bool[Tensor, " w"]
    ) -> Bool[Tensor, " n"]:
        """True for paths whose planes are all located."""
        return torch.cat((located, located.new_ones(1)))[sequences].all(1)  # -1 is the last one

    def received(
        self, paths: tuple[Tensor, Tensor, Tensor], phased: Bool[Tensor, " n"]
    ) -> Complex[Tensor, "b 1"]:
        """Powers of paths, of which some interfere."""
        fields, _, lengths = paths
        waves, ways = fields[:, phased], lengths[:, phased]
        likeness = sinc(self.bandwidth / speed_of_light * (ways[:, :, None] - ways[:, None]))
        powers = (fields[:, ~phased].abs().square()).sum(1) + (
            (likeness * waves[:, None]).sum(2) * waves.conj()
        ).sum(1)
        return powers[:, None]
