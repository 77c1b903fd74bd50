"""Rooms for channels with few values: planes whose gains are common to all places."""

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
    """Planes in the frame, their slabs as in ``SLABS``, and gains that multiply the reflections.

    The strength of a path is the product of its planes' gains and the receiver's gain, so a few
    numbers explain many paths. All bands share the planes, but each band has its own gains. A gain
    is 0 if the band does not use the plane.
    """

    planes: Float[Tensor, "w 4"]
    slabs: Float[Tensor, "w 3"]
    gains: Complex[Tensor, "bands w"]
    receivers: Complex[Tensor, " r"]  # gain of each receiver
    uses: Bool[Tensor, "bands w"]  # True if the band uses the plane

    def with_plane(
        self, plane: Float[Tensor, "4"], slab: Float[Tensor, "3"], uses: Bool[Tensor, " bands"]
    ) -> "FieldRoom":
        """The room with one more plane, the last, with a gain of 0."""
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
    """Linear operators on residuals, if each path's field is kriged from nearby places."""

    whiten: Operator  # to decorrelated residuals, by the inverse Cholesky factor
    leave_out: Operator  # to each place's errors when the other places of its block predict it


class Variation(NamedTuple):
    """Hyperparameters of the Gaussian process of a path's strength over places.

    Attributes:
        share: Standard deviation of a path's field, as a fraction of its mean.
        length: Distance at which the kernel falls to 1 / e [m].
        noise: Standard deviation of uncorrelated errors over the mean field.
    """

    share: float
    length: float
    noise: float

    @classmethod
    def choices(cls) -> list["Variation"]:
        """Hyperparameters to try: no variation, then lengths of furniture and of half a room."""
        candidates = [cls(0.0, 1.0, 1.0)]
        for share in (0.2, 0.5):
            for length in (0.5, 2.0):
                candidates += [cls(share, length, 0.1), cls(share, length, 0.3)]
        return candidates


class GainChanges(NamedTuple):
    """Gains of paths, and their derivatives by the gains of planes."""

    products: Complex[Tensor, " n"]  # of the gains of the path's planes
    derivatives: Complex[Tensor, "n w"]  # of each product by each plane's gain


def multiply_gains(gains: Complex[Tensor, " w"], sequences: Int[Tensor, "n order"]) -> GainChanges:
    """Products of plane gains over the planes of each sequence."""
    n, order = sequences.shape
    w = len(gains)
    factors = torch.cat((gains, gains.new_ones(1)))[sequences]  # (n, order); 1 for no plane
    derivatives = gains.new_zeros(n, w + 1)
    for column in range(order):
        # The derivative by one factor is the product of the others. A plane that comes twice gets
        # the sum. Number -1, no plane, falls into the last column, which is left out.
        others = torch.arange(order) != column
        planes = sequences[:, column, None] % (w + 1)  # (n, 1)
        derivatives.scatter_add_(1, planes, factors[:, others].prod(1)[:, None])
    return GainChanges(factors.prod(1), derivatives[:, :w])


class PlaceBlock(NamedTuple):
    """Channel values of one receiver at a group of neighbouring places, which are kriged together.

    Attributes:
        rows: Rows of ``FieldFit.values``, one place after the other.
        gaps: Distances between the places of each pair of values [m].
        each: Number of values at a place.
        band: Number of the receiver's band.
    """

    rows: Int[Tensor, " c"]
    gaps: Float[Tensor, "c c"]
    each: int
    band: int


