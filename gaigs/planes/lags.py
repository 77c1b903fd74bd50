"""Covariances of the elements of a receiver's array: measured ones, and those that paths give."""

import itertools
import math
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float, Int
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.antenna import Array
from gaigs.core.geometry import Grid, Pose, sinc
from gaigs.core.propagation import NEAREST, fresnel
from gaigs.splatting.placement.mirrored.reflections import fold, images, polarised

MATERIAL = complex(4.0, -0.3)
"""Relative permittivity of all planes: between wood and concrete."""


def reflection(
    normals: Float[Tensor, "*#n 3"], cosines: Float[Tensor, "*n"]
) -> Complex[Tensor, "*n"]:
    """Reflection coefficients of planes of ``MATERIAL``."""
    return polarised(normals, *fresnel(MATERIAL, cosines.clamp_min(1e-3)))


class ArrayPaths(NamedTuple):
    """Paths as received by an array."""

    fields: Complex[Tensor, "b n"]  # fields at the middle of the array
    steering: Complex[Tensor, "b n e"]  # phase factors at the elements
    lengths: Float[Tensor, "b n"]  # lengths of the paths [m]


class FurtherWave(NamedTuple):
    """Gradient of a link's error by the wave of a further path, which interferes with known paths.

    A weak further path with the wave w at the elements lowers the error by 2 Re sum(w* weights),
    summed over known paths and elements.
    """

    # Weights for each known path and element. Without a bandwidth they are summed over the known
    # paths, and n is 1.
    weights: Complex[Tensor, "b n e"]
    lengths: Float[Tensor, "b n"]  # lengths of the known paths [m]


class SingleReflections(NamedTuple):
    """Paths with one reflection, from b places at c planes."""

    directions: Float[Tensor, "b c 3"]  # unit vectors in the array's frame
    lengths: Float[Tensor, "b c"]  # lengths of the paths [m]
    gains: Complex[Tensor, "b c"]  # fields without a phase; 0 for places behind a plane
    cosines: Float[Tensor, "b c"]  # cosines of the angles of incidence, negative behind a plane


