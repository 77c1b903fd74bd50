"""Checks of complex channels: phases that do not follow the geometry."""

from collections.abc import Iterator
from typing import Any

import torch

from gaigs.data.checks.finding import Finding
from gaigs.phases import MANY, phase_sign, strange_parts, unknown_phase
from gaigs.scene import Scene, direct_waves


def check_channels(links: Any) -> Iterator[Finding]:
    """Findings about complex channels."""
    yield from check_phases(links)


def check_phases(links: Any) -> Iterator[Finding]:
    """Findings if phases of channels do not follow the geometry, or disagree with those that are declared."""
    task = links.task
    if task.phase == "per_link_and_delay":
        return
    train = torch.arange(len(links)) if links.split is None else links.split.train
    every = links.query.receivers[train]
    own = (train[every == receiver] for receiver in range(len(links.receivers)))
    train = torch.cat([part[:: max(1, len(part) // 64)] for part in own])
    receivers, labels = links.query.receivers[train], links.labels[train].to(torch.complex128)
    everywhere = Scene(links.receivers, torch.zeros(3), torch.zeros(3), 0.0, task)
    waves = direct_waves(everywhere, links.query[train], task.frequencies)
    is_known, strange = task.phase == "known", {}
    sign = phase_sign(labels, waves, receivers) if is_known else 0
    if sign:
        strange = strange_parts(labels, waves, receivers, task.frequencies, sign)
    is_fixed = any(elements or delay is not None for elements, _, delay in strange.values())
    if not is_fixed and (phase := unknown_phase(labels, waves, receivers, task.frequencies, task.phase)):
        common = "phase" if is_known else "delay"
        yield Finding(
            "phase of each link",
            f"channels have no {common} in common, as if each packet had its own",
            f"set data.phase={phase}, or check units, axes and order of tx, rx and elements",
        )
        strange = {}
    elif is_known and not sign and len(train) >= MANY * len(receivers.unique()):
        yield Finding(
            "phases without geometry",
            "phases of the channels do not follow the direct distance",
            "unless walls block most direct waves, check units and order of tx, rx, elements and h, and the "
            "frequencies, or set data.phase=per_link if each packet has a phase of its own",
        )
    for receiver, (elements, subcarriers, delay) in strange.items():
        unexplained = "have phases that geometry does not explain, the same at all links"
        if elements:
            yield Finding(
                "phases of elements",
                f"the elements of {links.receivers[receiver].name} {unexplained}",
                "check order, axes and unit of elements and tx, or calibrate the array",
            )
        if subcarriers:
            late = "check their order"
            if delay is not None:
                late = f"take a delay of {1e9 * delay:.3g} ns off h, or set data.phase=per_link_and_delay"
            yield Finding(
                "phases of subcarriers", f"the subcarriers of {links.receivers[receiver].name} {unexplained}", late
            )
