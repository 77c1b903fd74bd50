"""The score of planes by spectra, from covariances of the array's elements."""

import copy
import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

from gaigs.planes.frame import RoomFrame
from gaigs.planes.lags import FurtherWave, ReceiverLags
from gaigs.planes.periodogram import PlanePeriodogram
from gaigs.planes.search import Candidate, GridRatings, Score, descend
from gaigs.splatting.placement.mirrored.reflections import all_sequences, square_normals


@dataclass(frozen=True)
class LagOptions:
    """Options of the search for planes in spectra."""

    certain: float = 2.0  # least fall of the mean error by which a plane moves [standard errors]
    # A path counts as blocked at a link whose log error falls by this when the path is left out.
    # Without this price, any plane explains some links.
    blocked: float = 0.1
    gain: float = 0.03  # least fall of the mean log error by a further plane
    faint: float = 1e-3  # share of the power below which paths of several reflections are left out
    # Bandwidths that are tried if it is unknown [speed of light over the diagonal]. They range from
    # a single carrier to a band in which hardly any two paths interfere.
    bands: tuple[float, ...] = (0.01, 1.0, 3.0, 10.0, 30.0, 100.0)
    # Largest share of a spectrum that its array cannot explain. With more, the search is left out.
    # Measured spectra have 0.001; spectra of powers in place of amplitudes have 0.05.
    strange: float = 0.01
    # Largest distance of a plane from all transmitters and receivers [diagonals].
    margin: float = 0.15
    pairs: int = 16  # largest number of pairs of a receiver and a carrier; each costs a periodogram


class LagRoom(NamedTuple):
    """Planes of the room, and the paths that are open (not blocked) at each link."""

    planes: Float[Tensor, "w 4"]  # normals and offsets [m]
    # True where paths are open at a link: column 0 the direct path, then all paths at each plane
    # (b, w + 1).
    open: Bool[Tensor, "b v"]
    # Error of each link. If the last moved plane is blocked there, this is the error without the
    # plane, plus ``LagOptions.blocked``.
    errors: Float[Tensor, " b"]

    def opened(self, column: int, value: Bool[Tensor, " b"] | bool) -> Bool[Tensor, "b v"]:
        """``open`` with one column replaced."""
        changed = self.open.clone()
        changed[:, column] = value
        return changed


class LinkPaths:
    """Links of all receivers, with functions of their direct and reflected paths.

    Attributes:
        bandwidth: Band over which powers are averaged [Hz]; 0 for one carrier. Searches set it.
    """

    def __init__(
        self,
        frame: RoomFrame,
        receivers: list[ReceiverLags],
        wavelength: float,
        order: int,
        faint: float,
    ):
        self.receivers = receivers
        self.periodogram = PlanePeriodogram(receivers, wavelength, frame.diagonal)
        self.order = min(order, 2)  # longer paths hardly locate a plane
        self.faint = faint
        self.bandwidth = 0.0

    def with_receivers(self, receivers: list[ReceiverLags]) -> "LinkPaths":
        """A copy with other labels of the same receivers."""
        other = copy.copy(self)
        other.receivers = receivers
        return other

    def split(self, passing: Tensor) -> list[tuple[ReceiverLags, Tensor]]:
        """Each receiver with the rows of ``passing`` (b, v) for its links."""
        parts = passing.split([len(receiver.places) for receiver in self.receivers])
        return list(zip(self.receivers, parts, strict=True))

    def sequences(self, planes: Float[Tensor, "w 4"]) -> Int[Tensor, "n order"]:
        """Sequences of planes; those of several reflections only if their power is not faint."""
        sequences = all_sequences(len(planes), self.order)
        powers = self.powers(planes, sequences)
        is_short = (sequences >= 0).sum(1) <= 1
        return sequences[is_short | (powers > self.faint * powers.sum())]

    def powers(
        self, planes: Float[Tensor, "w 4"], sequences: Int[Tensor, "n order"]
    ) -> Float[Tensor, " n"]:
        """Mean power of each path over every fourth link."""
        powers = []
        for receiver in self.receivers:
            thinned = receiver.at(slice(None, None, 4))
            powers.append(thinned.paths(planes, sequences).fields.abs().square())
        return torch.cat(powers).mean(0)

    def sort_by_strength(self, planes: Float[Tensor, "w 4"]) -> list[int]:
        """Numbers of planes, the strongest single reflection first."""
        singles = all_sequences(len(planes), 1)[1:]
        return self.powers(planes, singles).argsort(descending=True).tolist()


