"""Sums of propagation paths at the elements of an array, in closed form and without a map."""

import math
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass

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
    """Propagation paths to one receiver. A path arrives from a Gaussian, whose extent is the path's
    angular spread.

    Attributes:
        means: Centres of the Gaussians, world frame (b, n, 3) [m].
        semi_axes: Of the Gaussians, world frame, a column for each axis (1 or b, n, 3, 3) [m].
        amplitudes: Complex field of each path at the carrier, in the middle of the array (b, n).
        lengths: From the transmitter to the middle of the array (b, n) [m].
        coherences: Share of each path's field whose phase is known, in [0, 1] (n,). The rest adds
            as power.
        bandwidth: Band over which powers are averaged, a scalar [Hz]; None for the carrier alone.
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
    """Base of poolings that read paths, so that nothing is projected or rasterized.

    Attributes:
        is_same_for_all: True if no receiver's pose or array matters, so that paths to several may
            be summed at once.
    """

    is_same_for_all = False

    def forward(
        self, paths: ReceivedPaths, query: Query, directions: Directions | None = None
    ) -> Tensor:
        return self.read(self.sum_paths(paths), query, directions)

    @abstractmethod
    def sum_paths(self, paths: ReceivedPaths) -> Complex[Tensor, "b ..."]:
        """Sum of the paths at the elements of the receiver's array."""

    @abstractmethod
    def read(
        self, received: Complex[Tensor, "b ..."], query: Query, directions: Directions | None = None
    ) -> Tensor:
        """The label from the result of ``sum_paths``; arguments as for ``forward``."""


