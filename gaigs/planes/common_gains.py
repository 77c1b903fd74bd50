"""Search for walls perpendicular to the coordinate axes, with one gain of a path for all places."""

from typing import NamedTuple

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from gaigs.planes.channel_links import ChannelData, ReceiverChannels, SlabRoom, half_spaces
from gaigs.planes.strengths import align_phases, real_strengths, ridged
from gaigs.splatting.placement.mirrored.reflections import all_sequences


class CommonFit(NamedTuple):
    """Mean fraction of power that common gains do not explain, and residuals of each receiver."""

    share: float
    residuals: list[Complex[Tensor, "b k"]]


class BestOffset(NamedTuple):
    """A plane at its best offset, and the fraction of power that its image explains there."""

    share: float
    plane: Float[Tensor, "4"]


class CommonGains:
    """Planes perpendicular to the coordinate axes, found one after the other by matching pursuit.

    Each image has one real gain, common to all places, as for a half-space. With a separate
    strength at each place any plane would explain channels with few values. A common gain explains
    hardly anything by chance, and determines offsets to millimetres.

    Args:
        data: Training channels.
        start: Known walls (w, 4).
        most: Largest number of planes.

    Source: Mallat and Zhang, Matching pursuits with time-frequency dictionaries, 1993.
    """

    def __init__(self, data: ChannelData, start: Float[Tensor, "w 4"], most: int):
        self.data = data
        self.start = start
        self.most = most

    def find_axis_walls(self) -> SlabRoom:
        """Half-spaces of the known walls and of further planes perpendicular to the axes.

        Known walls move along their normals if this explains more than chance does. The result is
        empty for a room so large in wavelengths that ``most_waves`` allows fewer than 50 places.
        """
        options = self.data.options
        frame = self.data.frame
        # Offsets on each axis, a tenth of a wavelength apart, over the box and its margin.
        extent = frame.points.amax(0) - frame.points.amin(0) + 2 * options.margin * frame.diagonal
        steps = 10 * extent / self.data.wavelength  # (3,)
        # Waves are offsets x places x elements x subcarriers; ``most_waves`` limits the places.
        elements = max(len(receiver.elements) for receiver in self.data.receivers)
        subcarriers = max(4, 32 // elements)
        max_places = min(200, options.most_waves // (int(steps.sum()) * elements * subcarriers))
        drawn = self.data.draw(max_places, subcarriers, 1)
        unique = [receiver.of_unique_places() for receiver in drawn]
        receivers = [receiver for receiver in unique if len(receiver.places)]
        if max_places < 50 or not receivers:
            return half_spaces(self.start[:0])
        axes = torch.eye(3).to(frame.points).split(1)
        lines = []  # candidates along each axis (offsets, 4)
        for axis, count in zip(axes, steps, strict=True):
            lines.append(frame.grid(axis, int(count), options.margin)[0])
        # Share of the residual that the best of all these planes explains by chance.
        by_chance = options.chance / sum(len(receiver.places) for receiver in receivers)
        planes = self._place_start(receivers, by_chance)
        planes = self._pursue(receivers, planes, torch.cat(lines), by_chance)
        # Each plane moves once more, as the others are known now. A known wall stays unless the
        # move explains more than by chance.
        for number in range(len(planes)):
            bonus = by_chance if number < len(self.start) else 0.0
            others = _without(planes, number)
            planes[number] = self.move(receivers, others, planes[number], bonus).plane
        planes = self.choose_lobes(receivers, planes, by_chance)
        return half_spaces(self._without_chance_planes(receivers, planes, by_chance))

    def _without_chance_planes(
        self, receivers: list[ReceiverChannels], planes: Float[Tensor, "w 4"], by_chance: float
    ) -> Float[Tensor, "v 4"]:
        """Known walls, and the further planes that lower the residual by more than chance does."""
        for number in reversed(range(len(self.start), len(planes))):
            others = _without(planes, number)
            share = self.fit(receivers, half_spaces(planes)).share
            if self.fit(receivers, half_spaces(others)).share < (1 + by_chance) * share:
                planes = others
        return planes

    def _place_start(
        self, receivers: list[ReceiverChannels], by_chance: float
    ) -> Float[Tensor, "w 4"]:
        """Known walls moved to where phases agree, by at most ``drawing_error``.

        Each round fixes the wall that explains most. The others are then fitted together with it.
        """
        planes = self.start.clone()
        waiting = list(range(len(self.start)))
        while waiting:
            placed = planes[[number for number in range(len(planes)) if number not in waiting]]
            trials = {}
            for number in waiting:
                trials[number] = self.move(receivers, placed, planes[number], by_chance)
            best = max(waiting, key=lambda number: trials[number].share)
            planes[best] = trials[best].plane
            waiting.remove(best)
        return planes

    def _pursue(
        self,
        receivers: list[ReceiverChannels],
        planes: Float[Tensor, "w 4"],
        lines: Float[Tensor, "c 4"],
        by_chance: float,
    ) -> Float[Tensor, "v 4"]:
        """The planes, and further ones chosen from ``lines`` by matching pursuit.

        Each choice is the plane that explains most of the residual. The pursuit ends when that is
        less than chance explains.
        """
        while len(planes) < self.most:
            known = self.fit(receivers, half_spaces(planes))
            shares = self.rate(receivers, known.residuals, lines)
            for plane in planes:
                shares[self.data.frame.is_like(lines, plane)] = 0
            if shares.max() < by_chance * known.share:
                break
            planes = torch.cat((planes, lines[shares.argmax(), None]))
        return planes

    def choose_lobes(
        self, receivers: list[ReceiverChannels], planes: Float[Tensor, "w 4"], by_chance: float
    ) -> Float[Tensor, "w 4"]:
        """The planes at the offsets with the smallest residual of paths of all orders.

        The fit as a function of an offset has a maximum (a lobe) every half wavelength, where a
        reflected path is longer by a whole wavelength. Known walls move at most ``drawing_error``,
        and only if that lowers the residual by more than chance does.
        """
        options = self.data.options
        order = self.data.order
        least = self.fit(receivers, half_spaces(planes), order).share
        for step in (1 / 16, 1 / 32, 1 / 64):
            for number in range(len(planes)):
                # Within the lobe, and to the neighbouring lobes half a wavelength apart.
                moves = self.data.wavelength * planes.new_tensor(
                    [-step, step, -0.5, 0.5, -1, 1, -1.5, 1.5]
                )
                is_known = number < len(self.start)
                if is_known:
                    gaps = planes[number, 3] + moves - self.start[number, 3]
                    moves = moves[gaps.abs() <= options.drawing_error]
                trials = planes.repeat(len(moves), 1, 1)
                trials[:, number, 3] += moves
                shares = [self.fit(receivers, half_spaces(trial), order).share for trial in trials]
                if shares and min(shares) < least * (1 - by_chance * is_known):
                    least = min(shares)
                    planes = trials[shares.index(least)]
        return planes

    def move(
        self,
        receivers: list[ReceiverChannels],
        others: Float[Tensor, "v 4"],
        plane: Float[Tensor, "4"],
        bonus: float,
    ) -> BestOffset:
        """The plane moved along its normal to where its image explains most of the power.

        It moves by at most ``drawing_error``.

        Args:
            receivers: Channels.
            others: Planes whose images are already in the fit.
            plane: The plane, at its present offset.
            bonus: Advantage of the present offset [fraction of the power unexplained by the
                others].
        """
        without_plane = self.fit(receivers, half_spaces(others))
        error = self.data.options.drawing_error
        grid = torch.arange(-error, error, self.data.wavelength / 16)
        moves = torch.cat((torch.zeros(1), grid)).to(plane)  # [m], first the present offset
        trials = plane.repeat(len(moves), 1)  # (moves, 4)
        trials[:, 3] += moves
        shares = self.rate(receivers, without_plane.residuals, trials)
        shares[0] += bonus * without_plane.share
        return BestOffset(shares.max().item(), trials[shares.argmax()])

    def fit(self, receivers: list[ReceiverChannels], room: SlabRoom, order: int = 1) -> CommonFit:
        """Fit of one real, non-negative gain for each path, common to all places.

        The fit is by least squares. Squared errors are divided by the power of their place, so all
        places have equal weight.
        """
        sequences = all_sequences(len(room.planes), order)
        waves = []
        channels = []
        powers = []
        phases = self.data.reference_phases(room.planes[:0], receivers)
        for receiver, phase in zip(receivers, phases, strict=True):
            waves.append(receiver.single().reflected(room, sequences))
            channels.append((receiver.flat * phase[:, None].conj()).to(torch.complex64))
            powers.append(receiver.flat.abs().square().sum(1).float()[:, None, None])
        residuals: list[Tensor] = []
        for _ in range(1 if self.data.has_common_phase else 3):
            # Normal equations, summed over all places.
            gram = torch.zeros(1, 1)
            right = torch.zeros(1, 1)
            for wave, channel, power in zip(waves, channels, powers, strict=True):
                gram = gram + ((wave.conj() @ wave.mT).real / power).sum(0, keepdim=True)
                products = (wave.conj() @ channel[..., None]).real / power  # (b, n, 1)
                right = right + products.sum(0, keepdim=True)
            # Gains need no sign, since the reflection coefficients in the waves have one.
            gains = real_strengths(ridged(gram, 1e-6), right).mT.to(waves[0])  # (1, 1, n)
            residuals = []
            for number, wave in enumerate(waves):
                fitted = (gains @ wave)[:, 0]  # (b, k)
                if not self.data.has_common_phase:
                    # Each place's channel is turned to the phase of its fit, for the next round.
                    channels[number] = align_phases(channels[number], fitted)
                residuals.append(channels[number] - fitted)
        shares = []
        for residual, power in zip(residuals, powers, strict=True):
            shares.append(residual.abs().square().sum(1) / power[:, 0, 0])
        return CommonFit(torch.cat(shares).mean().item(), residuals)

    def rate(
        self,
        receivers: list[ReceiverChannels],
        residuals: list[Complex[Tensor, "b k"]],
        line: Float[Tensor, "c 4"],
    ) -> Float[Tensor, " c"]:
        """Fraction of power that the image in each plane of ``line`` explains by a common gain.

        With the waves w of the image and the residuals r, the gain that is not negative explains
        max(0, sum w . r)² / sum |w|². The sums are over places, each with weight 1 / power.
        """
        products_sum, squares_sum = line.new_zeros(2, len(line))
        for receiver, residual in zip(receivers, residuals, strict=True):
            single = receiver.single()
            middle = receiver.frequencies.mean().float()[None]
            powers = receiver.flat.abs().square().sum(1, keepdim=True).float()
            for rows in torch.arange(len(line)).split(64):
                sequences = torch.arange(len(rows))[:, None]  # each plane alone
                waves = single.reflected(half_spaces(line[rows]), sequences, middle)
                products = (waves.conj() @ residual[..., None]).real[..., 0]  # (b, rows)
                products_sum[rows] += (products / powers).sum(0)
                squares = torch.view_as_real(waves).square().sum((2, 3))  # (b, rows)
                squares_sum[rows] += (squares / powers).sum(0)
        tiny = torch.finfo(line.dtype).tiny
        shares = products_sum.clamp_min(0).square() / squares_sum.clamp_min(tiny)
        return shares / sum(len(receiver.places) for receiver in receivers)


def _without(planes: Float[Tensor, "w 4"], number: int) -> Float[Tensor, "v 4"]:
    """All planes but one."""
    return torch.cat((planes[:number], planes[number + 1 :]))
