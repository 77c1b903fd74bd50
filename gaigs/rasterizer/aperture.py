"""No pixels: what Gaussians send to each element of an array, summed in closed form."""

import math

import torch
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.geometry import magnitudes, polar
from gaigs.projection import Splats
from gaigs.propagation import NEAREST
from gaigs.registry import register
from gaigs.scene import Array

WIDE = 3.0
"""Largest phase by which a band turns over an array [rad] for which a power series is summed: its terms stay small."""

FLAT = 1e-6
"""An array whose elements leave its plane by no more than this is planar [m]: float32 places metres no better."""


@register("rasterizer", "aperture")
class Aperture:
    """Sums Gaussians in the array's aperture, where a footprint's integral is known.

    As a splat of the plane of direction cosines, one holds in all the amplitude A, spread over directions u about its
    centre as a Gaussian with covariance S. An element at x, in wavelengths, hears of it

        y(x) = A exp(-(2 pi)² x' S x / 2 + j 2 pi x . u)

    and where powers add, the covariance of elements a lag D apart is sum |A|² exp(-(2 pi)² D' S D / 2 + j 2 pi D . u).
    Nothing hides anything else: there is no depth order, and opacities scale amplitudes alone.

    Attributes:
        used: As of every rasterizer.

    Source: ours; the Fourier transform of a Gaussian, and Van Trees, Optimum Array Processing, 2002, section 2.2.
    """

    used = "aperture"
    draws_map = False

    def fields(
        self,
        points: Float[Tensor, "b n 3"],
        semi_axes: Float[Tensor, "*b n 3 3"],
        amplitudes: Complex[Tensor, "b n"],
        lengths: Float[Tensor, "b n"],
        array: Array,
        carriers: Float[Tensor, "b"],
        offsets: Float[Tensor, "b s"],
    ) -> Complex[Tensor, "b e s"]:
        """What each element hears at several frequencies, all paths interfering.

        A path is longer to an element by as much as the element is farther from the path's point than the array's
        middle is, and its wave is weaker by the ratio: a spherical wave, at an array of any shape and orientation. It
        is weaker too by the footprint above, of the Gaussian as the array's middle sees it.

        Args:
            points: Where the Gaussians stand, in the array's frame [m].
            semi_axes: Theirs in that frame, a column for each axis (1 or b, n, 3, 3) [m].
            amplitudes: At the carrier, in the array's middle.
            lengths: Of the paths to the middle, by which phases differ from that at the carrier [m].
            array: Whose elements.
            carriers: Of each query [Hz].
            offsets: Frequencies over the carrier [Hz].
        """
        # Distances below NEAREST count as that: of the amplitudes they are the unit.
        elements, exact = array.elements.to(points), points.norm(dim=-1, keepdim=True)
        # Plain differences: by the matrix product an element far from a near point would lose its digits.
        own = torch.cdist(points, elements, compute_mode="donot_use_mm_for_euclid_dist")
        to_elements, ways = own.clamp_min(NEAREST), exact.clamp_min(NEAREST)
        # The difference of two lengths, without the digits that it would lose.
        both = own + exact
        longer = (elements.square().sum(-1) - 2 * points @ elements.T) / torch.where(both > 0, both, 1)
        longer = longer + (to_elements - own) - (ways - exact)
        wavenumbers = 2 * math.pi / speed_of_light * carriers.to(points)[:, None, None]
        # Semi-axes across the way, in radians as the middle sees them.
        units = (points / ways)[..., None]
        across = (semi_axes - units * (units * semi_axes).sum(-2, keepdim=True)) * (wavenumbers / ways)[..., None]
        turns = (elements @ across.movedim(-2, 0).flatten(1)).view(len(elements), *across.shape[:2], 3)
        spread = turns.square().sum(-1).movedim(0, -1)
        waves = amplitudes[..., None] * polar((spread / -2).exp() * (ways / to_elements), -wavenumbers * longer)
        reach = float(elements.norm(dim=-1).amax()) / speed_of_light
        rates = -2 * math.pi * offsets.to(lengths)
        turned = lambda delays: torch.polar(torch.ones_like(delays), delays)
        widest = reach * float(rates.abs().amax()) if rates.numel() else 0.0  # what the band turns over the array [rad]
        if widest > WIDE:
            delays = (lengths[..., None] + longer) / speed_of_light
            return (waves[..., None] * turned(delays[..., None] * rates[:, None, None])).sum(1)
        # exp(j rate (t + dt)) = exp(j rate t) sum_k (j rate dt)^k / k!: one product of matrices, and no wave of each
        # path, element and frequency. |dt| is at most the reach.
        terms, size = [waves], widest
        while size > torch.finfo(lengths.dtype).eps:
            terms.append(terms[-1] * (longer * (1j / (reach * speed_of_light * len(terms)))))
            size *= widest / len(terms)
        middle = turned(lengths[..., None] / speed_of_light * rates[:, None])
        sums = torch.stack(terms, 2).flatten(2).mT @ middle  # (b, terms x e, s)
        powers = (reach * rates)[:, None] ** torch.arange(len(terms), device=rates.device)[:, None]
        return (sums.unflatten(1, (len(terms), -1)) * powers[:, :, None]).sum(1)

    def lags(
        self,
        splats: Splats,
        amplitudes: Complex[Tensor, "b n"],
        lengths: Float[Tensor, "b n"],
        coherences: Float[Tensor, "n"],
        bandwidth: Float[Tensor, ""] | None,
        array: Array,
        carriers: Float[Tensor, "b"],
    ) -> Complex[Tensor, "b l"]:
        """The mean covariance of elements ``array.lags`` apart, of all pairs with that lag; of lag 0 it is the power.

        Two splats interfere by the product of their coherences, and over a band by sinc(bandwidth (t - t')), with t
        their paths' delays: what averaging over the band leaves of cos(2 pi f (t - t')).

        Args:
            splats: On the plane of direction cosines.
            amplitudes, lengths, carriers: As for ``fields``.
            coherences: Of each splat, in [0, 1].
            bandwidth: Of the band [Hz]; None: the carrier alone.
            array: Whose elements; planar.

        Raises:
            ValueError: The array is not planar.
        """
        _check_planar(array)
        amplitudes = _seen(splats, amplitudes)
        steps, pairs, counts = (part.to(amplitudes.device) for part in array.lags)
        steps, counts = steps.to(lengths), counts.to(lengths)
        centres, covariances = self._directions(splats, len(amplitudes))
        wavelengths = speed_of_light / carriers.to(lengths)[:, None, None]
        # Half of the lags are the conjugates of the others.
        half = len(steps) // 2
        angles = 2 * math.pi / wavelengths * (centres @ steps[half:, :2].T)
        narrow = _footprints(covariances, steps[half:, :2], wavelengths)
        powers = magnitudes(amplitudes).square() * (1 - coherences.square())
        real, imaginary = ((powers[..., None] * narrow * part).sum(1) for part in (angles.cos(), angles.sin()))
        later = torch.complex(real, imaginary)
        found = torch.cat((later[:, 1:].conj().flip(1), later), 1)
        sure = coherences.nonzero()[:, 0]  # pairs of the others have no phase: they cost nothing
        if not len(sure):
            return found
        waves = (amplitudes * coherences)[:, sure]
        steering = self._steering(splats, array, carriers)[:, sure]
        if bandwidth is None:
            heard = (waves[:, None] @ steering).mT
            covariance = heard @ heard.mH
        else:
            delays = lengths[:, sure] / speed_of_light
            likeness = torch.sinc(bandwidth * (delays[:, :, None] - delays[:, None]))
            together = waves[:, :, None] * waves[:, None].conj() * likeness
            covariance = steering.mT @ together @ steering.conj()
        added = torch.zeros_like(found).index_add(1, pairs, covariance.flatten(1))
        return found + added / counts

    def _steering(self, splats: Splats, array: Array, carriers: Float[Tensor, "b"]) -> Complex[Tensor, "b n e"]:
        """What each element hears of a splat of amplitude 1."""
        centres, covariances = self._directions(splats, len(carriers))
        elements = array.elements.to(centres)
        wavelengths = speed_of_light / carriers.to(centres)[:, None, None]
        angles = 2 * math.pi / wavelengths * (centres @ elements[:, :2].T)
        return polar(_footprints(covariances, elements[:, :2], wavelengths), angles)

    def _directions(self, splats: Splats, count: int) -> tuple[Float[Tensor, "b n 2"], Float[Tensor, "b n 2 2"]]:
        """Centres and covariances of each query's splats."""
        centres = splats.means2d if splats.means2d.ndim == 3 else splats.means2d[None]
        return centres.expand(count, -1, -1), splats.covariances2d.expand(count, -1, -1, -1)


def _check_planar(array: Array) -> None:
    heights = array.elements[:, 2].abs()
    if (heights > FLAT).any():
        raise ValueError(
            "rasterizer 'aperture' takes planar arrays, whose elements have z = 0 in the array's frame, got z up to "
            f"{heights.max():.3g} m; for spectra take rasterizer=fastest with pooling=array_response"
        )


def _seen(splats: Splats, amplitudes: Complex[Tensor, "b n"]) -> Complex[Tensor, "b n"]:
    """Amplitudes, 0 of what sits on the receiver and has no direction."""
    return torch.where(splats.visible, amplitudes, 0)


def _footprints(
    covariances: Float[Tensor, "b n 2 2"], steps: Float[Tensor, "k 2"], wavelengths: Float[Tensor, "b 1 1"]
) -> Float[Tensor, "b n k"]:
    """exp(-(2 pi)² D' S D / 2) of each splat and step D [m]."""
    squares = (steps[:, :, None] * steps[:, None]).flatten(1)
    return ((-0.5 * (2 * math.pi / wavelengths) ** 2) * (covariances.flatten(2) @ squares.T)).exp()
