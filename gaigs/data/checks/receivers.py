"""Checks of receivers' places by the levels: units, axes, order and places that levels contradict."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import torch
from jaxtyping import Float, Int
from scipy.constants import speed_of_light
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from gaigs.data.checks.distance import Gain, compare, decades, fit_law
from gaigs.data.checks.finding import Finding
from gaigs.data.checks.hypotheses import Hypothesis, Sample, sample_of
from gaigs.data.gateways import estimate_place
from gaigs.io.tables import shortened

SCORE = "mean error about the law of distance [dB]"


def check_receivers(links: Any) -> Iterator[Finding]:
    """Findings about receivers' places that levels contradict: the first kind that explains them."""
    known = sample_of_given(links)
    if known is None:
        return
    sample, names = known
    read = fit_law(decades(sample), sample).errors
    found = [*check_conventions(sample, read)]
    exchanged = [*check_order(sample, read, names)]
    # Gateways in the corners of a room that is mirrored seem exchanged, too: the clearly closer fit counts.
    if exchanged and (not found or _share(exchanged[0]) < 0.9 * _share(found[0])):
        found = exchanged
    yield from found or [*check_origin(sample, read)] or check_each(sample, names)


def check_power(links: Any) -> Iterator[Finding]:
    """A finding if no usual transmitter has such levels at such distances: places may be in mm, cm or km."""
    known = sample_of_given(links)
    if known is None or links.frame is not None:
        return
    sample = known[0]
    offsets = sample.transmitters - sample.positions[sample.receivers]
    distances = offsets.norm(dim=1).clamp_min(1e-3)
    carriers = links.query.frequencies
    carrier = None if carriers is None else carriers.median().item()

    def powers(supposed: float) -> Float[Tensor, " n"]:
        """Transmitted powers in free space [dBm], by the carrier or a supposed one [Hz]."""
        wavelength = speed_of_light / (carrier or supposed)
        return sample.labels + 20 * (4 * math.pi * distances / wavelength).log10()

    strong = powers(1e8).quantile(0.95).item()
    middle = f"levels of {sample.labels.median():.3g} dBm at {distances.median():.3g} m take a transmitter of "
    if strong > 60:
        yield Finding("unit of places", f"{middle}{strong:.2g} dBm in free space", "are places in mm or cm?")
    elif offsets[:, 2].abs().min() > 300 and powers(4e8).quantile(0.95) > 40:
        text = f"receivers are {offsets[:, 2].abs().min():.3g} m above or below all places"
        yield Finding("unit of places", text, "are places in mm?")
    elif (weak := powers(6e9).max().item()) < -40:
        yield Finding("unit of places", f"{middle}{weak:.2g} dBm in free space", "are places in km?")


def sample_of_given(links: Any, most: int = 2000, fewest: int = 8) -> tuple[Sample, list[str]] | None:
    """Some links of the receivers with a given place and ``fewest`` links or more, and the receivers' names."""
    sample = sample_of(links, most)
    counts = sample.receivers.bincount(minlength=len(sample.positions))
    used = counts >= fewest
    if links.uncertainties is not None:
        used &= links.uncertainties == 0
    kept = used.nonzero()[:, 0]
    if not len(kept):
        return None
    return _only(sample, kept), [links.receivers[k].name for k in kept.tolist()]


def conventions() -> list[Hypothesis]:
    """Other units and axes of the receivers than of the places."""
    found = []
    for factor in (1e-3, 1e-2, 0.3048, 1 / 0.3048, 1e2, 1e3):
        mend = f"receivers = {factor:.4g} * receivers, or transmitters = {1 / factor:.4g} * transmitters"
        change = partial(_moved, axes=[0, 1, 2], factors=[factor] * 3)
        found.append(Hypothesis(f"coordinates are times {factor:.4g}", change, mend))
    orders = {
        "x and y are exchanged": [1, 0, 2],
        "y and z are exchanged": [0, 2, 1],
        "x and z are exchanged": [2, 1, 0],
        "axes are y, z, x": [1, 2, 0],
        "axes are z, x, y": [2, 0, 1],
    }
    for name, axes in orders.items():
        change = partial(_moved, axes=axes, factors=[1.0] * 3)
        found.append(Hypothesis(name, change, f"receivers = receivers[:, {axes}], or the same of transmitters"))
    signs = {"x is negated": [-1.0, 1.0, 1.0], "y is negated": [1.0, -1.0, 1.0], "x and y are negated": [-1.0, -1, 1]}
    for name, factors in signs.items():
        change = partial(_moved, axes=[0, 1, 2], factors=factors)
        found.append(Hypothesis(name, change, f"receivers = receivers * {[int(sign) for sign in factors]}"))
    for name, axes in {"x": [0], "y": [1], "x and y": [0, 1]}.items():
        mend = f"{name} may run the other way, as rows of a picture do: subtract from the plan's extent"
        found.append(Hypothesis(f"{name} run from the other end", partial(_mirrored, axes=axes), mend))
    corner = "receivers = receivers + transmitters.min(0)"
    found.append(Hypothesis("origin is the lowest corner of the places", _from_corner, corner))
    return found


