"""Scores of intervals: how often they hold the label, and how wide they are."""

import math

import numpy as np
import torch
from jaxtyping import Bool, Float, Inexact
from torch import Tensor

from gaigs.calibration.conformal import Calibration, Estimate, Thinned
from gaigs.core.query import Query, evenly


def holds(estimate: Estimate, labels: Inexact[Tensor, " k *shape"]) -> Bool[Tensor, " k *shape"]:
    """True for each value of aligned labels that is within its interval."""
    if estimate.radius is not None:
        return (labels - estimate.value).abs() <= estimate.radius
    return (estimate.lower <= labels) & (labels <= estimate.upper)  # type: ignore[operator]


def interval_scores(
    labels: Inexact[Tensor, " k *shape"], half: Estimate, most: Estimate
) -> dict[str, Float[Tensor, " k"]]:
    """Scores of the intervals of k links, by name.

    ``coverage_50`` and ``coverage_90`` are the shares of a label's values within its intervals of
    50 and 90 %, and ``width_90`` is the width of the latter. ``crps`` [label's unit] and ``nll``,
    -log p, assume a normal distribution with the estimate's ``std``. For channels they are means
    over real and imaginary part.

    Args:
        labels: Labels, aligned to the predictions.
        half, most: Estimates with intervals of 50 % and of 90 %.

    Source: Gneiting and Raftery, Strictly proper scoring rules, prediction, and estimation, 2007.
    """
    std = most.std
    errors = labels - most.value
    if errors.is_complex():
        errors = torch.view_as_real(errors)  # (k, *shape, 2)
        std = (std / math.sqrt(2))[..., None].expand(*std.shape, 2)
    # A deviation of 0, where the model is exact, becomes the smallest one above 0.
    std = std.double().clamp_min(torch.finfo(torch.float32).tiny)
    z = errors.double() / std
    density = torch.exp(-z.square() / 2) / math.sqrt(2 * math.pi)
    crps = std * (z * torch.erf(z / math.sqrt(2)) + 2 * density - 1 / math.sqrt(math.pi))
    nll = z.square() / 2 + std.log() + math.log(2 * math.pi) / 2
    if most.radius is not None:
        width = 2 * most.radius
    else:
        width = most.upper - most.lower  # type: ignore[operator]
    parts = {
        "coverage_50": holds(half, labels),
        "coverage_90": holds(most, labels),
        "width_90": width,
        "crps": crps,
        "nll": nll,
    }
    is_absent = most.std.isnan()
    means = {}
    for name, part in parts.items():
        numbers = part.double().reshape(*most.value.shape, -1).mean(-1)  # (k, *shape)
        numbers = numbers.masked_fill(is_absent, math.nan)
        means[name] = numbers[..., None].flatten(1).nanmean(1)  # (k,)
    return means


def scores_of_links(
    calibration: Calibration, links: Thinned, query: Query, size: int = 64
) -> dict[str, Float[Tensor, " k"]]:
    """``interval_scores`` of predictions, with two more columns for ``summarise_intervals``.

    ``calibration_links`` is the number of calibrating links. ``places`` identifies the place of
    each link. ``size`` links are scored at a time, since estimates take ten times the labels'
    memory.
    """
    parts = []
    for rows in torch.arange(len(query)).split(size):
        arguments = links.values[rows], links.deviations[rows], query[rows]
        half, most = calibration.estimates(*arguments, [0.5, 0.9])
        parts.append(interval_scores(links.labels[rows], half, most))
    scores = {}
    for name in parts[0]:
        scores[name] = torch.cat([part[name] for part in parts])
    scores["calibration_links"] = torch.full((len(query),), float(calibration.counts.sum()))
    _, place_numbers = query.place_keys.unique(return_inverse=True)
    scores["places"] = place_numbers.double()
    return scores


def shares_within(
    calibration: Calibration, links: Thinned, query: Query, most: int = 300
) -> np.ndarray:
    """Shares of label values within intervals of levels 0.05, 0.1, ..., 0.95 (19,).

    At most ``most`` links are used. A share is NaN if too few links calibrate its level.
    """
    rows = evenly(torch.arange(len(query)), most)
    arguments = links.values[rows], links.deviations[rows], query[rows]
    levels = np.arange(1, 20) / 20
    shares = np.full(len(levels), math.nan)
    given = [number for number, level in enumerate(levels) if calibration.gives(level)]
    estimates = calibration.estimates(*arguments, levels[given].tolist())
    for number, estimate in zip(given, estimates, strict=True):
        exists = ~estimate.std.isnan()
        shares[number] = holds(estimate, links.labels[rows])[exists].double().mean().item()
    return shares


def summarise_intervals(scores: dict[str, Tensor]) -> dict[str, float]:
    """Means of ``scores_of_links`` over links, and standard errors of the coverages.

    The standard errors are named ``coverage_50_error`` and ``coverage_90_error``.
    """
    numbers = {}
    for name, score in scores.items():
        if name == "places":
            continue
        numbers[name] = score.mean().item()
        if name.startswith("coverage"):
            calibrating = scores["calibration_links"].mean().item()
            level = int(name[-2:]) / 100
            places = scores["places"].long()
            numbers[f"{name}_error"] = coverage_error(score, level, places, calibrating)
    return numbers


def coverage_error(
    score: Float[Tensor, " k"], level: float, places: Tensor, calibration_links: float
) -> float:
    """Standard error of a mean coverage of intervals; NaN with one place.

    Links at one place depend on each other; different places count as independent. The calibrating
    links are a sample, too, so a small number of them adds to the error. If all links have the same
    score, the variance is taken as level (1 - level).

    Args:
        score: Share of each link's values that its interval holds.
        level: Probability of the interval.
        places: Number of each link's place.
        calibration_links: Number of links that calibrated the interval.

    Source: Cameron and Miller, A practitioner's guide to cluster-robust inference, 2015.
    """
    count = len(score)
    sums = places.bincount(score - score.mean())  # (places,), of deviations from the mean
    if len(sums) <= 1:
        return math.nan
    # Variance of a link's share, from independent errors of the places, with Bessel's correction.
    variance = sums.square().sum().item() / count * len(sums) / max(len(sums) - 1, 1)
    if score.min() == score.max():
        variance = level * (1 - level) * count / len(sums)
    # Both the scored and the calibrating links are samples.
    return math.sqrt(variance * (1 / count + 1 / calibration_links))