@dataclass(frozen=True)
class ReceiverLags:
    """Covariances of one receiver's elements at some training links of one carrier."""

    places: Float[Tensor, "b 3"]  # transmitters [m]
    lags: Complex[Tensor, "b l"]  # covariances at each of ``array.lags``, over the power
    frequency: float  # carrier [Hz]
    # Pose and array of the receiver.
    pose: Pose
    array: Array
    # Directions in which spectra are compared: 4 x 4 elements resolve no more.
    directions: Float[Tensor, "k 3"] = field(
        default=Grid.degrees(range(4, 90, 8), range(0, 360, 15)).flatten().vectors(), repr=False
    )

    def at(self, index: object) -> "ReceiverLags":
        """The covariances of some links, by an index, mask or slice."""
        return replace(self, places=self.places[index], lags=self.lags[index])

    @property
    def position(self) -> Float[Tensor, "3"]:
        return self.pose.position

    @property
    def wavenumber(self) -> float:
        """Wavenumber of the carrier [rad/m]."""
        return 2 * math.pi / speed_of_light * self.frequency

    @cached_property
    def elements(self) -> Float[Tensor, "e 2"]:
        """Positions of the elements in the plane of the array [m]."""
        return self.array.elements[:, :2].to(self.places)

    @cached_property
    def counts(self) -> Float[Tensor, " l"]:
        """Number of pairs of elements at each lag."""
        return self.array.lags[2].to(self.places)

    # --- errors ---

    @cached_property
    def shapes(self) -> Float[Tensor, "b k"]:
        """``shape_of`` the training spectra."""
        return self.shape_of(self.lags)

    @cached_property
    def basis(self) -> Float[Tensor, "m k"]:
        """Matrix that maps covariances at lags to the power in each of ``directions``.

        Its rows are for the real parts of the covariances from lag 0 on, then for the imaginary
        parts.
        """
        half = len(self.counts) // 2  # lag 0 is in the middle
        # Opposite lags have conjugate covariances, so each lag but 0 counts twice.
        weights = self.counts[half:] * torch.where(torch.arange(half + 1) > 0, 2, 1)
        lags = self.array.lags[0][half:].to(self.places)  # vectors between elements [m]
        phases = self.wavenumber * (lags @ self.directions.to(self.places).T)  # (lags, k)
        return torch.cat((phases.cos() * weights[:, None], phases.sin() * weights[:, None]))

    def shape_of(self, lags: Complex[Tensor, "b l"]) -> Float[Tensor, "b k"]:
        """Amplitudes of spectra in ``directions``, normalised to a mean of 0 and a norm of 1.

        The normalisation removes the unknown factor and offset of labels.
        """
        from_zero = lags[:, lags.shape[1] // 2 :]  # the others are their conjugates
        from_zero = from_zero / from_zero[:, :1].real.clamp_min(1e-12)
        powers = torch.cat((from_zero.real, from_zero.imag), 1) @ self.basis  # (b, k)
        amplitudes = powers.clamp_min(1e-4).sqrt()  # the mean power is e² for e elements
        amplitudes = amplitudes - amplitudes.mean(1, keepdim=True)
        return amplitudes / amplitudes.norm(dim=1, keepdim=True).clamp_min(1e-6)

    def errors(self, lags: Complex[Tensor, "b l"]) -> Float[Tensor, " b"]:
        """Log of the fraction of each spectrum's variance that a model's lags do not explain."""
        floor = 0.01  # share below which an error hardly counts
        correlations = (self.shape_of(lags) * self.shapes).sum(1).clamp_min(0)
        return (1 - correlations.square() + floor).log()

    def slopes(self, lags: Complex[Tensor, "b l"]) -> Complex[Tensor, "b e e"]:
        """Negative gradient M of the errors with respect to the covariance matrices.

        The power of a weak further wave x lowers the error by x' M x. Interference of x with a
        known wave y lowers the error by 2 Re x' M y.
        """
        with torch.enable_grad():
            lags = lags.detach().requires_grad_()
            self.errors(lags).sum().backward()
        half = len(self.counts) // 2
        slopes = -lags.grad[:, half:]
        slopes[:, 1:] /= 2  # ``shape_of`` reads one of two opposite lags, which share its slope
        opposite = slopes[:, 1:].conj().flip(1)
        # A covariance at a lag is the mean over ``counts`` pairs of elements.
        slopes = torch.cat((opposite, slopes), 1) / self.counts  # (b, l)
        lag_of_pair = self.array.lags[1]  # (e e,)
        return slopes[:, lag_of_pair].view(-1, len(self.array), len(self.array))

    # --- paths ---

    def steer(self, directions: Float[Tensor, "*b d"]) -> Complex[Tensor, "*b e"]:
        """Phase factors at the elements of waves from directions in the array's frame.

        Only the first two coordinates of ``directions`` are used.
        """
        turns = self.wavenumber * (directions[..., :2] @ self.elements.T)
        return torch.polar(torch.ones_like(turns), turns)

    def look_at(
        self, points: Float[Tensor, "*b 3"]
    ) -> tuple[Float[Tensor, "*b 3"], Float[Tensor, "*b"]]:
        """Directions to points in the array's frame, and distances [m]."""
        ways = (points - self.pose.position) @ self.pose.rotation
        lengths = ways.norm(dim=-1).clamp_min(NEAREST)
        return ways / lengths[..., None], lengths

    def paths(
        self,
        planes: Float[Tensor, "w 4"],
        sequences: Int[Tensor, "n order"],
        passing: Tensor | None = None,
    ) -> ArrayPaths:
        """The direct path, and the paths that ``planes`` reflect.

        ``passing`` (b, w + 1) is the fraction of the field that obstacles transmit. Column 0 is for
        the direct path, the others for the paths at each plane. Booleans mean 1 and 0; None means
        1 everywhere.
        """
        normals, offsets = planes[:, :3], planes[:, 3]
        points = images(self.places, sequences, normals, offsets)
        receivers = self.pose.position.expand(len(self.places), 3)
        folded = fold(points, receivers, sequences, normals, offsets)
        directions, lengths = self.look_at(points[-1])
        gains = folded.exists * self.array.gain(directions) / lengths  # (b, n)
        if passing is not None:
            # The last column, 1, is for the number -1 (no plane).
            at_planes = torch.cat((passing[:, 1:], torch.ones_like(passing[:, :1])), 1)
            transmitted = at_planes[:, sequences].prod(2)  # (b, n)
            transmitted[:, 0] = passing[:, 0]  # the direct path
            gains = gains * transmitted
        reflections = reflection(folded.normals, folded.cosines)
        fields = folded.reflected(torch.complex(gains, torch.zeros_like(gains)), reflections)
        phases = -self.wavenumber * lengths
        fields = fields * torch.polar(torch.ones_like(phases), phases)
        return ArrayPaths(fields, self.steer(directions), lengths)

    def covariances(self, paths: ArrayPaths, bandwidth: float) -> Complex[Tensor, "b l"]:
        """Covariances that interfering paths give at each lag, as in ``LagPooling``.

        Powers are averaged over ``bandwidth`` [Hz]; 0 is a single carrier.
        """
        fields, steering, lengths = paths
        if bandwidth:
            # Over a band the correlation of two paths is sinc(B (L - L') / c).
            gaps = lengths[:, :, None] - lengths[:, None]  # (b, n, n)
            coherence = sinc(bandwidth / speed_of_light * gaps)
            of_paths = fields[:, :, None] * fields[:, None].conj() * coherence  # (b, n, n)
            of_elements = steering.mT @ of_paths @ steering.conj()  # (b, e, e)
        else:
            waves = (fields[:, None] @ steering).mT  # (b, e, 1)
            of_elements = waves @ waves.mH
        # Means over all pairs of elements with the same lag.
        flat = of_elements.flatten(1)  # (b, e e)
        sums = flat.new_zeros(len(flat), len(self.counts))
        return sums.index_add(1, self.array.lags[1], flat) / self.counts

    def further_wave(self, paths: ArrayPaths, bandwidth: float) -> FurtherWave:
        """How a further path, by interference with the known ``paths``, lowers the errors."""
        slopes = self.slopes(self.covariances(paths, bandwidth))
        weights = (slopes @ paths.steering.mT).mT * paths.fields[..., None]  # (b, n, e)
        if bandwidth:
            return FurtherWave(weights, paths.lengths)
        return FurtherWave(weights.sum(1, keepdim=True), paths.lengths[:, :1])

    def reflect_once(self, planes: Float[Tensor, "c 4"]) -> SingleReflections:
        """Paths with one reflection, at each plane alone."""
        normals, offsets = planes[:, :3], planes[:, 3]
        # Heights of receiver and transmitters over each plane [m].
        receiver_heights = self.pose.position @ normals.T - offsets  # (c,)
        heights = self.places @ normals.T - offsets  # (b, c)
        images = self.places[:, None] - 2 * heights[..., None] * normals  # (b, c, 3)
        directions, lengths = self.look_at(images)
        cosines = -(receiver_heights + heights) / lengths
        is_same_side = receiver_heights * heights > 0
        gains = self.array.gain(directions) / lengths * is_same_side
        gains = gains * reflection(normals, cosines.abs())
        return SingleReflections(directions, lengths, gains, cosines)

    def describe_doubts(self, name: str) -> list[str]:
        """A sentence for the log if spectra fit the direct path better with turned azimuths.

        Otherwise the list is empty.

        Args:
            name: Name of the receiver.
        """
        _, lag_of_pair, _ = self.array.lags
        covariances = self.lags[:, lag_of_pair].view(-1, len(self.array), len(self.array))
        directions, _ = self.look_at(self.places)
        shares = {}
        for turn, flip in itertools.product(range(4), (1, -1)):  # quarter turns, and a reflection
            horizontal = torch.view_as_complex(directions[:, :2].contiguous()) * 1j**turn
            turned = torch.view_as_real(horizontal)
            turned = torch.cat((turned[:, :1], flip * turned[:, 1:], directions[:, 2:]), -1)
            steering = self.steer(turned)
            # Power of a beam towards the path over the power of the spectrum: s' C s / e².
            powers = torch.einsum("bi,bij,bj->b", steering.conj(), covariances, steering).real
            shares[turn, flip] = (powers / len(self.array) ** 2).median().item()
        (turn, flip), best = max(shares.items(), key=lambda item: item[1])
        if best < 0.4 or shares[0, 1] > best - 0.2:
            return []
        changes = []
        if turn:
            changes.append(f"turned by {90 * turn} degrees")
        if flip < 0:
            changes.append("counted clockwise")
        return [
            f"the direct path explains {shares[0, 1]:.0%} of the spectra of {name}, "
            f"{best:.0%} if azimuths were {' and '.join(changes)}\n"
            "check the receiver's orientation and the azimuths of the data"
        ]