class FieldFit:
    """Fit of plane and receiver gains to the channels of all places at once, by least squares.

    Channels are sums of the waves of images in the planes. Every channel value is multiplied by the
    link's distance; otherwise near places would dominate.

    Args:
        data: Training channels with a common phase.
        floor: Fraction of the mean power below which an error hardly counts; the default is -20 dB.
        damping: Fraction of the mean squared derivative added in each Gauss-Newton step.
        largest: Approximate number of channel values in a ``PlaceBlock``; larger blocks cost time.

    Attributes:
        values: Channel values of all receivers (m,), scaled to a mean power of 1 at each.
        scale: Factor from channel values to ``values`` (m,).
        owner: Number of each value's receiver (m,).
        bands: Distinct wavelengths [m].
        band_numbers: Number of each receiver's band.
        band: Number of each value's band (m,).
        variations: Variation of path strengths over places, in each band.
        blocks: Neighbouring places that are kriged together.
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
            nearest = 0.05 * data.frame.diagonal
            lengths = (receiver.places - receiver.position).norm(dim=1).clamp_min(nearest)
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
        """Yields blocks of neighbouring places, with about ``largest`` values each.

        Kriging solves one linear system for each block instead of one for all places.
        """
        # ``values`` has the receivers one after the other, each with b places of k values.
        first = 0
        for receiver, band in zip(self.receivers, self.band_numbers.tolist(), strict=True):
            b, k = receiver.flat.shape
            rows = first + torch.arange(b * k).view(b, k)
            first += b * k
            # ``group_places`` halves, so the number of groups is a power of two.
            count = 2 ** max(0, math.ceil(math.log2(b * k / largest)))
            groups = group_places(receiver.places, count)
            for group in groups.unique():
                is_member = groups == group
                places = receiver.places[is_member]
                gaps = torch.cdist(places, places)
                # The k values of a place have the same distances.
                gaps = gaps.repeat_interleave(k, 0).repeat_interleave(k, 1)  # (c, c)
                yield PlaceBlock(rows[is_member].flatten(), gaps, k, band)

    @property
    def count(self) -> int:
        """Number of complex channel values of all training links."""
        return len(self.values)

    def start(self, planes: Float[Tensor, "w 4"]) -> FieldRoom:
        """A room of known planes as half-spaces, with fitted gains; free space without planes."""
        gains = torch.ones(len(self.bands), len(planes), dtype=torch.complex128)
        receivers = torch.ones(len(self.receivers), dtype=torch.complex128)
        slabs = SLABS[1].repeat(len(planes), 1)
        uses = torch.ones_like(gains.real, dtype=torch.bool)
        return self.fit_gains(FieldRoom(planes.double(), slabs, gains, receivers, uses), 12)

    def waves(self, planes: Float[Tensor, "w 4"], room: FieldRoom) -> Complex[Tensor, "m n"]:
        """Waves of all paths after reflection by the room's slabs, scaled like ``values``."""
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
        """The room with gains that minimise the mean log error, by damped Gauss-Newton steps.

        Weights convert least squares to the mean logarithm (iteratively reweighted least squares).

        Args:
            room: Planes, and initial gains.
            steps: Number of steps. A step that raises the error is undone, and damping then grows.
            waves: The room's ``waves`` if they are known.
            kriged: Result of ``krige`` for the room if it is known.
        """
        waves = self.waves(room.planes, room) if waves is None else waves
        best = room
        whiten = (kriged or self.krige(room, waves)).whiten
        residual = whiten(self.residual(room, waves))
        least = self.mean_log(residual)
        damping = self.damping
        for _ in range(steps):
            trial = self._step(best, waves, residual, damping, whiten)
            trial_residual = whiten(self.residual(trial, waves))
            loss = self.mean_log(trial_residual)
            if loss < least:
                best, residual, least = trial, trial_residual, loss
                damping = max(damping / 4, self.damping)
            else:
                damping = 8 * damping
        return best

    def _step(
        self,
        room: FieldRoom,
        waves: Complex[Tensor, "m n"],
        residual: Complex[Tensor, " m"],
        damping: float,
        whiten: Operator,
    ) -> FieldRoom:
        """The room after one damped step of all gains (Levenberg and Marquardt)."""
        sequences = all_sequences(len(room.planes), self.order)
        # Derivatives of the predicted values by a receiver's gain are the values at a gain of 1.
        # Derivatives by a plane's gain are the values of the paths at this plane.
        by_receiver = torch.zeros_like(self.values)  # (m,)
        by_plane = waves.new_zeros(len(waves), *room.gains.shape)  # (m, bands, w)
        for number, gains in enumerate(room.gains):
            in_band = self.band == number
            changes = multiply_gains(gains, sequences)
            by_receiver[in_band] = waves[in_band] @ changes.products
            by_plane[in_band, number] = (waves[in_band] @ changes.derivatives) * room.uses[number]
        by_plane = room.receivers[self.owner, None] * by_plane.flatten(1)  # (m, bands w)
        is_owner = self.owner[:, None] == torch.arange(len(self.receivers))  # (m, r)
        jacobian = torch.cat((by_plane, by_receiver[:, None] * is_owner), 1)  # (m, bands w + r)
        jacobian = whiten(jacobian)
        # Weights of the mean log error: the derivative of log(|error|² + floor) by |error|².
        weights = 1 / (residual.abs().square() + self.floor)
        gram = jacobian.mH @ (weights[:, None] * jacobian)
        size = gram.diagonal().real
        gram = gram + torch.diag(damping * size + 1e-6 * size.mean())
        change = torch.linalg.solve(gram, jacobian.mH @ (weights * residual))
        gains, receivers = change.split((room.gains.numel(), len(self.receivers)))
        gains = room.gains + gains.view_as(room.gains)
        return room._replace(gains=gains, receivers=room.receivers + receivers)

    def residual(
        self, room: FieldRoom, waves: Complex[Tensor, "m n"] | None = None
    ) -> Complex[Tensor, " m"]:
        """Scaled errors of all channel values, before kriging."""
        waves = self.waves(room.planes, room) if waves is None else waves
        products = self.products(room)
        # A product of matrices for each band: ``products[self.band]`` would be as large as waves.
        total = torch.zeros_like(self.values)
        for number, strengths in enumerate(products):
            total = torch.where(self.band == number, waves @ strengths, total)
        return self.values - room.receivers[self.owner] * total

    def products(self, room: FieldRoom) -> Complex[Tensor, "bands n"]:
        """Product of the planes' gains for each path, in each band."""
        sequences = all_sequences(len(room.planes), self.order)
        return torch.stack([multiply_gains(gains, sequences).products for gains in room.gains])

    @torch.no_grad()
    def krige(self, room: FieldRoom, waves: Complex[Tensor, "m n"]) -> Kriged:
        """Operators on the residuals of a room: whitening, and prediction of left-out places.

        The covariance of two channel values is the sum over paths of the product of their fields,
        times the kernel of their places. Noise is added on the diagonal.

        Source: Dubrule, Cross validation of kriging in a unique neighborhood, 1983.
        """
        if not any(variation.share for variation in self.variations):
            return Kriged(lambda residual: residual, lambda residual: residual)
        fields = waves * (room.receivers[self.owner, None] * self.products(room)[self.band])
        whitening = []
        leaving_out = []
        for block in self.blocks:
            variation = self.variations[block.band]
            paths = fields[block.rows].to(torch.complex64)  # (c, n)
            kernel = variation.share**2 * (-block.gaps / variation.length).exp()
            covariance = kernel.float() * (paths @ paths.mH)
            identity = torch.eye(len(paths))
            covariance = covariance + variation.noise**2 * identity
            factor = torch.linalg.cholesky(covariance)
            root = torch.linalg.solve_triangular(factor, identity.to(factor), upper=False)
            # Errors of place i from all others are (Q_ii)^-1 (Q r)_i with Q the inverse covariance
            # (Dubrule, 1983); Q_ii has the k values of a place.
            by_place = (root.mH @ root).unflatten(0, (-1, block.each))  # (b, k, c)
            of_place = by_place.unflatten(2, (-1, block.each)).diagonal(dim1=0, dim2=2)  # (k, k, b)
            from_others = torch.linalg.solve(of_place.movedim(2, 0), by_place)  # (b, k, c)
            whitening.append(variation.noise * root.to(torch.complex128))
            leaving_out.append(from_others.flatten(0, 1).to(torch.complex128))
        return Kriged(partial(self._apply, whitening), partial(self._apply, leaving_out))

    def _apply(self, operators: list[Tensor], residual: Tensor) -> Tensor:
        """Residuals (m, ...), each block multiplied by its matrix of ``operators``."""
        applied = torch.empty_like(residual)
        for block, operator in zip(self.blocks, operators, strict=True):
            applied[block.rows] = operator @ residual[block.rows]
        return applied

    def leave_out(self, room: FieldRoom) -> Complex[Tensor, " m"]:
        """Scaled errors at each place when it is predicted from the other places of its block."""
        waves = self.waves(room.planes, room)
        return self.krige(room, waves).leave_out(self.residual(room, waves))

    def choose_variation(self, room: FieldRoom) -> None:
        """Sets ``variations`` to the choice of each band that best predicts left-out places."""
        waves = self.waves(room.planes, room)
        residual = self.residual(room, waves)
        errors = []
        for variation in Variation.choices():
            self.variations = [variation] * len(self.bands)
            left_out = self.krige(room, waves).leave_out(residual)
            logs = (left_out.abs().square() + self.floor).log()
            errors.append(logs.new_zeros(len(self.bands)).index_add(0, self.band, logs))
        best = torch.stack(errors).argmin(0).tolist()
        self.variations = [Variation.choices()[number] for number in best]

    def mean_log(self, errors: Complex[Tensor, " m"]) -> Float[Tensor, ""]:
        """Mean of log(|error|² + ``floor``) over scaled errors."""
        return (errors.abs().square() + self.floor).log().mean()


def group_places(places: Float[Tensor, "b 3"], count: int) -> Int[Tensor, " b"]:
    """Number of each place's group; a group has neighbouring places.

    All groups are halved, at the median along their longest axis, until there are ``count``. This
    must be a power of two.
    """
    groups = torch.zeros(len(places), dtype=torch.long)
    while groups.max() + 1 < count:
        halves = torch.zeros_like(groups)
        for group in groups.unique():
            rows = (groups == group).nonzero()[:, 0]
            members = places[rows]
            extents = members.amax(0) - members.amin(0)
            along = members[:, extents.argmax()]
            halves[rows] = (along > along.median()).long()
        groups = 2 * groups + halves
    return groups
