"""The score of planes by channels: real strengths of slabs, predicted from neighbouring places."""

import math
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from gaigs.core.query import evenly
from gaigs.planes.channel_links import SLABS, ChannelData, ChannelSample, ReceiverChannels, SlabRoom
from gaigs.planes.phase_proposals import propose_by_phases
from gaigs.planes.search import GridRatings, Score, descend
from gaigs.planes.strengths import align_phases, log_share, real_residual, real_strengths, ridged


class NeighbourLinks(NamedTuple):
    """Channels of one receiver: predicted places, and the neighbours that predict each."""

    receiver: ReceiverChannels  # channels of targets and neighbours
    targets: Int[Tensor, " t"]  # rows of the predicted places
    near: Int[Tensor, "t k"]  # rows of their nearest places
    # True for neighbours a wavelength away or farther: closer ones share the interference of all
    # paths.
    counts: Bool[Tensor, "t k"]


class ChannelScore(Score[SlabRoom]):
    """Score of planes by the phases of reflections at slabs, with real, non-negative strengths.

    The strengths of a true plane vary little from place to place, so channels are predicted with
    the strengths of the nearest places. The error of a room is the mean log of the unexplained
    fraction of power, plus a price for each plane. A false plane that explains one place by chance
    fails at the next.

    Args:
        data: Training channels.
        has_free_strengths: True if channels have enough numbers for complex strengths in ratings.

    Source: Stone, Cross-validatory choice and assessment of statistical predictions, 1974.
    """

    def __init__(self, data: ChannelData, has_free_strengths: bool):
        self.data = data
        self.options = data.options
        self.has_free_strengths = has_free_strengths

    def error(self, room: SlabRoom) -> float:
        sequences = self.data.sequences(room.planes)
        log_shares = []
        receivers = [links.receiver for links in self.neighbours]
        phases = self.data.reference_phases(room.planes, receivers)
        for links, phase in zip(self.neighbours, phases, strict=True):
            log_shares.append(self._neighbour_errors(links, phase, room, sequences))
        return torch.cat(log_shares).mean().item() + self.options.price * len(room.planes)

    def _neighbour_errors(
        self,
        links: NeighbourLinks,
        phase: Complex[Tensor, " c"],
        room: SlabRoom,
        sequences: Int[Tensor, "n order"],
    ) -> Float[Tensor, " t"]:
        """Log of the fraction of each predicted place's power that neighbours do not explain."""
        receiver = links.receiver.at(slice(None), links.receiver.few_subcarriers).single()
        channels = receiver.flat * phase[:, None].conj().to(receiver.flat)  # (b, k)
        power = receiver.flat.abs().square().sum(1)[:, None, None]  # (b, 1, 1)
        waves = receiver.reflected(room, sequences)  # (b, n, k)
        # Normal equations of each place over its power; summed over a target's neighbours. A place
        # without power at these subcarriers has weight 0.
        weights = torch.where(power > 0, 1 / power, 0)
        counts = links.counts[..., None, None]
        gram = weights * (waves.conj() @ waves.mT).real  # (b, n, n)
        gram = (counts * gram[links.near]).sum(1)  # (t, n, n)
        right = weights * (waves.conj() @ channels[..., None]).real  # (b, n, 1)
        right = (counts * right[links.near]).sum(1)  # (t, n, 1)
        strengths = real_strengths(ridged(gram, self.options.ridge), right)  # (t, n, 1)
        predicted = (strengths.mT.to(waves) @ waves[links.targets])[:, 0]  # (t, k)
        predicted = predicted * (power[links.targets, 0] > 0)  # without power there is no error
        channels = channels[links.targets]
        if not self.data.has_common_phase:
            channels = align_phases(channels, predicted)
        return log_share(channels - predicted, channels)

    @cached_property
    def neighbours(self) -> list[NeighbourLinks]:
        """Each receiver's predicted places, evenly thinned, and the places that predict them."""
        neighbours = []
        most = max(8, self.options.predicted // len(self.data.receivers))
        for links in self.data.receivers:
            receiver = links.of_unique_places()
            targets = evenly(torch.arange(len(receiver.places)), most)
            gaps = torch.cdist(receiver.places[targets], receiver.places)  # [m]
            gaps[gaps < self.data.wavelength] = math.inf  # see ``NeighbourLinks.counts``
            count = min(self.options.neighbours, gaps.shape[1])
            gaps, near = gaps.topk(count, largest=False)  # (t, k)
            # Only rows in use stay, so their numbers change.
            rows = torch.cat((targets, near.flatten())).unique()
            neighbours.append(
                NeighbourLinks(
                    receiver=receiver.at(rows),
                    targets=torch.searchsorted(rows, targets),
                    near=torch.searchsorted(rows, near),
                    counts=gaps.isfinite(),
                )
            )
        return neighbours

    def remove(self, room: SlabRoom, number: int) -> SlabRoom:
        others = torch.arange(len(room.planes)) != number
        return SlabRoom(room.planes[others], room.slabs[others])

    def refine(self, room: SlabRoom) -> SlabRoom:
        return self.polish(room, steps=60, rate=3e-4)

    def move(self, room: SlabRoom, number: int) -> SlabRoom:
        return self._best_moves(room, number)[0]

    def move_and_polish(self, room: SlabRoom, number: int) -> SlabRoom:
        """The best of six rooms: the three best moves of a plane, with and without a descent.

        The descent also fits the slab, since a wrong slab may hide the best offset.
        """
        moved = self._best_moves(room, number)
        polished = [self.polish(trial, steps=12, rate=5e-4, only=number) for trial in moved]
        return self.choose_best(moved + polished)[0]

    def _best_moves(self, room: SlabRoom, number: int) -> list[SlabRoom]:
        """The best three of a room and its variants, in which a plane moves to where phases agree.

        The best comes first.
        """
        trials = [room]
        tilt = 0.006  # [rad]
        variants = propose_by_phases(self.data, room.planes, number, self.data.reach, tilt, SLABS)
        for plane, material in variants:
            trials.append(room.replace_plane(number, plane, material))
        return self.choose_best(trials)

    # --- residuals ---

    def choose_best(self, rooms: list[SlabRoom]) -> list[SlabRoom]:
        """At most three rooms of the smallest ``measure``, best first.

        A third of the places chooses the three; all places sort them.
        """
        if not rooms:
            return []
        sample = self.data.sample(rooms[0].planes)
        if len(rooms) > 3:
            thinned = sample.every(3)
            rooms = sorted(rooms, key=lambda room: self.measure(thinned, room).item())[:3]
        return sorted(rooms, key=lambda room: self.measure(sample, room).item())

    def measure(
        self, sample: ChannelSample, room: SlabRoom, resolved: Bool[Tensor, " w"] | bool = True
    ) -> Float[Tensor, ""]:
        """Mean log of the fraction of power that real strengths do not explain.

        ``resolved`` is True for planes whose offset is known to a fraction of the wavelength. Paths
        at other planes have complex strengths, since their phases are still unknown.
        """
        shares = []
        residuals = self.residuals(sample, room, resolved)
        for receiver, residual in zip(sample.receivers, residuals, strict=True):
            shares.append(log_share(residual, receiver.flat))
        return torch.cat(shares).mean()

    def residuals(
        self, sample: ChannelSample, room: SlabRoom, resolved: Bool[Tensor, " w"] | bool = True
    ) -> list[Complex[Tensor, "b k"]]:
        """Residuals of each receiver's channels, with strengths as in ``measure``."""
        sequences = self.data.sequences(room.planes)
        resolved = torch.as_tensor(resolved).expand(len(room.planes))
        is_free = torch.isin(sequences, (~resolved).nonzero()).any(1)
        # A complex strength is two signed real ones, of the wave and of one a quarter turn ahead.
        signed = torch.cat((is_free, is_free[is_free]))
        residuals = []
        for receiver, phase in zip(sample.receivers, sample.phases, strict=True):
            channels = receiver.flat * phase[:, None].conj().to(receiver.flat)
            waves = receiver.reflected(room, sequences)
            waves = torch.cat((waves, 1j * waves[:, is_free]), 1)
            residual = real_residual(waves, channels, signed, self.options.ridge)
            if not self.data.has_common_phase:
                # Once more, with each place's channel turned to the phase of the fit.
                channels = align_phases(channels, channels - residual)
                residual = real_residual(waves, channels, signed, self.options.ridge)
            residuals.append(residual)
        return residuals

    def polish(self, room: SlabRoom, steps: int, rate: float, only: int | None = None) -> SlabRoom:
        """The room after gradient descent on ``measure`` with all planes, or with plane ``only``.

        ``steps`` and ``rate`` [m] are as for ``search.descend``.
        """
        is_moved = torch.ones(len(room.planes), dtype=torch.bool)
        if only is not None:
            is_moved = torch.arange(len(room.planes)) == only
        is_moved = is_moved[:, None]  # (w, 1)
        receivers = self.data.receivers
        references = self.data.reference_phases(room.planes, receivers)
        generator = self.data.frame.generator

        def loss(planes: Float[Tensor, "w 4"], slabs: Float[Tensor, "w 3"]) -> Float[Tensor, ""]:
            trial = SlabRoom(
                torch.where(is_moved, planes, room.planes),
                torch.where(is_moved, slabs, room.slabs),
            )
            parts = []
            phases = []
            for receiver, phase in zip(receivers, references, strict=True):
                # Each step has other links and subcarriers: a stochastic gradient.
                count = max(4, 40 // len(receivers))
                places = torch.randperm(len(receiver.places), generator=generator)[:count]
                carriers = torch.randperm(len(receiver.frequencies), generator=generator)[:6]
                parts.append(receiver.at(places, carriers).single())
                phases.append(phase if len(phase) == 1 else phase[places])
            return self.measure(ChannelSample(parts, phases), trial)

        planes, slabs = descend(loss, receivers, room.planes, [room.slabs], steps, rate)
        return SlabRoom(
            torch.where(is_moved, planes, room.planes), torch.where(is_moved, slabs, room.slabs)
        )

    # --- ratings ---

    def rate(self, room: SlabRoom, grid: Float[Tensor, "n k 4"]) -> GridRatings:
        ratings = self.added_shares(room, grid.flatten(0, 1)).view(grid.shape[:2])
        return GridRatings(ratings, lambda planes: self.added_shares(room, planes))

    def added_shares(self, room: SlabRoom, planes: Float[Tensor, "k 4"]) -> Float[Tensor, " k"]:
        """Rating of candidate planes: mean fraction of the residual's power that each explains.

        The residual is the part of a channel that known paths do not explain. A candidate explains
        it by the wave of the transmitter's image. The part that known paths explain is removed from
        this wave, too. Otherwise the image in a wall behind the array, which resembles the direct
        path, would be underrated. The fraction, 0 to 1, is 0 for a plane between transmitter and
        receiver.
        """
        total = planes.new_zeros(len(planes))
        count = 0
        sample = self.data.sample(room.planes)
        for receiver, phase in zip(*sample, strict=True):
            known = receiver.reflected(room, self.data.sequences(room.planes))  # (b, n, k)
            # A real strength is half a complex unknown.
            unknowns = known.shape[1] if self.has_free_strengths else known.shape[1] / 2
            if unknowns >= known.shape[2]:  # known paths explain any channel
                continue
            gram = self._fitted_part(known.conj() @ known.mT)  # (b, n, n)
            # Rows of the pseudo-inverse: their product with a wave gives its strengths.
            inverse = torch.linalg.solve(ridged(gram, self.options.ridge), known.conj())
            channels = (receiver.flat * phase[:, None].conj().to(receiver.flat))[..., None]
            residual = channels - known.mT @ self._fitted_part(inverse @ channels)  # (b, k, 1)
            count += len(residual)
            for rows in torch.arange(len(planes)).split(64):
                total[rows] += self._added_of_receiver(
                    receiver, known, inverse, residual, planes[rows]
                )
        return total / max(count, 1)

    def _fitted_part(self, values: Tensor) -> Tensor:
        """``values`` if strengths are free (complex), otherwise their real part.

        With free strengths any plane would explain channels with few values.
        """
        return values if self.has_free_strengths else values.real.to(values)

    def _added_of_receiver(
        self,
        receiver: ReceiverChannels,
        known: Complex[Tensor, "b n k"],
        inverse: Complex[Tensor, "b n k"],
        residual: Complex[Tensor, "b k 1"],
        planes: Float[Tensor, "c 4"],
    ) -> Float[Tensor, " c"]:
        """Fractions as in ``added_shares``, summed over the places of one receiver.

        Args:
            receiver: Places and elements.
            known: Waves of the known paths.
            inverse: Pseudo-inverse of ``known``: its product with a wave is the least-squares
                strengths of the known waves.
            residual: Residual of the known paths.
            planes: Candidates.
        """
        power = residual.abs().square().sum((1, 2)).clamp_min(torch.finfo(torch.float32).tiny)
        normals, offsets = planes[:, :3].float(), planes[:, 3].float()
        heights = receiver.places @ normals.mT - offsets  # (b, c)
        images = receiver.places[:, None] - 2 * heights[..., None] * normals  # (b, c, 3)
        waves = receiver.waves(images)  # (b, c, k)
        wave_power = waves.abs().square().sum(2)  # (b, c)
        strengths = (inverse @ waves.mT).mT  # of the known waves in ``waves`` (b, c, n)
        # The image's own phase is unknown: its wave and the one a quarter of a turn ahead, each
        # without the part that known waves explain.
        ahead = waves - self._fitted_part(strengths) @ known
        aside = 1j * waves - self._fitted_part(1j * strengths) @ known
        # Least squares of the two waves explain the power
        # (bb a² - 2 ab a b + aa b²) / (aa bb - ab²) of the residual, with their products aa, ab and
        # bb, and their products a and b with the residual.
        aa = ahead.abs().square().sum(2) + self.options.ridge * wave_power
        bb = aside.abs().square().sum(2) + self.options.ridge * wave_power
        ab = (ahead.conj() * aside).real.sum(2)
        a = (ahead.conj() @ residual)[..., 0].real
        b = (aside.conj() @ residual)[..., 0].real
        numerator = bb * a.square() - 2 * ab * a * b + aa * b.square()
        share = numerator / (aa * bb - ab.square()) / power[:, None]
        is_same_side = heights * (normals @ receiver.position - offsets) > 0  # as the receiver
        return (share * is_same_side).sum(0)
