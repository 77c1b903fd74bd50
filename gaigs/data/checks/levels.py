"""Checks of received levels: units, signs, codes of "not heard", wrong levels, wrong places."""

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.spatial import cKDTree
from torch import Tensor

from gaigs.data.checks.distance import decades, explained, fit_law
from gaigs.data.checks.finding import Finding
from gaigs.data.checks.hypotheses import Sample, sample_of
from gaigs.data.checks.receivers import check_power, check_receivers, sample_of_given
from gaigs.data.readings import marks_of
from gaigs.io.tables import shortened


def check_levels(links: Any) -> Iterator[Finding]:
    """Findings about units, signs, codes of "not heard", single levels, and receivers' places."""
    levels = links.labels[torch.arange(len(links))].double()
    nonzero = levels[levels != 0]
    if len(nonzero) and (nonzero > 0).double().mean() > 0.9:
        yield from check_unit(links, nonzero)
        return
    yield from check_signs(links, levels)
    for mark in marks_of(levels[:, None].numpy()):
        text = f"{int((levels == mark).sum())} levels are {mark:g} dBm"
        yield Finding("mark of not heard", text, "does it mean not heard?")
    yield from check_columns(links, levels)
    yield from check_neighbours(links)
    yield from check_receivers(links)
    yield from check_power(links)


def check_unit(links: Any, levels: Float[Tensor, " n"]) -> Iterator[Finding]:
    """A finding if levels are positive: powers, amplitudes, or decibels with a wrong sign."""
    low, high = np.quantile(levels.numpy(), (0.05, 0.95)).tolist()
    text = (
        f"{int((levels > 0).sum())} levels are above 0 dBm, {levels.min():.3g} to "
        f"{levels.max():.3g}"
    )
    placed = sample_of_given(links)
    sample = None if placed is None else placed[0]
    # Powers span decades, decibels of one survey seldom a factor of 100; amplitudes are small, too.
    if high > 100 * max(low, 1e-300) or levels.max() < 0.1:
        yield _linear_unit(sample, text, 10 * math.log10(np.median(levels)))
        return
    is_inverted = sample is None
    if sample is not None:
        inverted = replace(sample, labels=-sample.labels)
        is_inverted = explained(inverted) >= explained(sample)
    if is_inverted:
        mend = "was a sign lost, or are they path losses? levels = -levels"
        yield Finding("sign of levels", text, mend)
        return
    mend = "percent, scaled, dB over the noise, or dBuV? levels = levels - 107 of dBuV at 50 ohm"
    yield Finding("unit of levels", f"{text}, and fall with the distance", mend)


def _linear_unit(sample: Sample | None, text: str, median: float) -> Finding:
    """The finding that positive levels are in volts, watts, mW or less instead of decibels.

    Amplitudes fall with 1 / distance, so 10 log10(amplitude) falls by 10 dB in each decade of
    distance; 10 log10(power) falls by 20 dB. A slope near 10 dB therefore means volts. Otherwise
    the size of the levels distinguishes watts from mW.

    Args:
        sample: Links of the receivers with given places, for the slope; None without given places.
        text: Start of the finding's text.
        median: 10 log10 of the median level.
    """
    score = "share of the spread that the distance explains"
    read = fits = slope = 0.0
    if sample is not None:
        # Linear levels do not follow the logarithm of the distance, but their decibels do.
        positive = sample.at((sample.labels > 0).nonzero()[:, 0])
        decibels = replace(positive, labels=10 * positive.labels.log10())
        read = explained(sample)
        fits = explained(decibels)
        slope = fit_law(decades(decibels), decibels).slopes.median().item()
        text += f"; the distance explains {read:.0%} of their spread, "
        text += f"{fits:.0%} of that of their logarithm"
    # In free space power falls by 20 dB a decade of distance; 10 log10 of an amplitude by 10.
    if -14 < slope < -4 and fits > 0.1:
        unit = "volts"
        mend = "levels = 20 * np.log10(levels) + 13 at 50 ohm"
    # Else the first unit that gives a level that receivers can have: below -20 dBm of watts,
    elif median + 30 < -20:
        unit = "watts"
        mend = "levels = 10 * np.log10(levels / 1e-3), or 10 * np.log10(levels) of mW"
    # below -10 dBm of mW.
    elif median < -10:
        unit = "mW"
        mend = "levels = 10 * np.log10(levels)"
    else:
        unit = "microwatts or less"
        mend = "levels = 10 * np.log10(levels * 1e-3) of microwatts"
    return Finding("unit of levels", f"{text}; are they {unit}?", mend, read, fits, score)


def check_signs(links: Any, levels: Float[Tensor, " n"]) -> Iterator[Finding]:
    """A finding about positive levels that seem to have lost their sign."""
    positive = levels > 0
    if not positive.any():
        return
    low, high = np.quantile(levels[~positive].numpy(), (0.01, 0.99)).tolist()
    # With the other sign the level is usual, to 10 dB. As given, it is far above usual levels.
    is_usual_negated = (-levels >= low - 10) & (-levels <= high + 10)
    lost = positive & is_usual_negated & (levels > high + 30)
    if lost.any():
        text = f"{int(lost.sum())} levels are above 0 dBm, and usual with the other sign"
        yield Finding("sign of levels", text, "was a sign lost? levels = -np.abs(levels)")


