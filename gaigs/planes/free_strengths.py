"""The score of planes by free strengths, complex numbers fitted for each path at each place."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.planes.channel_links import ChannelData, ReceiverChannels
from gaigs.planes.search import Candidate, GridRatings, Score, descend
from gaigs.planes.strengths import fit_free, log_share


class FreeRoom(NamedTuple):
    """Planes, and how well their paths explain channels with free strengths at each place."""

    planes: Float[Tensor, "w 4"]  # planes in the frame
    error: float  # mean over links of the log of the share of power that remains
    share: float = 0.0  # share of power that the last added plane explains, its rating


class FreeScore(Score[FreeRoom]):
    """Score of planes by the power of their images, with a free strength of each path and place.

    Strengths are complex, so neither phases nor blockage are assumed. The rating of a candidate is
    the fraction of the channels' power that its image explains in the residual, averaged over
    places and receivers. This is a Hough transform over normals and offsets. Planes are refined by
    variable projection: each step solves for the strengths.

    Attributes:
        links: At most 200 random training links, for errors and ratings.
        numbers: Number of independent values in a channel, which band and array limit.

    Source: Golub and Pereyra, The differentiation of pseudo-inverses and nonlinear least squares
    problems whose variables separate, 1973.
    """

    def __init__(self, data: ChannelData):
        self.data = data
        # Values of a delay profile: elements times delays.
        size = max(
            receiver.channels.shape[1] * self._count_delays(receiver) for receiver in data.receivers
        )
        longest = max(receiver.flat.shape[1] for receiver in data.receivers)
        # Delays are an eighth of the resolution apart, over four diagonals: 1 / 32 of them are
        # resolved within one diagonal.
        self.numbers = min(size / 32, longest)
        # Profiles of a gigabyte at most, also in a hall with a large band.
        self.links = data.draw(min(200, 60_000_000 // size))

    def evaluate(self, planes: Float[Tensor, "w 4"], share: float = 0.0) -> FreeRoom:
        """A room with its error; ``share`` is the rating of its last plane."""
        shares = []
        for receiver in self.links:
            residual = self.data.fit_free(receiver, planes).residual
            shares.append(log_share(residual, receiver.flat))
        return FreeRoom(planes, torch.cat(shares).mean().item(), share)

    def error(self, room: FreeRoom) -> float:
        return room.error

    def rate(self, room: FreeRoom, grid: Float[Tensor, "n k 4"]) -> GridRatings:
        profiles = [
            self.compute_profile(receiver, self.data.fit_free(receiver, room.planes).residual)
            for receiver in self.links
        ]
        # The grid is rated by every third place, candidates near its maxima by all.
        thinned = [receiver.at(slice(None, None, 3)) for receiver in self.links]
        rough = self.rate_lines(thinned, [profile[::3] for profile in profiles], grid)

        def rate(planes: Float[Tensor, "c 4"]) -> Float[Tensor, " c"]:
            return self.rate_lines(self.links, profiles, planes[:, None])[:, 0]

        return GridRatings(rough, rate)

    def add(self, room: FreeRoom, candidate: Candidate) -> FreeRoom | None:
        """The room with the candidate; None if it explains too little.

        A plane that explains ``certain_share`` is added. A plane that explains ``faint_share``, and
        more than chance does, is added if the error falls by ``certain_fall``.
        """
        options = self.data.options
        # The room leaves a share exp(error) of the power. If that is noise, one wave explains
        # 1 / numbers of it, and the best of a grid up to 5 standard errors more.
        places = sum(len(receiver.places) for receiver in self.links)
        numbers = min(receiver.flat.shape[1] for receiver in self.links)
        by_chance = math.exp(room.error) * (1 + 5 / math.sqrt(places)) / numbers
        if candidate.rating < max(options.faint_share, by_chance):
            return None
        planes = torch.cat((room.planes, candidate.plane[None]))
        larger = self.evaluate(self.descend(planes, steps=30, rate=1e-2), candidate.rating)
        is_certain = candidate.rating >= options.certain_share
        if is_certain or room.error - larger.error >= options.certain_fall:
            return larger
        return None

    def remove(self, room: FreeRoom, number: int) -> FreeRoom:
        return self.evaluate(torch.cat((room.planes[:number], room.planes[number + 1 :])))

    def refine(self, room: FreeRoom) -> FreeRoom:
        return self.evaluate(self.descend(room.planes, steps=60, rate=1e-2), room.share)

    def descend(
        self, planes: Float[Tensor, "w 4"], steps: int, rate: float
    ) -> Float[Tensor, "w 4"]:
        """Planes after gradient descent at random links.

        ``steps`` and ``rate`` [m] are as for ``search.descend``.
        """
        sequences = self.data.sequences(planes)

        def loss(planes: Float[Tensor, "w 4"]) -> Float[Tensor, ""]:
            shares = []
            for receiver in self.data.draw(24, 8):  # places, subcarriers
                receiver = receiver.single()
                points = receiver.images(planes.to(receiver.places), sequences)
                waves = receiver.waves(points)
                residual = fit_free(waves, receiver.flat, self.data.options.ridge).residual
                shares.append(log_share(residual, receiver.flat))
            return torch.cat(shares).mean()

        return descend(loss, self.data.receivers, planes, [], steps, rate)[0]

    def compute_profile(
        self, receiver: ReceiverChannels, residual: Complex[Tensor, "b k"]
    ) -> Float[Tensor, "b e t 2"]:
        """Delay profiles of a residual at e elements and t delays, over the norm of the channel.

        With a profile the rating of a plane needs one look-up for each element, in place of a sum
        over subcarriers. Profiles are without the phase of the carrier. The last dimension has the
        real and the imaginary part.
        """
        residual = residual / (
            receiver.flat.norm(dim=1, keepdim=True) * math.sqrt(residual.shape[1])
        )
        centre = float(receiver.frequencies.mean())
        longest = 4 * self.data.frame.diagonal / speed_of_light  # [s]
        delays = torch.linspace(0, longest, self._count_delays(receiver)).double()
        turns = 2 * math.pi * torch.outer(receiver.frequencies - centre, delays)  # (s, t)
        residual = residual.unflatten(1, (len(receiver.elements), -1))  # (b, e, s)
        profile = residual @ torch.polar(torch.ones_like(turns), turns)  # (b, e, t)
        # Single precision suffices: a hundredth of a radian at 10 GHz, after a path of 30 m.
        return torch.view_as_real(profile.to(torch.complex64))

    def _count_delays(self, receiver: ReceiverChannels) -> int:
        """Number of delays over four diagonals of the room, an eighth of the resolution apart."""
        band = float(receiver.frequencies.max() - receiver.frequencies.min())
        return 2 + math.ceil(8 * band * 4 * self.data.frame.diagonal / speed_of_light)

    def rate_lines(
        self,
        receivers: list[ReceiverChannels],
        profiles: list[Float[Tensor, "_ _ t 2"]],
        lines: Float[Tensor, "n k 4"],
    ) -> Float[Tensor, "n k"]:
        """Mean share of power that one more image in each plane explains.

        It is 0 for a plane between transmitter and receiver.

        Args:
            receivers: Places and elements of each receiver.
            profiles: Delay profiles of its residuals, see ``compute_profile``.
            lines: Planes to rate: n normals, each with k offsets.
        """
        total = lines.new_zeros(lines.shape[:2])
        for receiver, profile in zip(receivers, profiles, strict=True):
            table = _ProfileTable(receiver, profile, 4 * self.data.frame.diagonal)
            for number, line in enumerate(lines):
                normal, offsets = line[0, :3], line[:, 3]
                heights = (receiver.places @ normal)[:, None] - offsets  # (b, k)
                # Only a plane with both ends of the link on one side reflects.
                is_beside = heights * (receiver.position @ normal - offsets) > 0
                total[number] += (table.image_powers(normal, heights) * is_beside).sum(0)
        return total / sum(len(receiver.places) for receiver in receivers)


class _ProfileTable:
    """Table of a receiver's delay profiles (b, e, t, 2), with interpolation between delays.

    The table ends at the path length ``longest`` [m].
    """

    def __init__(
        self, receiver: ReceiverChannels, profile: Float[Tensor, "b e t 2"], longest: float
    ):
        self.count = profile.shape[2]
        self.rate = (self.count - 1) * speed_of_light / longest  # entries for each second of delay
        self.carrier = float(receiver.frequencies.mean())
        rows = torch.arange(profile.shape[0] * profile.shape[1]).view(profile.shape[:2])
        self.first = rows[:, None] * self.count  # (b, 1, e), row of ``values`` at delay 0
        self.values = profile.flatten(0, 2)  # (b e t, 2)
        self.places = (receiver.places - receiver.position).float()
        self.elements = (receiver.elements - receiver.position).float()

    def image_powers(
        self, normal: Float[Tensor, "3"], heights: Float[Tensor, "b k"]
    ) -> Float[Tensor, "b k"]:
        """Power of a beam towards the image in each of k planes, at b places.

        Profiles are summed over elements, in phase with the image's wave. The planes share
        ``normal``. ``heights`` are the signed distances of places from planes [m].
        """
        moves = 2 * heights[..., None].float() * normal.float()
        points = self.places[:, None] - moves  # (b, k, 3)
        # |p - e|² = |p|² - 2 p . e + |e|², without a tensor of all differences.
        squares = points.square().sum(-1, keepdim=True)  # (b, k, 1)
        squares = squares - 2 * points @ self.elements.T + self.elements.square().sum(1)
        delays = squares.clamp_min_(0).sqrt_().div_(speed_of_light)  # (b, k, e)
        # The profile at these delays, by linear interpolation.
        position = (delays * self.rate).clamp_max_(self.count - 1.001)
        before = position.long()
        part = (position - before)[..., None]
        before += self.first
        near = torch.lerp(self.values[before], self.values[before + 1], part)  # (b, k, e, 2)
        real, imaginary = near.unbind(-1)
        # Carrier phases exp(j 2 pi f t) bring the elements' parts in phase.
        turns = (delays * self.carrier).frac_().mul_(2 * math.pi)
        cos, sin = turns.cos(), turns.sin()
        total_real = (real * cos - imaginary * sin).sum(-1)
        total_imaginary = (real * sin + imaginary * cos).sum(-1)
        return total_real.square() + total_imaginary.square()
