"""Checks of receivers' places against levels: units, axes, order, and wrong places."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int
from scipy.constants import speed_of_light
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from gaigs.data.checks.conventions import of_axes, of_frames, of_plans, of_units
from gaigs.data.checks.distance import Gain, compare, decades, decades_of, fit_law
from gaigs.data.checks.finding import Finding
from gaigs.data.checks.hypotheses import Sample, sample_of
from gaigs.io.tables import shortened


def check_receivers(links: Any) -> Iterator[Finding]:
    """Findings about places of receivers that contradict the levels.

    Possible faults are tried in this order: another convention or order, another origin, single
    receivers at wrong places. Only the first fault that explains the levels is reported.
    """
    placed = sample_of_given(links)
    if placed is None:
        return
    sample, names = placed
    findings = [*check_conventions(sample)]
    exchanged = [*check_order(sample, names)]
    # Gateways in the corners of a mirrored room seem exchanged, too: the clearly closer fit counts.
    if exchanged and (not findings or _share(exchanged[0]) < 0.9 * _share(findings[0])):
        findings = exchanged
    yield from findings or [*check_origin(sample)] or check_each(sample, names)


def check_power(links: Any) -> Iterator[Finding]:
    """A finding if the levels need an impossible transmit power, as with distances in mm or km."""
    placed = sample_of_given(links)
    if placed is None or links.frame is not None:
        return
    sample = placed[0]
    offsets = sample.transmitters - sample.positions[sample.receivers]
    distances = offsets.norm(dim=1).clamp_min(1e-3)
    carriers = links.query.frequencies
    carrier = None if carriers is None else carriers.median().item()

    def powers(otherwise: float) -> Float[Tensor, " n"]:
        """Transmit powers in free space [dBm]; ``otherwise`` is in place of no carrier [Hz]."""
        wavelength = speed_of_light / (carrier or otherwise)
        # Friis: the loss is 20 log10(4 pi d / wavelength).
        return sample.labels + 20 * (4 * math.pi * distances / wavelength).log10()

    # If the carrier is unknown: 100 MHz gives the smallest power, 6 GHz the largest.
    strong = powers(1e8).quantile(0.95).item()
    weak = powers(6e9).quantile(0.95).item()
    usual = f"levels of {sample.labels.median():.3g} dBm at {distances.median():.3g} m"
    power = f"{usual} take a transmitter of {{:.2g}} dBm in free space"
    height = offsets[:, 2].abs().min()
    if strong > 60:
        yield Finding("unit of places", power.format(strong), "are places in mm or cm?")
    elif height > 300 and powers(4e8).quantile(0.95) > 40:
        text = f"receivers are {height:.3g} m above or below all places"
        yield Finding("unit of places", text, "are places in mm?")
    elif weak < -40:
        yield Finding("unit of places", power.format(weak), "are places in km?")


def sample_of_given(
    links: Any, most: int = 2000, fewest: int = 8
) -> tuple[Sample, list[str]] | None:
    """Links of the receivers with a given place, and the names of these receivers.

    None if there is no such receiver.

    Args:
        most: Largest number of links.
        fewest: Number of links below which a receiver is left out.
    """
    sample = sample_of(links, most)
    counts = sample.receivers.bincount(minlength=len(sample.positions))
    is_used = counts >= fewest
    if links.uncertainties is not None:
        is_used &= links.uncertainties == 0
    numbers = is_used.nonzero()[:, 0]
    if not len(numbers):
        return None
    return _only(sample, numbers), [links.receivers[k].name for k in numbers.tolist()]


def check_conventions(sample: Sample) -> Iterator[Finding]:
    """A finding if levels follow the distance much better in another unit or other axes."""
    others = [
        *of_frames(),
        *of_units([("tx",), ("rx",)]),
        *of_axes(sample, [("rx",)]),
        *of_plans(sample),
    ]
    logarithms = torch.stack([decades(other.change(sample)) for other in others])  # (h, n)
    errors = fit_law(logarithms, sample).errors
    best = int(errors.abs().clamp_max(30).mean(1).argmin())
    gain = _gain(sample, errors[best])
    if gain is not None:
        under = f"if {others[best].name}"
        yield _finding("coordinates of receivers", "levels", gain, under, others[best].mend)


def check_order(sample: Sample, names: Sequence[str]) -> Iterator[Finding]:
    """A finding if levels of some receivers fit the places of other receivers."""
    count = len(names)
    if not 2 <= count <= 64:
        return
    # Errors of each link's level if its receiver stood at each of the places.
    distances = torch.cdist(sample.positions, sample.transmitters)  # (place, n)
    errors = fit_law(decades_of(distances), sample).errors  # (place, n)
    sums = torch.zeros(count, count, dtype=errors.dtype)
    sums.index_add_(1, sample.receivers, errors.abs().clamp_max(30))  # (place, receiver)
    costs = (sums / sample.receivers.bincount()).T  # (receiver, place)
    costs.diagonal().mul_(0.9)  # receivers stay unless another place is clearly better
    order = torch.from_numpy(linear_sum_assignment(costs.numpy())[1])  # place of each receiver
    moved = (order != torch.arange(count)).nonzero()[:, 0]
    if not len(moved):
        return
    links = torch.isin(sample.receivers, moved).nonzero()[:, 0]  # of the moved receivers
    places = order[sample.receivers[links]]
    gain = _gain(_only(sample, moved), errors[places, links])
    if gain is None:
        return
    mend = "are names or places exchanged?"
    for step in (1, -1):
        if count > 2 and torch.equal(order, torch.arange(count).roll(-step)):
            mend = f"are receivers counted from 1? rx = np.roll(rx, {-step}, axis=0)"
    others = shortened([names[place] for place in order[moved].tolist()])
    subject = f"levels of {shortened([names[k] for k in moved.tolist()])}"
    yield _finding("exchanged receivers", subject, gain, f"from the places of {others}", mend)


def check_origin(sample: Sample) -> Iterator[Finding]:
    """A finding if a common shift of all receivers explains the levels clearly better."""
    (x, y), gain = best_shift(sample)
    if gain is not None and len(sample.positions) > 1:
        mend = f"rx = rx + [{x:.3g}, {y:.3g}, 0], if their origin is another one"
        text = f"if all receivers stand ({x:.3g}, {y:.3g}) m elsewhere"
        yield _finding("origin of receivers", "levels", gain, text, mend)


def check_each(sample: Sample, names: Sequence[str], most: int = 4) -> Iterator[Finding]:
    """Findings about receivers whose levels fit another place, the clearest first."""
    findings = []
    for number, name in enumerate(names):
        alone = _only(sample, torch.tensor([number]))
        if len(alone.labels) < 16:  # place, level and slope fit a few links by chance
            continue
        shift, gain = best_shift(alone)
        if gain is None:
            continue
        place = (alone.positions[0, :2] + shift).tolist()
        shown = ", ".join(f"{x:.4g}" for x in place)
        text = f"from ({shown}) m, {shift.norm():.3g} m off its place"
        mend = "check its place, name, axes and unit"
        findings.append(_finding("place of a receiver", f"levels of {name}", gain, text, mend))
    yield from sorted(findings, key=_share)[:most]


def best_shift(sample: Sample, cells: int = 5) -> tuple[Float[Tensor, "2"], Gain | None]:
    """The common shift of all receivers along x and y [m] that explains levels best.

    The second result is its gain; None if the gain is not clear. The search starts with the
    receivers' mean in the middle of the transmitters, and reaches as far as their extent.

    Args:
        cells: Number of grid points on each side of the middle.
    """
    low, high = sample.transmitters.amin(0), sample.transmitters.amax(0)
    offsets = sample.transmitters - sample.positions[sample.receivers]  # (n, 3)
    shift = ((low + high) / 2 - sample.positions.mean(0))[:2]
    fits = torch.zeros_like(sample.labels)  # errors under the best shift [dB]
    width = (high - low).max() / cells
    for _ in range(3):  # three grids, each finer by a factor of three
        steps = torch.arange(-cells, cells + 1) * width
        shifts = shift + torch.cartesian_prod(steps, steps)  # (g, 2)
        horizontal = (offsets[:, :2] - shifts[:, None]).square().sum(-1)  # (g, n)
        distances = (horizontal + offsets[:, 2].square()).sqrt()
        errors = fit_law(decades_of(distances), sample).errors
        best = errors.abs().clamp_max(30).mean(1).argmin()
        shift, fits = shifts[best], errors[best]
        width = width / 3
    return shift, _gain(sample, fits, is_fitted=True)


def _gain(sample: Sample, fits: Float[Tensor, " n"], is_fitted: bool = False) -> Gain | None:
    """How much smaller errors under another convention are than those of the data as read.

    None if chance may explain it, or if directional antennas do: the data as read then follow a
    law with antenna patterns as well.

    Args:
        fits: Errors of the law under another convention [dB].
        is_fitted: True if places were fitted to the levels. Chance then explains more.
    """
    logarithms = decades(sample)
    gain = compare(fit_law(logarithms, sample).errors, fits, sample)
    directed = fit_law(logarithms, sample, patterns=True)
    beyond = compare(directed.errors, fits, sample)
    # If levels still fall with distance in the beam of a directional antenna, places may be right.
    evidence = 6.5 if is_fitted and directed.slopes.median() < -8 else -math.inf
    is_beyond = beyond.is_clear(0.85 if is_fitted else 1.0, evidence)
    return gain if gain.is_clear(0.75 if is_fitted else 0.85) and is_beyond else None


def _finding(fault: str, subject: str, gain: Gain, under: str, mend: str) -> Finding:
    """The finding that levels fit the law of distance better under another convention.

    ``subject`` and ``under`` are the start and the end of its sentence: levels, and convention.
    """
    text = (
        f"{subject} follow the distance to {gain.fits:.2g} dB instead of {gain.read:.2g} dB {under}"
    )
    return Finding(
        fault, text, mend, gain.read, gain.fits, "mean error about the law of distance [dB]"
    )


def _share(finding: Finding) -> float:
    """Ratio of the error of the fit to the error of the data as read."""
    return (finding.fits or 0.0) / (finding.read or 1.0)


def _only(sample: Sample, numbers: Int[Tensor, " k"]) -> Sample:
    """The links of the receivers with these numbers, which become 0, 1, ..."""
    links = sample.at(torch.isin(sample.receivers, numbers).nonzero()[:, 0])
    _, receivers = links.receivers.unique(return_inverse=True)
    return replace(
        links,
        receivers=receivers,
        positions=sample.positions[numbers],
        rotations=sample.rotations[numbers],
    )