class LagScore(Score[LagRoom]):
    """Score of planes by the spectra of an array, with one material and without obstacles.

    Covariances of the array's elements follow from a spectrum (``Beamformer.lags``), so predicted
    covariances are compared with measured spectra. At each link the paths at a plane may be
    blocked, at a price. A plane moves to a maximum of ``PlanePeriodogram``; the error decides
    between the maxima. Further planes are rated only by their power, without phases.

    Source: ours; Van Trees, Optimum Array Processing, 2002, section 2.4, for the covariances.
    """

    def __init__(self, paths: LinkPaths, options: LagOptions):
        self.paths = paths
        self.options = options

    def error(self, room: LagRoom) -> float:
        return room.errors.mean().item()

    def errors(
        self,
        planes: Float[Tensor, "w 4"],
        open_: Bool[Tensor, "b v"],
        sequences: Int[Tensor, "n order"] | None = None,
        every: int = 1,
    ) -> Float[Tensor, " c"]:
        """Log of the fraction of each spectrum that paths do not explain.

        Only every ``every``-th link is used. Logarithms limit the weight of single links in a mean.
        ``open_`` is as in ``LagRoom``.
        """
        sequences = self.paths.sequences(planes) if sequences is None else sequences
        logs = []
        for receiver, passing in self.paths.split(open_):
            part = receiver.at(slice(None, None, every))
            paths = part.paths(planes, sequences, passing[::every])
            logs.append(part.errors(part.covariances(paths, self.paths.bandwidth)))
        return torch.cat(logs)

    # --- moves ---

    def move(self, room: LagRoom, number: int) -> LagRoom:
        """The room with plane ``number`` moved to a peak of its periodogram.

        The peak with the lowest error is taken, over all normals of ``square_normals``. The plane
        stays if no peak is significantly better. Its paths are open at links whose error they
        lower.
        """
        # The wave that paths at the other planes lack, and the errors without this plane.
        is_other = torch.arange(len(room.planes)) != number
        others = room.planes[is_other]
        columns = torch.cat((is_other.new_ones(1), is_other))  # the direct path, other planes
        open_ = room.open[:, columns]
        sequences = self.paths.sequences(others)
        waves = self._further_waves(others, open_, sequences)
        blocked = self.errors(others, open_, sequences) + self.options.blocked  # (b,)
        trials = [room.planes]
        before, after = room.planes[:number], room.planes[number + 1 :]
        for normal in square_normals(room.planes[:, :3], number):
            peaks = self.paths.periodogram.find_peaks(
                waves, self.paths.bandwidth, normal, room.planes[number]
            )
            for peak in peaks:
                trials.append(torch.cat((before, peak.plane[None], after)))
        everywhere = room.opened(number + 1, True)
        sequences = self.paths.sequences(room.planes)
        errors = torch.stack([self.errors(trial, everywhere, sequences) for trial in trials])
        # Each link takes the better of an open and a blocked plane.
        least = torch.minimum(errors, blocked)  # (trials, b)
        best = int(least.mean(1).argmin())
        if not self._is_certain(least[0] - least[best]):
            best = 0  # the plane stays
        open_ = room.opened(number + 1, errors[best] < blocked)
        return LagRoom(trials[best], open_, least[best])

    def _further_waves(
        self,
        planes: Float[Tensor, "w 4"],
        open_: Bool[Tensor, "b v"],
        sequences: Int[Tensor, "n order"],
    ) -> list[FurtherWave]:
        """For each receiver, the wave that must join the known paths to explain the spectra."""
        waves = []
        for receiver, passing in self.paths.split(open_):
            paths = receiver.paths(planes, sequences, passing)
            waves.append(receiver.further_wave(paths, self.paths.bandwidth))
        return waves

    def refine(self, room: LagRoom) -> LagRoom:
        """The room after gradient descent with all planes.

        First the direct path is blocked at links whose error it raises by more than
        ``LagOptions.blocked``. Then all planes descend. The moved planes are accepted only if the
        mean error falls by more than ``LagOptions.certain`` standard errors. ``errors`` are not
        updated.
        """
        with_direct = self.errors(room.planes, room.opened(0, True))
        without = self.errors(room.planes, room.opened(0, False))
        room = room._replace(open=room.opened(0, with_direct <= without + self.options.blocked))
        sequences = self.paths.sequences(room.planes)

        def loss(planes: Float[Tensor, "w 4"]) -> Float[Tensor, ""]:
            # Half the links take half the time; all of them judge the result below.
            return self.errors(planes, room.open, sequences, every=2).mean()

        (planes,) = descend(loss, self.paths.receivers, room.planes, others=[], steps=40, rate=3e-3)
        gains = self.errors(room.planes, room.open) - self.errors(planes, room.open)
        return room._replace(planes=planes) if self._is_certain(gains) else room

    def _is_certain(self, gains: Float[Tensor, " b"]) -> bool:
        """True if the mean gain of two links or more exceeds ``certain`` standard errors."""
        if len(gains) < 2:
            return False
        return bool(gains.mean() > self.options.certain * gains.std() / math.sqrt(len(gains)))

    # --- further planes ---

    def rate(self, room: LagRoom, grid: Float[Tensor, "n k 4"]) -> GridRatings:
        side = torch.linspace(-1, 1, 33)
        plane_waves = torch.cartesian_prod(side, side)  # sines of two angles (k, 2)
        maps = []
        sequences = self.paths.sequences(room.planes)
        for receiver, passing in self.paths.split(room.open):
            paths = receiver.paths(room.planes, sequences, passing)
            slopes = receiver.slopes(receiver.covariances(paths, self.paths.bandwidth))
            steering = receiver.steer(plane_waves)  # (k, e)
            # Fall of the error by the power of a further plane wave: s' M s, with the steering
            # vector s and M = ``slopes``.
            falls = ((steering.conj() @ slopes) * steering).sum(-1).real  # (b, k)
            maps.append(falls.view(-1, 1, 33, 33))

        def rate(planes: Float[Tensor, "c 4"]) -> Float[Tensor, " c"]:
            return self._rate_powers(maps, planes)

        flat = grid.flatten(0, 1)
        ratings = torch.cat([rate(part) for part in flat.split(4000)])
        return GridRatings(ratings.view(grid.shape[:2]), rate)

    def _rate_powers(
        self, maps: list[Float[Tensor, "b 1 k k"]], planes: Float[Tensor, "c 4"]
    ) -> Float[Tensor, " c"]:
        """Rating of each plane: fall of the errors by the power of its reflection.

        The fall is divided by the norm over links of this power, in which each link's power is
        relative to its direct path. ``maps`` have the fall of each link's error by a wave from each
        direction, on a grid of k x k sines.
        """
        fall_sum, square_sum = planes.new_zeros(2, len(planes))
        for receiver, falls in zip(self.paths.receivers, maps, strict=True):
            single = receiver.reflect_once(planes)
            powers = single.gains.abs().square()  # (b, c)
            # ``grid_sample`` takes the column first.
            sines = single.directions[..., [1, 0]][:, None]  # (b, 1, c, 2)
            sampled = functional.grid_sample(falls, sines, align_corners=True)[:, 0, 0]  # (b, c)
            fall_sum += (powers * sampled).sum(0)
            _, distances = receiver.look_at(receiver.places)  # the direct power is 1 / distance²
            relative = powers * distances.square()[:, None]
            square_sum += relative.square().sum(0)
        return fall_sum / square_sum.sqrt().clamp_min(1e-6)

    def add(self, room: LagRoom, candidate: Candidate) -> LagRoom | None:
        before = self.errors(room.planes, room.open)
        planes = torch.cat((room.planes, candidate.plane[None]))
        everywhere = torch.ones_like(room.open[:, :1])  # the new plane is open at all links
        larger = LagRoom(planes, torch.cat((room.open, everywhere), 1), before)
        larger = self.move(larger, len(room.planes))
        return larger if (before - larger.errors).mean() >= self.options.gain else None
