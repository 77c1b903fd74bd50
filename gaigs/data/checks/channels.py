"""Checks of complex channels: wrong conventions, and phases that do not follow geometry."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import torch
from jaxtyping import Int
from torch import Tensor

from gaigs.core.phases import MANY, StrangeParts, phase_sign, strange_parts, unknown_phase
from gaigs.core.query import evenly
from gaigs.core.scene import Scene, direct_waves
from gaigs.data.checks.conventions import conventions
from gaigs.data.checks.finding import Finding
from gaigs.data.checks.hypotheses import Sample, sample_at
from gaigs.data.checks.subcarriers import (
    check_constant_subcarriers,
    check_powers,
    order_of_subcarriers,
)
from gaigs.data.checks.waves import (
    aligned_likeness,
    coherence,
    has_extent,
    level_share,
    likeness,
    without_geometry,
)


class Measure(NamedTuple):
    """A measure of how well geometry explains channels."""

    measure: Callable[[Sample], float]  # gives the share of a sample that geometry explains
    least: float  # smallest fraction that identifies a convention
    enough: float  # share above which the data need no other convention
    sentence: str  # sentence for users, with {} for the share
    meaning: str  # what the share is of, in short


def check_channels(links: Any) -> Iterator[Finding]:
    """Findings about complex channels."""
    yield from check_constant_subcarriers(links)
    known = torch.arange(len(links)) if links.split is None else links.split.train
    receiver_of = links.query.receivers[known]
    chosen = []
    for receiver in range(len(links.receivers)):  # at most 64 links each
        chosen.append(evenly(known[receiver_of == receiver], 64))
    train = torch.cat(chosen)
    sample = sample_at(links, train)
    yield from check_powers(sample)
    yield from check_signs(sample)
    order = order_of_subcarriers(sample)
    if links.front_ends is not None:
        # Phases that a front end explains are no fault of the geometry. The checks above are of the
        # channels as measured.
        responses = links.front_ends.responses[sample.receivers].to(sample.labels)
        sample = replace(sample, labels=sample.labels / responses)
    yield from [order] if order is not None else check_phases(links, train, sample)


def check_signs(sample: Sample) -> Iterator[Finding]:
    """Findings if no channel has a negative real part, or none a negative imaginary part."""
    parts = {"real": sample.labels.real, "imaginary": sample.labels.imag}
    for name, part in parts.items():
        if sample.labels.numel() < 100 or part.min() < 0:
            continue
        what = "0 or more" if part.any() else "0"
        text = f"{name} parts are {what} at all links, elements and subcarriers"
        mend = (
            "of amplitudes a and phases p [rad] give a * np.exp(1j * p); amplitudes or one part "
            "alone are no channel"
        )
        yield Finding("parts of channels", text, mend)


def check_phases(links: Any, train: Int[Tensor, " k"], sample: Sample) -> Iterator[Finding]:
    """Findings if phases of channels do not follow the geometry, or contradict ``data.phase``.

    The first convincing explanation counts: another convention, fixed phases of elements or
    subcarriers, a random phase of each link, no geometry at all.

    Args:
        train: Numbers of the sample's links in ``links``.
        sample: The links with these numbers.
    """
    task = links.task
    few = sample.thinned(192)
    is_known = task.phase == "known"
    has_gain = task.phase != "per_link_and_delay"
    receivers, labels = sample.receivers, sample.labels
    # Direct waves need receivers and task of a scene, and not its extent.
    scene = Scene(links.receivers, torch.zeros(3), torch.zeros(3), 0.0, task)
    waves = direct_waves(scene, links.query[train], task.frequencies)
    sign = phase_sign(labels, waves, receivers) if is_known else 0  # 0 if neither sign fits
    # Another convention may explain phases over all links, or else the phases within each link.
    explained = "the direct wave explains {} of the channels"
    over_links = Measure(coherence, 0.1, 0.8, explained, "in the mean over links")
    finding = best_convention(few, over_links) if is_known else None
    if finding is None and not sign:
        alike = likeness if has_gain else aligned_likeness
        explained = "the direct wave explains {} of each channel"
        within_links = Measure(alike, 0.3, 0.8, explained, "of the power within a link")
        finding = best_convention(few, within_links)
    if finding is not None:
        yield finding
    if finding is not None or not has_gain:
        return
    # Elements or subcarriers with fixed phases, such as of cables, by receiver.
    strange = strange_parts(labels, waves, receivers, task.frequencies, sign) if sign else {}
    if strange:
        # Another convention may explain as much with a calibrated array.
        calibrated = over_links._replace(measure=partial(coherence, is_calibrated=True))
        finding = best_convention(few, calibrated)
        if finding is not None and finding.fits > 0.7 * coherence(few):
            yield finding
            return
    is_fixed = any(part.elements or part.delay is not None for part in strange.values())
    # Without fixed phases each packet may have a phase, or a delay, of its own.
    phase = None
    if not is_fixed:
        phase = unknown_phase(labels, waves, receivers, task.frequencies, task.phase)
    if phase:
        common = "phase" if is_known else "delay"
        yield Finding(
            "phase of each link",
            f"channels have no {common} in common, as if each packet had its own",
            f"set data.phase={phase}, or check units, axes and order of tx, rx and elements",
        )
        return
    if not sign:
        is_enough = len(train) >= MANY * len(receivers.unique())
        yield from _without_sign(few, is_known and is_enough)
    for receiver, parts in strange.items():
        yield from _strange_findings(links.receivers[receiver].name, parts)


def _without_sign(few: Sample, is_enough: bool) -> Iterator[Finding]:
    """A finding if phases of channels follow the distance neither with one sign nor the other."""
    explained = "distance explains {} of the levels' spread"
    by_level = Measure(level_share, 0.22, 0.3, explained, "of the spread of levels")
    finding = best_convention(few, by_level)
    if finding is not None:
        yield finding
    elif is_enough:
        yield Finding(
            "phases without geometry",
            "phases of the channels do not follow the direct distance",
            "unless walls block most direct waves, check units and order of tx, rx, elements and "
            "h, and the frequencies, or set data.phase=per_link if each packet has a phase of its "
            "own",
        )


def _strange_findings(name: str, parts: StrangeParts) -> Iterator[Finding]:
    """Findings about a receiver's elements and subcarriers whose phases never change."""
    unexplained = "have phases that geometry does not explain, the same at all links"
    if parts.elements:
        yield Finding(
            "phases of elements",
            f"the elements of {name} {unexplained}",
            "check order, axes and unit of elements and tx, or calibrate the array",
        )
    if parts.subcarriers:
        mend = "check their order"
        if parts.delay is not None:
            mend = (
                f"take a delay of {1e9 * parts.delay:.3g} ns off h, or set "
                "data.phase=per_link_and_delay"
            )
        yield Finding("phases of subcarriers", f"the subcarriers of {name} {unexplained}", mend)


