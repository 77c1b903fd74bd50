"""Sums of propagation paths at the elements of an array, in closed form and without a map."""

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Directions, Grid, polar, sinc
from gaigs.core.propagation import NEAREST
from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.splatting.pooling import Pooling


@dataclass(frozen=True)
class ReceivedPaths:
    """Propagation paths to one receiver.

    A path arrives from a Gaussian, whose extent is the angular spread of the path.

    Attributes:
        means: Centres of the Gaussians, world frame (b, n, 3) [m].
        semi_axes: Axes of the Gaussians in columns, world frame (1 or b, n, 3, 3) [m].
        amplitudes: Complex field of each path at the carrier, in the middle of the array (b, n).
        lengths: Path length from the transmitter to the middle of the array (b, n) [m].
        coherences: Fraction of each path's field with a known phase, in [0, 1] (n,). The power of
            the rest is added without interference.
        bandwidth: Band over which powers are averaged, a scalar [Hz]; None: a single carrier.
        receiver: Pose and array of the receiver.
        carriers: Frequency of each query (b,) [Hz].
    """

    means: Float[Tensor, "b n 3"]
    semi_axes: Float[Tensor, "c n 3 3"]
    amplitudes: Complex[Tensor, "b n"]
    lengths: Float[Tensor, "b n"]
    coherences: Float[Tensor, " n"]
    bandwidth: Float[Tensor, ""] | None
    receiver: Receiver
    carriers: Float[Tensor, " b"]


class PathPooling(Pooling):
    """Base of poolings that read paths, without projection and rasterizer.

    Attributes:
        is_same_for_all: True if poses and arrays of receivers have no effect, so that paths to
            several receivers may be summed at once.
    """

    is_same_for_all = False

    def forward(
        self, paths: ReceivedPaths, query: Query, directions: Directions | None = None
    ) -> Tensor:
        return self.read(self.sum_paths(paths), query, directions)

    @abstractmethod
    def sum_paths(self, paths: ReceivedPaths) -> Complex[Tensor, "b ..."]:
        """Sums the paths at the elements of the receiver's array."""

    @abstractmethod
    def read(
        self, received: Complex[Tensor, "b ..."], query: Query, directions: Directions | None = None
    ) -> Tensor:
        """Computes the label from the result of ``sum_paths``; arguments are as for ``forward``."""