class LagPooling(PathPooling):
    """Base of poolings that read the covariance of the array's elements, in which powers add.

    Args:
        scene: Its receivers have planar arrays; others raise a ``ValueError``.
    """

    def __init__(self, scene: Scene):
        super().__init__()
        self.is_same_for_all = all(receiver.array.is_point for receiver in scene.receivers)
        for receiver in scene.receivers:
            height = receiver.array.elements[:, 2].abs().max()
            if height > 1e-6:  # [m]; float32 places metres no better
                raise ValueError(
                    f"a pooling of path powers takes planar arrays, got z up to {height:.3g} m in {receiver.name}\n"
                    "take projection=mercator rasterizer=fastest and a pooling of maps, such as array_response"
                )

    def sum_paths(self, paths: ReceivedPaths) -> Complex[Tensor, "b l"]:
        """Mean covariance of the pairs of elements that are ``array.lags`` apart; at lag 0 it is
        the power.

        Where powers add, elements a lag D apart, in wavelengths, have

            sum |A|² exp(-(2 pi)² D' S D / 2 + j 2 pi D . u)

        with u a path's direction cosines, which shrink to 0 within ``NEAREST`` of the array's
        middle, and S their covariance: the Gaussian's, and that of ``LEAST_SPREAD``. Two paths
        interfere by the product of their coherences, and over a band by sinc(bandwidth (t - t')),
        with t their delays: the mean over the band of cos(2 pi f (t - t')).
        """
        array, amplitudes, coherences = paths.receiver.array, paths.amplitudes, paths.coherences
        steps = array.lags[0].to(paths.lengths)
        if array.is_point:  # a power has no directions
            heard = lambda places: amplitudes.new_ones(1, 1, len(places))
        else:
            heard = _steering(paths)
        # Half of the lags are the conjugates of the others.
        powers = torch.view_as_real(amplitudes).square().sum(-1) * (1 - coherences.square())
        later = (powers[..., None] * heard(steps[len(steps) // 2 :])).sum(1)
        found = torch.cat((later[:, 1:].conj().flip(1), later), 1)
        sure = coherences.nonzero()[:, 0]  # the others have no phase
        if not len(sure):
            return found
        waves = ((amplitudes * coherences)[..., None] * heard(array.elements.to(steps)))[:, sure]
        if paths.bandwidth is None:
            field = waves.sum(1)[..., None]
            covariance = field @ field.mH
        else:
            turns = paths.bandwidth / speed_of_light * paths.lengths[:, sure]
            likeness = sinc(turns[:, :, None] - turns[:, None])
            alike = likeness @ torch.view_as_real(waves).flatten(
                2
            )  # real products take half the time of complex ones
            covariance = torch.view_as_complex(alike.unflatten(2, (-1, 2))).mT @ waves.conj()
        return found + array.by_lag(covariance)


LEAST_SPREAD = Grid.sphere(24, 48).pitch / math.sqrt(12)
"""Least standard deviation of a path's direction cosines where powers add: that of a pixel of 24 x
48.
"""


def _steering(paths: ReceivedPaths) -> Callable[[Float[Tensor, "k 3"]], Complex[Tensor, "b n k"]]:
    """exp(-(2 pi)² D' S D / 2 + j 2 pi D . u) of each path at steps D in the array's plane [m]."""
    points, wavenumbers, across = _seen(paths)
    angles = wavenumbers * points / points.norm(dim=-1, keepdim=True).clamp_min(NEAREST)

    def response(steps: Tensor) -> Tensor:
        least = (LEAST_SPREAD * wavenumbers).square() * steps.square().sum(-1)
        return polar(((_spreads(across, steps) + least) / -2).exp(), angles @ steps.T)

    return response


def _seen(
    paths: ReceivedPaths,
) -> tuple[Float[Tensor, "b n 3"], Float[Tensor, "b 1 1"], Float[Tensor, "b n 3 3"]]:
    """Gaussians' centres in the array's frame [m], wavenumbers [1/m], and semi-axes across the way
    [rad/m].

    The last are angles as the middle of the array sees them, times the wavenumber.
    """
    pose = paths.receiver.pose.to(paths.means)
    points, semi_axes = pose.local(paths.means), pose.rotation.mT @ paths.semi_axes
    wavenumbers = 2 * math.pi / speed_of_light * paths.carriers.to(points)[:, None, None]
    ways = points.norm(dim=-1, keepdim=True).clamp_min(NEAREST)
    units = (points / ways)[..., None]
    across = semi_axes - units * (units * semi_axes).sum(-2, keepdim=True)
    return points, wavenumbers, across * (wavenumbers / ways)[..., None]


def _spreads(
    across: Float[Tensor, "b n 3 3"], steps: Float[Tensor, "k 3"]
) -> Float[Tensor, "b n k"]:
    """(2 pi)² D' S D of each path at each step D [m]."""
    turns = (steps @ across.movedim(-2, 0).flatten(1)).view(len(steps), *across.shape[:2], 3)
    return turns.square().sum(-1).movedim(0, -1)


def element_fields(paths: ReceivedPaths, offsets: Float[Tensor, "b s"]) -> Complex[Tensor, "b e s"]:
    """Field at each element and frequency, all paths interfering.

    The wave of a path is spherical about the path's Gaussian, at an array of any shape and
    orientation. An element at x, in wavelengths from the middle, hears a path of the amplitude A,
    from the direction u, as

        A exp(-(2 pi)² x' S x / 2 - j 2 pi (|p - x| - |p|)) |p| / |p - x|

    with p the Gaussian's centre and S its covariance in direction cosines.

    ``offsets`` are frequencies over the carrier [Hz].

    Source: ours; the Fourier transform of a Gaussian, and Van Trees, Optimum Array Processing,
    2002, section 2.2.
    """
    amplitudes, lengths = paths.amplitudes, paths.lengths
    points, wavenumbers, across = _seen(paths)
    elements, exact = paths.receiver.array.elements.to(points), points.norm(dim=-1, keepdim=True)
    # Plain differences: by the matrix product an element far from a near point would lose its
    # digits.
    own = torch.cdist(points, elements, compute_mode="donot_use_mm_for_euclid_dist")
    to_elements, ways = own.clamp_min(NEAREST), exact.clamp_min(NEAREST)
    # The difference of two lengths, without the digits that it would lose.
    both = own + exact
    longer = (elements.square().sum(-1) - 2 * points @ elements.T) / torch.where(both > 0, both, 1)
    longer = longer + (to_elements - own) - (ways - exact)
    spreads = _spreads(across, elements)
    waves = amplitudes[..., None] * polar(
        (spreads / -2).exp() * (ways / to_elements), -wavenumbers * longer
    )
    reach = float(elements.norm(dim=-1).amax()) / speed_of_light
    rates = -2 * math.pi * offsets.to(lengths)
    turned = lambda delays: torch.polar(torch.ones_like(delays), delays)
    widest = (
        reach * float(rates.abs().amax()) if rates.numel() else 0.0
    )  # phase of the band over the array [rad]
    if widest > 3:
        delays = (lengths[..., None] + longer) / speed_of_light
        return (waves[..., None] * turned(delays[..., None] * rates[:, None, None])).sum(1)
    # exp(j rate (t + dt)) = exp(j rate t) sum_k (j rate dt)^k / k!: one product of matrices, and no
    # wave of each path, element and frequency. |dt| is at most the reach. Up to 3 rad the terms of
    # the series stay small.
    terms, size = [waves], widest
    while size > torch.finfo(lengths.dtype).eps:
        terms.append(terms[-1] * (longer * (1j / (reach * speed_of_light * len(terms)))))
        size *= widest / len(terms)
    middle = turned(lengths[..., None] / speed_of_light * rates[:, None])
    sums = torch.stack(terms, 2).flatten(2).mT @ middle  # (b, terms x e, s)
    powers = (reach * rates)[:, None] ** torch.arange(len(terms), device=rates.device)[:, None]
    return (sums.unflatten(1, (len(terms), -1)) * powers[:, :, None]).sum(1)