def check_columns(links: Any, levels: Float[Tensor, " n"]) -> Iterator[Finding]:
    """Findings about receivers with a constant level, or with the levels of another receiver."""
    names = [receiver.name for receiver in links.receivers]
    _, place = links.query.place_keys.unique(return_inverse=True)  # (n,)
    count = int(place.max()) + 1
    constant: list[str] = []
    equal: list[str] = []
    first_with: dict[bytes, int] = {}  # number of the first receiver with a column of levels
    for number in range(len(names)):
        at_receiver = links.query.receivers == number
        if at_receiver.sum() >= 5 and levels[at_receiver].unique().numel() == 1:
            constant.append(names[number])
            continue
        column = np.full(count, np.nan)  # level at each place
        column[place[at_receiver].numpy()] = levels[at_receiver].numpy()
        other = first_with.setdefault(column.tobytes(), number)
        if other != number and at_receiver.sum() >= 3:
            equal.append(f"{names[other]} and {names[number]} have the same levels")
    if constant:
        yield Finding("constant levels", f"levels are constant at {shortened(constant)}")
    for text in equal:
        yield Finding("equal receivers", text)


def check_neighbours(links: Any, most: int = 100_000, shown: int = 3) -> Iterator[Finding]:
    """Findings about levels that differ from nearby levels, and about a wrong order of rows.

    At most ``most`` links are checked, and the ``shown`` worst ones are listed.
    """
    sample = sample_of(replace(links, split=None), most)  # also of test links
    excess = above_neighbours(sample)  # (n,)
    # Without a given place of the receiver there is no distance, and neighbours alone decide.
    is_placed = torch.ones(len(links.receivers), dtype=torch.bool)
    if links.uncertainties is not None:
        is_placed = links.uncertainties == 0
    errors = fit_law(decades(sample), sample).errors
    errors = torch.where(is_placed[sample.receivers], errors, excess)
    # A wrong level is far from its neighbours and from the law of distance, on the same side.
    # Beside a receiver levels are far above their neighbours, but follow the law.
    is_alike = excess * errors > 0
    outlying = torch.where(is_alike, torch.minimum(excess.abs(), errors.abs()), 0.0)  # (n,)
    scales = torch.stack([_scale(excess, sample), _scale(errors, sample)]).amax(0)  # (r,)
    bounds = (6 * scales[sample.receivers]).clamp_min(50)  # six deviations, 50 dB or more
    wrong = (outlying > bounds).nonzero()[:, 0]
    if not len(wrong):
        yield from check_places_of_levels(sample, excess, is_placed)
        return
    sentences = []
    largest_first = outlying[wrong].argsort(descending=True)
    for number in wrong[largest_first][:shown].tolist():
        row = "" if links.rows is None else f"row {int(links.rows[sample.index[number]])} "
        place = ", ".join(f"{x:.4g}" for x in sample.transmitters[number].tolist())
        level = sample.labels[number].item()
        usual = level - excess[number].item()
        name = links.receivers[int(sample.receivers[number])].name
        levels = f"{level:.3g} dBm, its neighbours {usual:.3g} dBm"
        sentences.append(f"{row}({place}) at {name}: {levels}")
    more = f" and {len(wrong) - shown} more" if len(wrong) > shown else ""
    text = f"levels are far from those of near places: {', '.join(sentences)}{more}"
    yield Finding("single levels", text, "correct them, or leave them out as nan")


def above_neighbours(sample: Sample, neighbours: int = 8) -> Float[Tensor, " n"]:
    """Difference of each level from the median of its neighbours' levels [dB].

    Neighbours are the nearest links of the same receiver. The result is 0 for receivers with fewer
    than 6 links.
    """
    excess = torch.zeros_like(sample.labels)
    for number in range(len(sample.positions)):
        links = (sample.receivers == number).nonzero()[:, 0]
        if len(links) < 6:
            continue
        places = sample.transmitters[links].numpy()
        _, near = cKDTree(places).query(places, k=min(neighbours + 1, len(links)))
        levels = sample.labels[links]
        neighbours_of = torch.from_numpy(near[:, 1:])  # the nearest link is the link itself
        excess[links] = levels - levels[neighbours_of].median(1).values
    return excess


def check_places_of_levels(
    sample: Sample, excess: Float[Tensor, " n"], is_placed: Bool[Tensor, " r"]
) -> Iterator[Finding]:
    """A finding if levels follow neither distance nor neighbours, as with a wrong order of rows.

    Args:
        sample: Links of all receivers.
        excess: Differences of levels from their neighbours [dB], from ``above_neighbours``.
        is_placed: True for receivers at given places; links of other receivers do not count.
    """
    is_used = is_placed[sample.receivers] & (excess != 0)
    # With equal distances the law is the receiver's mean, and errors are levels less this mean.
    equal = torch.zeros_like(excess)
    levels = fit_law(equal, sample).errors[is_used]
    if not is_used.any() or excess[is_used].abs().mean() < 0.95 * levels.abs().mean():
        return
    # The regression of levels on logarithms of distances, both less their receiver's mean.
    logarithms = fit_law(equal, replace(sample, labels=decades(sample))).errors[is_used]
    squares = logarithms.square().sum()
    slope = (logarithms @ levels / squares).item()
    deviation = (levels.square().mean() / squares).sqrt().item()
    if slope - 3 * deviation > -12:  # free space has -20
        text = (
            f"levels change by {slope:.2g} +- {deviation:.2g} dB a decade of distance, and near "
            "places do not agree"
        )
        yield Finding("order of rows", text, "are places and levels in the same order?")


def _scale(errors: Float[Tensor, " n"], sample: Sample) -> Float[Tensor, " r"]:
    """Robust standard deviation of errors at each receiver.

    A receiver with under 10 links gets the deviation over all receivers.
    """
    # 1.4826 medians of normal absolute errors are a standard deviation.
    scales = (1.4826 * errors.abs().median()).expand(len(sample.positions)).clone()
    for number in range(len(scales)):
        at_receiver = errors[sample.receivers == number]
        if len(at_receiver) >= 10:
            scales[number] = 1.4826 * at_receiver.abs().median()
    return scales
