"""Free space, reflection, the beamformer of an array, and gains of measured channels."""

import math

import torch
from jaxtyping import Complex, Float, Inexact, Int
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.antenna import Array, differences
from gaigs.core.geometry import Directions
from gaigs.core.query import check_carrier

NEAREST = 1e-2
"""Smallest distance of a spherical wave [m]; smaller ones count as this."""


def free_space(
    distances: Float[Tensor, "*#batch"], frequencies: Float[Tensor, "*#batch"], sign: int = -1
) -> Complex[Tensor, "*batch"]:
    """Field of a wave in free space, lambda / (4 pi d) exp(sign j 2 pi f d / c), in float64.

    Args:
        distances, frequencies: [m] and [Hz], broadcast against each other.
        sign: -1 for the time dependence exp(+j omega t), +1 for exp(-j omega t), 0 for the
            amplitude without a phase.

    Source: Friis, A note on a simple transmission formula, 1946.
    """
    per_metre = 2 * math.pi / speed_of_light
    phases = distances.double().clamp(min=NEAREST) * per_metre * frequencies.double()
    return torch.polar(0.5 / phases, sign * phases)


def bartlett(
    responses: Complex[Tensor, "*batch elements f"],
    grid: Directions,
    array: Array,
    frequency: float,
) -> Float[Tensor, "..."]:
    """Amplitudes of the conventional (Bartlett) beamformer, root mean square over frequencies.

    At one frequency the amplitude is |sum_n y_n exp(-j 2 pi / lambda (r_n . u))| for elements n at
    r_n and the direction u. Its square is a sum over the distinct vectors between elements: 49 for
    a 4 x 4 array, in place of 256 pairs.

    Args:
        responses: Linear amplitudes of the array's elements at each frequency (..., e, f), for the
            time dependence exp(+j omega t).
        grid: Directions in the array's frame [rad].
        array: Positions of the elements [m].
        frequency: Carrier of the weights [Hz].

    Returns:
        Amplitudes (..., rows, columns), or (..., k) for ``Rays``. The gradient is 0 where the
        amplitude is 0.

    Source: Bartlett, Smoothing periodograms from time series with continuous spectra, 1948; the
    spectra of NeRF².

    Example:
        >>> from gaigs.core.propagation import bartlett
        >>> array, grid = gaigs.Array.planar(4, 4, pitch=0.16), gaigs.Grid.degrees()
        >>> waves = torch.ones(1, 16, 1, dtype=torch.complex64)  # a wave from straight ahead
        >>> spectrum = bartlett(waves, grid, array, frequency=920e6)[0]
        >>> spectrum.shape, round(spectrum[-1, 0].item(), 3)  # at the zenith all sixteen add up
        (torch.Size([90, 360]), 16.0)
    """
    check_carrier("frequency", frequency)
    if not responses.is_complex() or responses.ndim < 2 or responses.shape[-2] != len(array):
        raise ValueError(
            f"responses must be complex (..., elements, frequencies) of {len(array)} elements, got "
            f"{responses.dtype} {tuple(responses.shape)}"
        )
    batch = responses.shape[:-2]
    responses = responses.flatten(0, -3) if responses.ndim > 2 else responses[None]  # (b, e, f)
    covariances = responses @ responses.mH / responses.shape[-1]  # mean over frequencies (b, e, e)
    places = array.elements.double() * (2 * frequency / speed_of_light)  # in half wavelengths
    steps, pair = differences(places)
    pair = pair.to(responses.device)
    # Pairs of elements with the same lag add up: the power depends on their sums alone.
    lags = covariances.new_zeros(len(responses), len(steps))
    lags = lags.index_add(1, pair, covariances.flatten(1))  # (b, lags)
    directions = grid.to(torch.float64).flatten().vectors().to(steps)  # (k, 3)
    phases = math.pi * steps @ directions.T  # (lags, k)
    cosines = torch.cos(phases).to(lags.real)
    sines = torch.sin(phases).to(lags.real)
    power = lags.real @ cosines + lags.imag @ sines  # (b, k)
    # In a null rounding may leave the power a little below zero. The root of 1 in its place has a
    # finite gradient.
    is_positive = power > 0
    amplitudes = torch.where(is_positive, power, 1).sqrt() * is_positive
    return amplitudes.reshape(*batch, *grid.shape)