class LagPooling(PathPooling):
    """Base of poolings that read covariances of the array's elements, by partly coherent paths.

    Args:
        scene: Scene whose receivers have planar arrays.

    Source: Van Trees, Optimum Array Processing, 2002, section 5.2, for covariances by lags; the
    partial coherence is ours.
    """

    # Least standard deviation of a path's direction cosines where powers add: the one of a pixel of
    # 24 x 48.
    least_spread: float = Grid.sphere(24, 48).pitch / math.sqrt(12)

    def __init__(self, scene: Scene):
        super().__init__()
        self.take_receivers(scene)

    def take_receivers(self, scene: Scene, known: Tensor | None = None) -> None:
        """Sets ``is_same_for_all`` for a scene's receivers, whose arrays must be planar."""
        self.is_same_for_all = all(receiver.array.is_point for receiver in scene.receivers)
        for receiver in scene.receivers:
            height = receiver.array.elements[:, 2].abs().max()
            if height > 1e-6:  # [m]; float32 places metres no better
                raise ValueError(
                    f"a pooling of path powers takes planar arrays, got z up to {height:.3g} m in "
                    f"{receiver.name}\ntake projection=mercator rasterizer=fastest and a pooling "
                    "of maps, such as array_response"
                )

    def sum_paths(self, paths: ReceivedPaths) -> Complex[Tensor, "b l"]:
        """Mean covariance of the pairs of elements at each of ``array.lags``.

        At lag 0 the covariance is the power. If powers add, elements at a lag D [wavelengths] have
        the covariance

            sum |A|² exp(-(2 pi)² D' S D / 2 + j 2 pi D . u)

        The sum is over paths, with amplitudes A. u are a path's direction cosines, which shrink to
        0 within ``NEAREST`` of the array's middle. S is the covariance of direction cosines, from
        the Gaussian and from ``least_spread``. The interference of two paths has the product of
        their coherences as a factor, and over a band also sinc(bandwidth (t - t')), with their
        delays t and t'. The sinc is the mean over the band of cos(2 pi f (t - t')).
        """
        array = paths.receiver.array
        amplitudes = paths.amplitudes  # (b, n)
        coherences = paths.coherences  # (n,)
        steering = _Steering(paths, self.least_spread)
        steps = array.lags[0].to(paths.lengths)  # (l, 3) [m]
        # The part of a path's power with an unknown phase adds without interference. Half of the
        # lags are the conjugates of the others.
        powers = torch.view_as_real(amplitudes).square().sum(-1) * (1 - coherences.square())
        later_steps = steps[len(steps) // 2 :]
        later = (powers[..., None] * steering.at(later_steps)).sum(1)  # (b, l / 2 + 1)
        lags = torch.cat((later[:, 1:].conj().flip(1), later), 1)  # (b, l)
        coherent = coherences.nonzero()[:, 0]
        if not len(coherent):
            return lags
        # The parts with a known phase interfere: eq. (2) at each element, and the products of two
        # elements. From here n counts paths with such a part.
        response = steering.at(array.elements.to(steps))  # (b, n, e)
        waves = ((amplitudes * coherences)[..., None] * response)[:, coherent]
        if paths.bandwidth is None:
            field = waves.sum(1)[..., None]  # (b, e, 1)
            return lags + array.by_lag(field @ field.mH)
        turns = paths.bandwidth / speed_of_light * paths.lengths[:, coherent]  # (b, n)
        likeness = sinc(turns[:, :, None] - turns[:, None])  # mean over the band (b, n, n)
        # Real products take half the time of complex ones.
        parts = torch.view_as_real(waves).flatten(2)  # (b, n, 2 e)
        alike = (likeness @ parts).unflatten(2, (-1, 2))  # (b, n, e, 2)
        covariance = torch.view_as_complex(alike).mT @ waves.conj()  # (b, e, e)
        return lags + array.by_lag(covariance)


class _Steering:
    """Responses of an array to n paths, at points D in its plane, relative to its middle.

    Args:
        paths: The paths.
        least_spread: As for ``LagPooling``.
    """

    def __init__(self, paths: ReceivedPaths, least_spread: float):
        self.amplitudes = paths.amplitudes
        self.is_point = paths.receiver.array.is_point
        if self.is_point:  # its response is 1 for all directions
            return
        points, wavenumbers, self.across = _see(paths)
        distances = points.norm(dim=-1, keepdim=True).clamp_min(NEAREST)  # (b, n, 1)
        self.wave_vectors = wavenumbers * points / distances  # (b, n, 3) [rad/m]
        self.least = (least_spread * wavenumbers).square()  # (b, 1, 1) [rad²/m²]

    def at(self, steps: Float[Tensor, "k 3"]) -> Complex[Tensor, "*b n k"]:
        """Response to each path at k points x [m], with D = x / lambda as in ``sum_paths``.

        It is exp(-(2 pi)² D' S D / 2 + j 2 pi D . u).
        """
        if self.is_point:
            return self.amplitudes.new_ones(1, 1, len(steps))
        spreads = _spreads(self.across, steps)  # (b, n, k)
        least = self.least * steps.square().sum(-1)  # (b, 1, k)
        return polar(((spreads + least) / -2).exp(), self.wave_vectors @ steps.T)


class _Seen(NamedTuple):
    """Gaussians in the frame of an array."""

    points: Float[Tensor, "b n 3"]  # centres in the array's frame [m]
    wavenumbers: Float[Tensor, "b 1 1"]  # 2 pi / lambda of each query [rad/m]
    # Parts of the semi-axes across the line of sight, as angles at the middle of the array, times
    # the wavenumber [rad/m].
    across: Float[Tensor, "b n 3 3"]


def _see(paths: ReceivedPaths) -> _Seen:
    """The paths' Gaussians in the frame of their receiver's array."""
    pose = paths.receiver.pose.to(paths.means)
    points = pose.local(paths.means)  # (b, n, 3)
    semi_axes = pose.rotation.mT @ paths.semi_axes  # (1 or b, n, 3, 3)
    wavenumbers = 2 * math.pi / speed_of_light * paths.carriers.to(points)[:, None, None]
    distances = points.norm(dim=-1, keepdim=True).clamp_min(NEAREST)  # (b, n, 1)
    units = (points / distances)[..., None]  # towards the Gaussians (b, n, 3, 1)
    along = (units * semi_axes).sum(-2, keepdim=True)  # (b, n, 1, 3)
    across = semi_axes - units * along
    return _Seen(points, wavenumbers, across * (wavenumbers / distances)[..., None])


def _spreads(
    across: Float[Tensor, "b n 3 3"], steps: Float[Tensor, "k 3"]
) -> Float[Tensor, "b n k"]:
    """(2 pi / lambda)² x' S x of each path at each step x [m]; S as in ``sum_paths``.

    ``across`` is as in ``_Seen``: its product with its transpose is (2 pi / lambda)² S.
    """
    # One matrix product for all paths.
    rows = across.movedim(-2, 0).flatten(1)  # (3, b n 3)
    turns = (steps @ rows).view(len(steps), *across.shape[:2], 3)  # (k, b, n, 3)
    return turns.square().sum(-1).movedim(0, -1)


def element_fields(paths: ReceivedPaths, offsets: Float[Tensor, "b s"]) -> Complex[Tensor, "b e s"]:
    """Field at each element and frequency, with interference of all paths.

    The wave of a path is spherical about the path's Gaussian. The array may have any shape and
    orientation. At an element x the field of a path with the amplitude A is

        A exp(-(2 pi)² x' S x / 2 - j 2 pi (|p - x| - |p|)) |p| / |p - x|

    with p the Gaussian's centre and S its covariance in direction cosines. Positions are in
    wavelengths from the middle of the array.

    Args:
        paths: Paths to one receiver.
        offsets: Frequencies relative to the carrier [Hz].

    Source: GAI-GS, eq. (2), for the sum; the Fourier transform of a Gaussian; Van Trees, Optimum
    Array Processing, 2002, section 2.2. Their combination is ours.
    """
    points, wavenumbers, across = _see(paths)
    elements = paths.receiver.array.elements.to(points)  # (e, 3) [m]
    longer = _path_differences(points, elements)
    spreads = _spreads(across, elements)  # (b, n, e)
    decays = (spreads / -2).exp() * longer.ratios
    waves = paths.amplitudes[..., None] * polar(decays, -wavenumbers * longer.differences)
    reach = float(elements.norm(dim=-1).amax()) / speed_of_light  # largest delay over the array [s]
    rates = -2 * math.pi * offsets.to(paths.lengths)  # (b, s) [rad/s]
    # Largest phase of the band over the array [rad].
    widest = reach * float(rates.abs().amax()) if rates.numel() else 0.0
    if widest > 3:  # the series would need many terms
        delays = (paths.lengths[..., None] + longer.differences) / speed_of_light  # (b, n, e)
        turns = _unit_waves(delays[..., None] * rates[:, None, None])  # (b, n, e, s)
        return (waves[..., None] * turns).sum(1)
    return _sum_by_series(paths.lengths, longer.differences, waves, rates, reach, widest)


class _PathDifferences(NamedTuple):
    """Distances from points to the elements, minus the distance to the array's middle."""

    differences: Float[Tensor, "b n e"]  # |p - x| - |p| [m]
    ratios: Float[Tensor, "b n e"]  # |p| / |p - x|, each at least ``NEAREST``


def _path_differences(
    points: Float[Tensor, "b n 3"], elements: Float[Tensor, "e 3"]
) -> _PathDifferences:
    """Distances from points p to elements x minus distances to the middle, without cancellation.

    ``NEAREST`` is the least distance in differences and ratios.
    """
    to_middle = points.norm(dim=-1, keepdim=True)  # |p|, (b, n, 1)
    # Plain differences: by the matrix product an element far from a near point would lose its
    # digits.
    to_elements = torch.cdist(points, elements, compute_mode="donot_use_mm_for_euclid_dist")
    far_elements = to_elements.clamp_min(NEAREST)
    far_middle = to_middle.clamp_min(NEAREST)
    # |p - x| - |p| = (x² - 2 p . x) / (|p - x| + |p|), without the digits that a difference loses.
    total = to_elements + to_middle
    squares = elements.square().sum(-1) - 2 * points @ elements.T  # (b, n, e)
    longer = squares / torch.where(total > 0, total, 1)
    # The changes by the least distance, which are mostly 0.
    longer = longer + (far_elements - to_elements) - (far_middle - to_middle)
    return _PathDifferences(longer, far_middle / far_elements)


def _sum_by_series(
    lengths: Float[Tensor, "b n"],  # from the transmitter to the middle of the array [m]
    longer: Float[Tensor, "b n e"],  # further way to each element [m]
    waves: Complex[Tensor, "b n e"],  # field of each path at each element, at the carrier
    rates: Float[Tensor, "b s"],  # change of phase by delay at each frequency [rad/s]
    reach: float,  # largest delay over the array [s]
    widest: float,  # largest phase of the band over the array [rad]
) -> Complex[Tensor, "b e s"]:
    """Fields at elements and frequencies, summed over paths by matrix products of a series.

        exp(j rate (t + dt)) = exp(j rate t) sum_k (j rate dt)^k / k!

    t is the delay of a path to the middle of the array, and dt its further delay to an element.
    |dt| is at most ``reach``. Terms of the series are small while rate dt is at most 3 rad.
    """
    # waves (j dt / reach)^k / k!, until the largest term (rate reach)^k / k! is below rounding.
    terms = [waves]
    size = widest
    while size > torch.finfo(lengths.dtype).eps:
        step = longer * (1j / (reach * speed_of_light * len(terms)))
        terms.append(terms[-1] * step)
        size *= widest / len(terms)
    middle = _unit_waves(lengths[..., None] / speed_of_light * rates[:, None])  # (b, n, s)
    sums = torch.stack(terms, 2).flatten(2).mT @ middle  # (b, terms x e, s)
    exponents = torch.arange(len(terms), device=rates.device)[:, None]  # k
    powers = (reach * rates)[:, None] ** exponents  # (b, terms, s)
    return (sums.unflatten(1, (len(terms), -1)) * powers[:, :, None]).sum(1)


def _unit_waves(phases: Float[Tensor, "*shape"]) -> Complex[Tensor, "*shape"]:
    """exp(j phase)."""
    return torch.polar(torch.ones_like(phases), phases)
