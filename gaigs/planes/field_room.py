"""Rooms that explain fields of few numbers a place: planes whose gains all places share."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import NamedTuple

import torch
from jaxtyping import Bool, Complex, Float, Int
from torch import Tensor

from gaigs.planes.channel_links import SLABS, ChannelData, SlabRoom
from gaigs.splatting.placement.mirrored.reflections import all_sequences


class FieldRoom(NamedTuple):
    """Planes in the frame, their slabs as in ``SLABS``, and gains over the slabs' reflections.

    A path's strength is the product of its planes' gains and the receiver's: a few planes explain
    many paths. Bands share the planes, but each has gains of its own, which stay 0 where a band
    does not use the plane.
    """

    planes: Float[Tensor, "w 4"]
    slabs: Float[Tensor, "w 3"]
    gains: Complex[Tensor, "bands w"]
    receivers: Complex[Tensor, " r"]
    uses: Bool[Tensor, "bands w"]

    def with_plane(
        self, plane: Float[Tensor, "4"], slab: Float[Tensor, "3"], uses: Bool[Tensor, " bands"]
    ) -> "FieldRoom":
        """The room with a plane behind the others, as yet without a gain."""
        return FieldRoom(
            torch.cat((self.planes, plane[None])),
            torch.cat((self.slabs, slab[None])),
            torch.cat((self.gains, self.gains.new_zeros(len(self.gains), 1)), 1),
            self.receivers,
            torch.cat((self.uses, uses[:, None]), 1),
        )

    def without_plane(self, number: int) -> "FieldRoom":
        """The room without one plane."""
        others = torch.arange(len(self.planes)) != number
        return FieldRoom(
            self.planes[others],
            self.slabs[others],
            self.gains[:, others],
            self.receivers,
            self.uses[:, others],
        )


Operator = Callable[[Tensor], Tensor]
"""A linear function of residuals (m, ...)."""


class Kriged(NamedTuple):
    """Residuals after kriging by path from the places near: whitened, or of places not known."""

    whiten: Operator
    unseen: Operator


class Variation(NamedTuple):
    """How strengths of paths vary over places: a Gaussian process for each path.

    Attributes:
        share: Standard deviation of a path's field over its mean.
        length: Distance at which the kernel falls to 1 / e [m].
        noise: Standard deviation of the rest over the mean field.
    """

    share: float
    length: float
    noise: float

    @classmethod
    def choices(cls) -> list["Variation"]:
        """Variations that are tried: none, then shadows as wide as furniture or as half a room."""
        tried = [cls(0.0, 1.0, 1.0)]
        for share in (0.2, 0.5):
            for length in (0.5, 2.0):
                tried += [cls(share, length, 0.1), cls(share, length, 0.3)]
        return tried


class GainChanges(NamedTuple):
    """Products of the gains of each path (n,), and their derivatives by each gain (n, w)."""

    products: Complex[Tensor, " n"]
    derivatives: Complex[Tensor, "n w"]


def multiply_gains(gains: Complex[Tensor, " w"], sequences: Int[Tensor, "n order"]) -> GainChanges:
    """Products of plane gains over the planes of each sequence."""
    n, order = sequences.shape
    factors = torch.cat((gains, gains.new_ones(1)))[sequences]  # (n, order); 1 for no plane
    derivatives = gains.new_zeros(n, len(gains) + 1)
    for column in range(order):
        others = torch.arange(order) != column
        derivatives.scatter_add_(
            1, sequences[:, column, None] % (len(gains) + 1), factors[:, others].prod(1)[:, None]
        )
    return GainChanges(factors.prod(1), derivatives[:, : len(gains)])


class PlaceBlock(NamedTuple):
    """Channel values of neighbouring places at one receiver, whose residuals are correlated.

    Attributes:
        rows: Rows of the values, a place after the other.
        gaps: Distances of the values' places [m].
        each: Number of values of a place.
        band: Number of the receiver's band.
    """

    rows: Int[Tensor, " c"]
    gaps: Float[Tensor, "c c"]
    each: int
    band: int


class FieldFit:
    """Least squares of fields by the images in a room's planes, over all places at once.

    Every number counts relative to its receiver's mean at its distance, so that near places do not
    own the fit.

    Args:
        data: Training channels with a phase in common.
        floor: Share of the mean power below which an error hardly counts: 20 dB.
        damping: Share of the mean squared derivative added in each step of Gauss and Newton.
    """

    def __init__(
        self, data: ChannelData, floor: float = 0.01, damping: float = 1e-3, largest: int = 200
    ):
        self.receivers = data.receivers
        self.order = data.order
        self.floor = floor
        self.damping = damping
        values = []
        scales = []
        for receiver in self.receivers:
            near = 0.05 * data.frame.diagonal
            lengths = (receiver.places - receiver.position).norm(dim=1).clamp_min(near)
            scaled = receiver.flat * lengths[:, None]  # (b, k)
            scale = lengths / scaled.abs().square().mean().sqrt()
            scales.append(scale[:, None].expand_as(receiver.flat).flatten())
            values.append(receiver.flat.flatten())
        counts = [len(part) for part in values]
        self.scale = torch.cat(scales)  # (m,)
        self.values = torch.cat(values) * self.scale  # (m,), mean power 1 for each receiver
        self.owner = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts))
        wavelengths = torch.tensor([receiver.wavelength for receiver in self.receivers])
        self.bands, self.band_numbers = wavelengths.unique(return_inverse=True)
        self.band = self.band_numbers[self.owner]  # (m,)
        self.variations = [Variation.choices()[0]] * len(self.bands)
        self.blocks = list(self._divide(largest))

    def _divide(self, largest: int) -> Iterator[PlaceBlock]:
        """Blocks of channel values of neighbouring places at one receiver, about ``largest`` each.

        Values are in the order of ``self.values``: receiver by receiver, b places of k values.
        """
        first = 0
        for receiver, band in zip(self.receivers, self.band_numbers.tolist(), strict=True):
            b, k = receiver.flat.shape
            rows = first + torch.arange(b * k).view(b, k)
            first += b * k
            count = 2 ** max(0, math.ceil(math.log2(b * k / largest)))
            groups = group_places(receiver.places, count)
            for group in groups.unique():
                own = groups == group
                gaps = torch.cdist(receiver.places[own], receiver.places[own])
                gaps = gaps.repeat_interleave(k, 0).repeat_interleave(k, 1)
                yield PlaceBlock(rows[own].flatten(), gaps, k, band)

    @property
    def count(self) -> int:
        """Complex numbers of all training links."""
        return len(self.values)

    def start(self, planes: Float[Tensor, "w 4"]) -> FieldRoom:
        """Known planes as half-spaces; without any it is free space alone."""
        gains = torch.ones(len(self.bands), len(planes), dtype=torch.complex128)
        receivers = torch.ones(len(self.receivers), dtype=torch.complex128)
        slabs = SLABS[1].repeat(len(planes), 1)
        uses = torch.ones_like(gains.real, dtype=torch.bool)
        return self.fit_gains(FieldRoom(planes.double(), slabs, gains, receivers, uses), 12)

    def waves(self, planes: Float[Tensor, "w 4"], room: FieldRoom) -> Complex[Tensor, "m n"]:
        """Scaled waves of all paths after reflection by slabs, for each number."""
        sequences = all_sequences(len(planes), self.order)
        slabs = SlabRoom(planes, room.slabs)
        parts = []
        for receiver in self.receivers:
            waves = receiver.reflected(slabs, sequences)  # (b, n, k)
            parts.append(waves.mT.flatten(0, 1))
        return torch.cat(parts) * self.scale[:, None]

    def fit_gains(
        self,
        room: FieldRoom,
        steps: int,
        waves: Complex[Tensor, "m n"] | None = None,
        kriged: Kriged | None = None,
    ) -> FieldRoom:
        """The room with the gains of least mean log error: damped steps of Gauss and Newton.

        Weights make least squares the logarithm's (iteratively reweighted least squares).
        """
        waves = self.waves(room.planes, room) if waves is None else waves
        best = room
        whiten = (kriged or self.krige(room, waves)).whiten
        rest = whiten(self.residual(room, waves))
        least = self.mean_log(rest)
        damping = self.damping
        for _ in range(steps):
            trial = self._step(best, waves, rest, damping, whiten)
            trial_rest = whiten(self.residual(trial, waves))
            loss = self.mean_log(trial_rest)
            if loss < least:
                best, rest, least = trial, trial_rest, loss
                damping = max(damping / 4, self.damping)
            else:
                damping = 8 * damping
        return best

    def _step(
        self,
        room: FieldRoom,
        waves: Complex[Tensor, "m n"],
        rest: Complex[Tensor, " m"],
        damping: float,
        whiten: Operator,
    ) -> FieldRoom:
        """The room after one damped step of all gains (Levenberg and Marquardt)."""
        sequences = all_sequences(len(room.planes), self.order)
        unit = torch.zeros_like(self.values)  # (m,)
        by_gain = waves.new_zeros(len(waves), *room.gains.shape)  # (m, bands, w)
        for number, gains in enumerate(room.gains):
            own = self.band == number
            changes = multiply_gains(gains, sequences)
            unit[own] = waves[own] @ changes.products
            by_gain[own, number] = (waves[own] @ changes.derivatives) * room.uses[number]
        by_gain = room.receivers[self.owner, None] * by_gain.flatten(1)  # (m, bands w)
        is_own = self.owner[:, None] == torch.arange(len(self.receivers))
        jacobian = whiten(torch.cat((by_gain, unit[:, None] * is_own), 1))  # (m, w + r)
        weights = 1 / (rest.abs().square() + self.floor)
        gram = jacobian.mH @ (weights[:, None] * jacobian)
        size = gram.diagonal().real
        gram = gram + torch.diag(damping * size + 1e-6 * size.mean())
        change = torch.linalg.solve(gram, jacobian.mH @ (weights * rest))
        gains, receivers = change.split((room.gains.numel(), len(self.receivers)))
        gains = room.gains + gains.view_as(room.gains)
        return room._replace(gains=gains, receivers=room.receivers + receivers)

    def residual(
        self, room: FieldRoom, waves: Complex[Tensor, "m n"] | None = None
    ) -> Complex[Tensor, " m"]:
        """Scaled errors of all numbers, without deviations of paths."""
        waves = self.waves(room.planes, room) if waves is None else waves
        products = self.products(room)
        # One product of matrices a band: of each number with its own would take their memory.
        total = torch.zeros_like(self.values)
        for number, of_band in enumerate(products):
            own = self.band == number
            total = torch.where(own, waves @ of_band, total)
        return self.values - room.receivers[self.owner] * total

    def products(self, room: FieldRoom) -> Complex[Tensor, "bands n"]:
        """Products of the gains of each path in each band."""
        sequences = all_sequences(len(room.planes), self.order)
        return torch.stack([multiply_gains(gains, sequences).products for gains in room.gains])

    @torch.no_grad()
    def krige(self, room: FieldRoom, waves: Complex[Tensor, "m n"]) -> Kriged:
        """Kriging by path of residuals beside a room.

        The covariance of two numbers is the covariance of their paths' fields, times the kernel
        of their places.

        Source: Dubrule, Cross validation of kriging in a unique neighborhood, 1983.
        """
        if not any(variation.share for variation in self.variations):
            return Kriged(lambda rest: rest, lambda rest: rest)
        fields = waves * (room.receivers[self.owner, None] * self.products(room)[self.band])
        whitening = []
        unseen = []
        for block in self.blocks:
            variation = self.variations[block.band]
            own = fields[block.rows].to(torch.complex64)
            kernel = variation.share**2 * (-block.gaps / variation.length).exp()
            covariance = kernel.float() * (own @ own.mH)
            covariance = covariance + variation.noise**2 * torch.eye(len(own))
            factor = torch.linalg.cholesky(covariance)
            root = torch.linalg.solve_triangular(
                factor, torch.eye(len(own)).to(factor), upper=False
            )
            by_place = (root.mH @ root).unflatten(0, (-1, block.each))  # (b, k, c)
            of_place = by_place.unflatten(2, (-1, block.each)).diagonal(dim1=0, dim2=2)  # (k, k, b)
            left = torch.linalg.solve(of_place.movedim(2, 0), by_place)
            whitening.append(variation.noise * root.to(torch.complex128))
            unseen.append(left.flatten(0, 1).to(torch.complex128))
        return Kriged(partial(self._apply, whitening), partial(self._apply, unseen))

    def _apply(self, operators: list[Tensor], rest: Tensor) -> Tensor:
        """Values (m, ...) after an operator for each block."""
        applied = torch.empty_like(rest)
        for block, operator in zip(self.blocks, operators, strict=True):
            applied[block.rows] = operator @ rest[block.rows]
        return applied

    def unseen(self, room: FieldRoom) -> Complex[Tensor, " m"]:
        """Scaled errors of each place as all others predict it."""
        waves = self.waves(room.planes, room)
        return self.krige(room, waves).unseen(self.residual(room, waves))

    def choose_variation(self, room: FieldRoom) -> None:
        """Takes the variation with which a room's places predict each other best in each band."""
        waves = self.waves(room.planes, room)
        rest = self.residual(room, waves)
        errors = []
        for variation in Variation.choices():
            self.variations = [variation] * len(self.bands)
            unseen = self.krige(room, waves).unseen(rest)
            logs = (unseen.abs().square() + self.floor).log()
            errors.append(logs.new_zeros(len(self.bands)).index_add(0, self.band, logs))
        best = torch.stack(errors).argmin(0).tolist()
        self.variations = [Variation.choices()[number] for number in best]

    def mean_log(self, rest: Complex[Tensor, " m"]) -> Float[Tensor, ""]:
        """Mean logarithm of squared errors over the mean power, with the floor."""
        return (rest.abs().square() + self.floor).log().mean()


def group_places(places: Float[Tensor, "b 3"], count: int) -> Int[Tensor, " b"]:
    """Numbers of ``count`` groups of neighbouring places, a power of two: halved lengthwise."""
    groups = torch.zeros(len(places), dtype=torch.long)
    while groups.max() + 1 < count:
        halves = torch.zeros_like(groups)
        for group in groups.unique():
            rows = (groups == group).nonzero()[:, 0]
            own = places[rows]
            along = own[:, (own.amax(0) - own.amin(0)).argmax()]
            halves[rows] = (along > along.median()).long()
        groups = 2 * groups + halves
    return groups