def check_conventions(sample: Sample, read: Float[Tensor, " n"]) -> Iterator[Finding]:
    """A finding if levels follow the distance clearly better in another unit or with other axes."""
    rows = conventions()
    logarithms = torch.stack([decades(row.change(sample)) for row in rows])  # (h, n)
    errors = fit_law(logarithms, sample).errors
    best = int(errors.abs().clamp_max(30).mean(1).argmin())
    gain = compare(read, errors[best], sample)
    # A directional receiver is louder on one side: another convention has to explain levels better than that.
    directed = fit_law(decades(sample), sample, patterns=True).errors
    if gain.is_clear() and gain.fits < compare(directed, directed, sample).read:
        text = f"levels follow the distance to {gain.fits:.2g} dB instead of {gain.read:.2g} dB if the receivers' "
        text += rows[best].name
        yield Finding("coordinates of receivers", text, rows[best].mend, gain.read, gain.fits, SCORE)


def check_order(sample: Sample, read: Float[Tensor, " n"], names: Sequence[str]) -> Iterator[Finding]:
    """A finding if levels of some receivers follow the distance from one another's places."""
    count = len(names)
    if not 2 <= count <= 64:
        return
    apart = torch.cdist(sample.positions, sample.transmitters)  # (r, n)
    least = 0.01 * apart[sample.receivers, torch.arange(len(read))].median()
    errors = fit_law(apart.clamp_min(least).clamp_min(1e-9).log10(), sample).errors  # (r, n), from every place
    sums = torch.zeros(count, count, dtype=errors.dtype)
    sums.index_add_(1, sample.receivers, errors.abs().clamp_max(30))
    costs = sums / sample.receivers.bincount()
    costs.diagonal().mul_(0.9)  # receivers stay unless another place is clearly better
    places, columns = linear_sum_assignment(costs.numpy())
    order = [0] * count
    for place, column in zip(places.tolist(), columns.tolist(), strict=True):
        order[column] = place
    directed = fit_law(decades(sample), sample, patterns=True).errors
    for cycle in _cycles(order):
        own = torch.isin(sample.receivers, torch.tensor(cycle))
        part = _only(sample, torch.tensor(sorted(cycle)))
        other = errors[torch.tensor(order)[sample.receivers[own]], own.nonzero()[:, 0]]
        gain = compare(read[own], other, part)
        if not gain.is_clear() or gain.fits > compare(directed[own], other, part).read:
            continue
        text = f"levels of {shortened([names[k] for k in cycle])} follow the distance to {gain.fits:.2g} dB instead of "
        text += f"{gain.read:.2g} dB from the places of {shortened([names[order[k]] for k in cycle])}"
        mend = "are names or places exchanged?"
        for step in (1, -1):
            if count > 2 and order == [(k + step) % count for k in range(count)]:
                mend = f"are receivers counted from 1? receivers = np.roll(receivers, {-step}, axis=0)"
        yield Finding("exchanged receivers", text, mend, gain.read, gain.fits, SCORE)


def check_each(sample: Sample, names: Sequence[str], most: int = 4) -> Iterator[Finding]:
    """Findings about receivers whose levels are those of another place."""
    for number in _doubtful(sample)[:most]:
        alone = _only(sample, torch.tensor([number]))
        place, deviation = estimate_place(alone.transmitters.float(), alone.labels.float())
        moved = replace(alone, positions=place.double()[None])
        gain = _gain(alone, fit_law(decades(moved), moved).errors)
        away = (moved.positions - alone.positions)[0, :2].norm().item()
        if gain is None or away < 3 * deviation:
            continue
        at = ", ".join(f"{x:.4g}" for x in place.tolist())
        text = f"levels of {names[number]} follow the distance to {gain.fits:.2g} dB instead of {gain.read:.2g} dB "
        text += f"from ({at}) m, {away:.3g} m off its place"
        mend = "check its place, name, axes and unit"
        yield Finding("place of a receiver", text, mend, gain.read, gain.fits, SCORE)