def min_max(spectra: Float[Tensor, "b rows columns"]) -> Float[Tensor, "b rows columns"]:
    """Each spectrum scaled to [0, 1], as NeRF² labels are."""
    low = spectra.amin((1, 2), keepdim=True)
    high = spectra.amax((1, 2), keepdim=True)
    return (spectra - low) / (high - low)


def fresnel(
    permittivity: complex | Complex[Tensor, "*#batch"], cosines: Float[Tensor, "*#batch"]
) -> tuple[Complex[Tensor, "*batch"], Complex[Tensor, "*batch"]]:
    """Fresnel reflection coefficients of a half-space.

    The first is for the electric field across the plane of incidence (TE), the second for the field
    in this plane (TM).

    Args:
        permittivity: Complex relative permittivity, for the time dependence exp(+j omega t).
        cosines: Cosine of the angle of incidence, from the surface's normal.

    Source: Fresnel's formulas in the form of ITU-R P.2040-3.
    """
    root = torch.sqrt(permittivity - (1 - cosines.square()))
    te = (cosines - root) / (cosines + root)
    tm = (permittivity * cosines - root) / (permittivity * cosines + root)
    return te, tm


def slab(
    permittivity: complex | Complex[Tensor, "*#batch"],
    cosines: Float[Tensor, "*#batch"],
    thickness: float | Float[Tensor, "*#batch"],
) -> tuple[Complex[Tensor, "*batch"], Complex[Tensor, "*batch"]]:
    """Reflection coefficients TE and TM of a slab in air, in the form of ``fresnel``.

    ``thickness`` is in wavelengths in air. A thick lossy slab reflects like a half-space.

    Source: ITU-R P.2040-3, section 2.2.2.2.
    """
    # The wave through the slab and back, relative to the wave at the first face.
    root = torch.sqrt(permittivity - (1 - cosines.square()))
    turns = torch.exp(-4j * math.pi * thickness * root)
    te, tm = fresnel(permittivity, cosines)
    slab_te = te * (1 - turns) / (1 - te.square() * turns)
    slab_tm = tm * (1 - turns) / (1 - tm.square() * turns)
    return slab_te, slab_tm


def fit_gain(
    channels: Complex[Tensor, " k *shape"], waves: Complex[Tensor, " k *shape"]
) -> Complex[Tensor, ""]:
    """The complex gain, complex128, of measured channels h relative to computed waves w.

    Its magnitude is the median over links of |h| / |w|. Its phase is the phase of the sum of w* h /
    (|w| |h|), where weak links count as much as strong ones. Links with h = 0 or w = 0 do not
    count; without other links the gain is 0.
    """
    h = channels.to(torch.complex128).flatten(1)  # (k, numbers)
    w = waves.to(torch.complex128).flatten(1)
    h_sizes = h.norm(dim=1)
    w_sizes = w.norm(dim=1)
    counts = (h_sizes > 0) & (w_sizes > 0)
    if not counts.any():
        return torch.zeros((), dtype=torch.complex128, device=h.device)
    correlations = (w.conj() * h).sum(1)[counts] / (h_sizes * w_sizes)[counts]
    magnitude = (h_sizes / w_sizes)[counts].quantile(0.5)
    return magnitude * correlations.sum().sgn()


def common_gain(gains: Inexact[Tensor, " r *shape"]) -> Inexact[Tensor, " *shape"]:
    """Gain expected of an unknown receiver: the mean over receivers.

    Complex gains give their root mean square with the phase of their mean. Phases of cables differ,
    so a plain mean would cancel.
    """
    if not gains.is_complex():
        return gains.mean(0)
    return gains.abs().square().mean(0).sqrt() * gains.sum(0).sgn()


def strength(
    channels: Complex[Tensor, "k e s"],
    waves: Complex[Tensor, "k e s"],
    receivers: Int[Tensor, " k"],
) -> float:
    """Ratio of amplitudes, channels to waves: a median over links, a geometric mean over receivers.

    It is 1 if all channels are 0.
    """
    logs = []
    for receiver in receivers.unique():
        at_receiver = receivers == receiver
        gain = fit_gain(channels[at_receiver], waves[at_receiver]).abs()
        if gain > 0:
            logs.append(gain.log())
    return torch.stack(logs).mean().exp().item() if logs else 1.0