def best_convention(sample: Sample, score: Measure) -> Finding | None:
    """A finding about the conventions by which geometry explains channels clearly better.

    Conventions that explain the channels equally well are named together. None if no convention is
    clearly better.

    Args:
        score: Measure of the explained share, with the bounds above which an improvement is clear.
    """
    read = score.measure(sample)
    if read > score.enough or len(sample.labels) < MANY:
        return None
    # Few links choose eight conventions, and all links the best of these.
    few = sample.thinned(64)
    tried = []
    for convention in conventions(few, score.measure):
        changed = convention.change(few)
        share = score.measure(changed)
        is_telling = share > max(read, score.least / 2) and has_extent(changed)
        # Channels that are similar at all links fit any convention under which distances hardly
        # differ. So the distances must explain more than equal distances do.
        if is_telling and share > 1.1 * score.measure(without_geometry(changed)) + 0.02:
            tried.append((share, convention))
    if not tried:
        return None
    eight_best = sorted((share for share, _ in tried), reverse=True)[:8]
    fitting = []
    for share, convention in tried:
        if share >= eight_best[-1]:
            fitting.append((score.measure(convention.change(sample)), convention))
    fits = max(share for share, _ in fitting)
    # Clearly more is explained, or the unexplained part is halved.
    is_better = fits > 1.5 * read + 0.05 or 1 - fits < (1 - read) / 2
    if fits < score.least or not is_better:
        return None
    best = [convention for share, convention in fitting if share > 0.98 * fits]
    names = list(dict.fromkeys(convention.name for convention in best))[:3]
    mends = list(dict.fromkeys(convention.mend for convention in best))[:3]
    text = score.sentence.format(f"{fits:.0%}")
    text += f" in place of {max(read, 0):.0%} if {' or '.join(names)}"
    return Finding(
        names[0], text, " or ".join(mends), read=read, fits=fits, score=f"share {score.meaning}"
    )
