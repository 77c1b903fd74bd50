"""Log-distance path loss of levels (the law of distance), fitted under several conventions."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.data.checks.hypotheses import Sample


class Law(NamedTuple):
    """Levels of each receiver as a + b log10(distance), with b from -60 to 0 dB a decade."""

    slopes: Float[Tensor, "*h r"]  # b of each receiver [dB per decade]
    errors: Float[Tensor, "*h n"]  # levels less the law [dB]


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
    return decades_of((sample.transmitters - sample.positions[sample.receivers]).norm(dim=1))


def decades_of(distances: Float[Tensor, "*h n"]) -> Float[Tensor, "*h n"]:
    """Decimal logarithms of distances [m]; shorter ones count as a hundredth of the median."""
    least = 0.01 * distances.median(-1, keepdim=True).values
    return torch.maximum(distances, least).clamp_min(1e-9).log10()


def fit_law(logarithms: Float[Tensor, "*h n"], sample: Sample, patterns: bool = False) -> Law:
    """The law of distance of each receiver, fitted robustly with Huber's weights.

    Args:
        logarithms: Decimal logarithms of the links' distances, for h conventions at once.
        sample: Receivers and levels of the links.
        patterns: True to fit also a harmonic of the azimuth, for directional receivers;
            ``logarithms`` are then (n,).

    Source: Huber, Robust estimation of a location parameter, 1964.
    """
    others = torch.ones_like(logarithms)[..., None]  # (*h, n, c), fitted beside the slope
    if patterns:
        x, y, _ = (sample.transmitters - sample.positions[sample.receivers]).T
        azimuths = torch.atan2(y, x)
        others = torch.stack((torch.ones_like(x), azimuths.cos(), azimuths.sin()), 1)
    levels = sample.labels.expand_as(logarithms)
    weights = torch.ones_like(logarithms)
    # Reweighted least squares: an error beyond 1.345 deviations counts linearly.
    for _ in range(5):
        x = _without(others, logarithms, weights, sample)
        y = _without(others, levels, weights, sample)
        squares = _sums(weights * x.square(), sample)  # (*h, r)
        # Levels fall with the distance, by its sixth power at most.
        slopes = (_sums(weights * x * y, sample) / squares.clamp_min(1e-9)).clamp(-60, 0)
        errors = y - slopes[..., sample.receivers] * x
        # 1.4826 medians of normal absolute errors are a standard deviation.
        scale = 1.4826 * errors.abs().median(-1, keepdim=True).values
        weights = (1.345 * scale.clamp_min(0.1) / errors.abs().clamp_min(1e-9)).clamp_max(1)
    return Law(slopes, errors)


def explained(sample: Sample) -> float:
    """Fraction of the levels' mean absolute deviation that the law of distance explains."""
    law = fit_law(decades(sample), sample)
    mean = fit_law(torch.zeros_like(law.errors), sample)
    return max(0.0, 1 - (law.errors.abs().mean() / mean.errors.abs().mean().clamp_min(1e-9)).item())


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
    keys = (sample.receivers * cells + cell[:, 0]) * cells + cell[:, 1]
    observed = len(keys.unique())
    return Gain(before, after, observed * math.log(max(before, 1e-9) / max(after, 1e-9)))


def _sums(values: Float[Tensor, "*h n"], sample: Sample) -> Float[Tensor, "*h r"]:
    """Sums over the links of each receiver."""
    zeros = values.new_zeros((*values.shape[:-1], len(sample.positions)))
    return zeros.index_add_(-1, sample.receivers, values)


def _without(
    others: Float[Tensor, "*h n c"],
    values: Float[Tensor, "*h n"],
    weights: Float[Tensor, "*h n"],
    sample: Sample,
) -> Float[Tensor, "*h n"]:
    """Values minus their weighted least-squares fit by the columns ``others``, at each receiver."""
    if others.shape[-1] == 1:
        means = _sums(weights * values, sample) / _sums(weights, sample).clamp_min(1e-9)
        return values - means[..., sample.receivers]
    columns = others.mT  # (c, n)
    squares = _sums(weights * columns[:, None] * columns, sample)  # (c, c, r)
    products = _sums(weights * columns * values, sample)  # (c, r)
    ridge = 1e-9 * torch.eye(len(columns), dtype=values.dtype)
    coefficients = torch.linalg.solve(squares.permute(2, 0, 1) + ridge, products.T)  # (r, c)
    return values - (others * coefficients[sample.receivers]).sum(1)
