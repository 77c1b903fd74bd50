"""Checks of data: units, axes, signs and orders under which geometry explains labels better."""

from collections.abc import Iterator
from typing import Any

from gaigs.data.checks.channels import check_channels
from gaigs.data.checks.finding import Finding
from gaigs.data.checks.levels import check_levels
from gaigs.data.checks.places import check_arrays, check_constant, check_edges, check_places
from gaigs.data.checks.spectra import check_directions, check_extremes

__all__ = ["Finding", "check"]


def check(links: Any) -> Iterator[Finding]:
    """Suspected faults of ``Links``, with or without a split."""
    yield from check_places(links)
    yield from check_edges(links)
    yield from check_arrays(links)
    if links.task.shape and links.task.name != "spectrum":
        yield from check_constant(links)
    match links.task.name:
        case "spectrum":
            yield from check_extremes(links)
            yield from check_directions(links)
        case "csi":
            yield from check_channels(links)
        case "rssi":
            yield from check_levels(links)