def check_origin(sample: Sample, read: Float[Tensor, " n"]) -> Iterator[Finding]:
    """A finding if levels follow the distance clearly better once all receivers are shifted alike."""
    if len(sample.positions) < 2:
        return
    step = (sample.transmitters.amax(0) - sample.transmitters.amin(0)).max() / 5
    shift = torch.zeros(2, dtype=step.dtype)
    for width in (step, step / 3, step / 9):
        steps = torch.arange(-5, 6) * width
        shifts = shift + torch.cartesian_prod(steps, steps)  # (g, 2)
        shifts = torch.cat((shifts, torch.zeros(len(shifts), 1, dtype=step.dtype)), 1)
        moved = [replace(sample, positions=sample.positions + one) for one in shifts]
        errors = fit_law(torch.stack([decades(one) for one in moved]), sample).errors
        best = errors.abs().clamp_max(30).mean(1).argmin()
        shift, own = shifts[best, :2], errors[best]
        if own.abs().mean() > 0.95 * read.abs().mean():  # a finer grid gains no more than that
            return
    gain = compare(read, own, sample)
    directed = fit_law(decades(sample), sample, patterns=True).errors
    if gain.is_clear(0.8, 10.0) and compare(directed, own, sample).is_clear(0.9, 0.0):
        x, y = shift.tolist()
        text = f"levels follow the distance to {gain.fits:.2g} dB instead of {gain.read:.2g} dB if all receivers stand "
        text += f"({x:.3g}, {y:.3g}) m elsewhere"
        mend = f"receivers = receivers + [{x:.3g}, {y:.3g}, 0], if their origin is another one"
        yield Finding("origin of receivers", text, mend, gain.read, gain.fits, SCORE)


def _doubtful(sample: Sample, cells: int = 12) -> list[int]:
    """Receivers whose levels follow the distance clearly better from a point of a grid, the worst first."""
    places = sample.transmitters
    low, high = places.amin(0), places.amax(0)
    margin = (high - low).max() / 2
    x, y = (
        torch.linspace((low[k] - margin).item(), (high[k] + margin).item(), cells, dtype=places.dtype) for k in (0, 1)
    )
    grid = torch.cartesian_prod(x, y)  # (g, 2)
    heights = places[:, 2] - sample.positions[sample.receivers, 2]
    apart = (torch.cdist(grid, places[:, :2]).square() + heights.square()).sqrt()  # (g, n)
    errors = fit_law(apart.clamp_min(0.01 * apart.median()).clamp_min(1e-9).log10(), sample).errors
    gains = {}
    for number in range(len(sample.positions)):
        own = sample.receivers == number
        best = errors[:, own].abs().clamp_max(30).mean(1).argmin()
        gain = _gain(_only(sample, torch.tensor([number])), errors[best, own])
        if gain is not None:
            gains[number] = gain.fits / gain.read
    return sorted(gains, key=gains.__getitem__)


def _gain(sample: Sample, fits: Float[Tensor, " n"]) -> Gain | None:
    """The gain of errors about another law, if neither chance nor directional antennas explain it."""
    logarithms = decades(sample)
    gain = compare(fit_law(logarithms, sample).errors, fits, sample)
    directed = fit_law(logarithms, sample, patterns=True)
    beyond = compare(directed.errors, fits, sample)
    # Within the beam of a directional antenna levels still fall with the distance.
    is_flat = directed.slopes.median() > -8
    is_beyond = beyond.is_clear(0.85, -math.inf if is_flat else 6.5)
    return gain if gain.is_clear(0.75) and is_beyond else None


def _share(finding: Finding) -> float:
    """Error of what fits over that of the data as read."""
    return (finding.fits or 0.0) / (finding.read or 1.0)


def _only(sample: Sample, numbers: Int[Tensor, " k"]) -> Sample:
    """The links of some receivers, numbered anew."""
    own = torch.isin(sample.receivers, numbers)
    _, receivers = sample.receivers[own].unique(return_inverse=True)
    return replace(
        sample,
        index=sample.index[own],
        transmitters=sample.transmitters[own],
        receivers=receivers,
        positions=sample.positions[numbers],
        rotations=sample.rotations[numbers],
        elements=tuple(sample.elements[k] for k in numbers.tolist()),
        labels=sample.labels[own],
    )


def _cycles(order: Sequence[int]) -> list[list[int]]:
    """Cycles of two or more of a permutation."""
    found, seen = [], set()
    for start in range(len(order)):
        cycle = []
        number = start
        while number not in seen:
            seen.add(number)
            cycle.append(number)
            number = order[number]
        if len(cycle) > 1:
            found.append(cycle)
    return found


def _moved(sample: Sample, axes: Sequence[int], factors: Sequence[float]) -> Sample:
    return replace(sample, positions=sample.positions[:, axes] * sample.positions.new_tensor(factors))


def _mirrored(sample: Sample, axes: Sequence[int]) -> Sample:
    """Receivers on the other side of the middle of the places."""
    middle = (sample.transmitters.amin(0) + sample.transmitters.amax(0)) / 2
    positions = sample.positions.clone()
    positions[:, axes] = 2 * middle[axes] - positions[:, axes]
    return replace(sample, positions=positions)


def _from_corner(sample: Sample) -> Sample:
    corner = sample.transmitters.amin(0)
    return replace(sample, positions=sample.positions + corner * corner.new_tensor([1, 1, 0]))
