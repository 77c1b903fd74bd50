"""Log-distance path loss of levels (the law of distance), fitted under several conventions."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.data.checks.hypotheses import Sample


class Law(NamedTuple):
    """Law of distance of each receiver: level = constant + slope log10(distance).

    A leading axis h, if any, is for h conventions of the data.
    """

    slopes: Float[Tensor, "*h r"]  # slope of each receiver, -60 to 0 [dB per decade]
    errors: Float[Tensor, "*h n"]  # level of each link minus the law [dB]


class Gain(NamedTuple):
    """Improvement of the law of distance under another convention."""

    read: float  # mean error of the data as read [dB]
    fits: float  # mean error under the other convention [dB]
    evidence: float  # gain of the log likelihood

    def is_clear(self, share: float = 0.85, evidence: float = 8.0) -> bool:
        """True if the ratio of errors is below ``share``, and ``evidence`` is exceeded."""
        return self.fits < share * self.read and self.evidence > evidence


def decades(sample: Sample) -> Float[Tensor, " n"]:
    """Decimal logarithm of each link's distance in metres, from ``decades_of``."""
    offsets = sample.transmitters - sample.positions[sample.receivers]  # (n, 3)
    return decades_of(offsets.norm(dim=1))


def decades_of(distances: Float[Tensor, "*h n"]) -> Float[Tensor, "*h n"]:
    """Decimal logarithms of distances [m].

    Distances below a hundredth of the median count as a hundredth of the median.
    """
    least = 0.01 * distances.median(-1, keepdim=True).values
    return torch.maximum(distances, least).clamp_min(1e-9).log10()


def fit_law(logarithms: Float[Tensor, "*h n"], sample: Sample, patterns: bool = False) -> Law:
    """The law of distance of each receiver, fitted robustly with Huber's weights.

    Args:
        logarithms: Decimal logarithms of the links' distances, for h conventions at once.
        sample: Receivers and levels of the links.
        patterns: True to fit also a cosine and a sine of the azimuth, for directional receivers;
            ``logarithms`` are then (n,).

    Source: Huber, Robust estimation of a location parameter, 1964.
    """
    # Terms that are fitted beside the slope: the constant, and the harmonic of the azimuth.
    terms = torch.ones_like(logarithms)[..., None]  # (*h, n, 1)
    if patterns:
        x, y, _ = (sample.transmitters - sample.positions[sample.receivers]).T
        azimuths = torch.atan2(y, x)
        terms = torch.stack((torch.ones_like(x), azimuths.cos(), azimuths.sin()), 1)  # (n, 3)
    levels = sample.labels.expand_as(logarithms)
    weights = torch.ones_like(logarithms)
    # Reweighted least squares: an error beyond 1.345 deviations counts linearly.
    for _ in range(5):
        # Without the terms, the slope is that of one regressor (Frisch and Waugh, 1933).
        logarithms_left = _without(terms, logarithms, weights, sample)
        levels_left = _without(terms, levels, weights, sample)
        squares = _sums(weights * logarithms_left.square(), sample)  # (*h, r)
        products = _sums(weights * logarithms_left * levels_left, sample)  # (*h, r)
        # Levels fall with the distance, by its sixth power at most.
        slopes = (products / squares.clamp_min(1e-9)).clamp(-60, 0)
        errors = levels_left - slopes[..., sample.receivers] * logarithms_left
        # 1.4826 medians of normal absolute errors are a standard deviation. Huber's weight is
        # min(1, 1.345 scale / |error|).
        scale = 1.4826 * errors.abs().median(-1, keepdim=True).values
        weights = (1.345 * scale.clamp_min(0.1) / errors.abs().clamp_min(1e-9)).clamp_max(1)
    return Law(slopes, errors)


def explained(sample: Sample) -> float:
    """Fraction of the levels' mean absolute deviation that the law of distance explains."""
    errors = fit_law(decades(sample), sample).errors
    # With equal distances the law is the receiver's mean.
    deviations = fit_law(torch.zeros_like(errors), sample).errors
    unexplained = errors.abs().mean() / deviations.abs().mean().clamp_min(1e-9)
    return max(0.0, 1 - unexplained.item())


def compare(
    read: Float[Tensor, " n"], fits: Float[Tensor, " n"], sample: Sample, cells: int = 6
) -> Gain:
    """Improvement from the errors ``read`` of one law to the errors ``fits`` of another [dB].

    Errors above 30 dB count as 30 dB. Shadowing is similar at nearby places, so all links of a
    receiver in a cell of the floor plan are one observation. There are at most ``cells`` cells
    along x and along y. The log likelihood of m observations with a mean error of s is -m log(s),
    up to a constant.
    """
    before = read.abs().clamp_max(30).mean().item()
    after = fits.abs().clamp_max(30).mean().item()
    places = sample.transmitters[:, :2]
    low, high = places.amin(0), places.amax(0)
    relative = (places - low) / (high - low).max().clamp_min(1e-9)
    cell = (relative * cells).long().clamp_max(cells - 1)  # (n, 2)
    # One number for each combination of receiver, column and row of cells.
    keys = (sample.receivers * cells + cell[:, 0]) * cells + cell[:, 1]
    observations = len(keys.unique())
    log_ratio = math.log(max(before, 1e-9) / max(after, 1e-9))
    return Gain(before, after, observations * log_ratio)


def _sums(values: Float[Tensor, "*h n"], sample: Sample) -> Float[Tensor, "*h r"]:
    """Sums of the links' values at each receiver."""
    zeros = values.new_zeros((*values.shape[:-1], len(sample.positions)))
    return zeros.index_add_(-1, sample.receivers, values)


def _without(
    terms: Float[Tensor, "*h n c"],
    values: Float[Tensor, "*h n"],
    weights: Float[Tensor, "*h n"],
    sample: Sample,
) -> Float[Tensor, "*h n"]:
    """Values minus their weighted least-squares fit by ``terms``, separately at each receiver.

    A single term is the constant 1; several terms have no axis h.
    """
    if terms.shape[-1] == 1:
        means = _sums(weights * values, sample) / _sums(weights, sample).clamp_min(1e-9)
        return values - means[..., sample.receivers]
    columns = terms.mT  # (c, n)
    # Normal equations of each receiver: squares @ coefficients = products.
    squares = _sums(weights * columns[:, None] * columns, sample)  # (c, c, r)
    products = _sums(weights * columns * values, sample)  # (c, r)
    ridge = 1e-9 * torch.eye(len(columns), dtype=values.dtype)  # for a receiver of few links
    coefficients = torch.linalg.solve(squares.permute(2, 0, 1) + ridge, products.T)  # (r, c)
    return values - (terms * coefficients[sample.receivers]).sum(1)
