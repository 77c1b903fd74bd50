"""Checks of places, walls and arrays: other units, other frames, receivers at one place."""

import math
from collections.abc import Iterator
from typing import Any

import torch
from jaxtyping import Float
from scipy.constants import speed_of_light
from scipy.spatial import cKDTree
from torch import Tensor

from gaigs.core.query import Query, evenly
from gaigs.data.checks.finding import Finding


def check_places(links: Any) -> Iterator[Finding]:
    """Findings about transmitters and receivers of any task."""
    yield from check_extent(links)
    receivers = links.receivers
    if len(receivers) > 10 and len(links) < 1.5 * len(receivers) and not links.one_radio:
        yield Finding(
            "receivers that move",
            f"{len(receivers)} receivers have {len(links)} links: models are learnt for each",
            "give a fixed receiver one place for all its links",
        )
    sites = sites_of(links.query)
    measured = _measured(links)
    tree = cKDTree(_positions(links)[measured].double().numpy())
    near = tree.query(sites.double().numpy())[0] < 0.01  # transmitters within 1 cm
    # A single place may be beside a receiver, and moving radios meet at the same places.
    if len(sites) > 1 and near.sum() > 1 and not links.one_radio:
        text = f"{int(near.sum())} places are where a receiver stands"
        yield Finding("places at a receiver", text)
    # Antennas of one mast may share their place; levels show whether they do.
    if links.task.is_scalar:
        return
    for pair in sorted(tree.query_pairs(0.01)):
        first, second = (receivers[measured[number]] for number in pair)
        rotated = (first.pose.rotation - second.pose.rotation).norm()
        if rotated < 0.01 and first.band == second.band:
            text = f"{first.name} and {second.name} stand at one place"
            yield Finding("receivers at one place", text)


def check_extent(links: Any) -> Iterator[Finding]:
    """Findings about an unusual extent of the places, and receivers far from all of them."""
    sites = sites_of(links.query)
    measured = _measured(links)
    extent = sites.amax(0) - sites.amin(0)
    span = extent.max().item()
    across = extent[:2].max().item()
    x, y = sites[:, :2].mean(0).tolist()
    # Longitude and latitude are far from 0 in comparison with the extent of a site.
    is_global = abs(x) <= 180 and abs(y) <= 90 and math.hypot(x, y) > 30 * across > 0
    if links.frame is None and is_global and across < 0.3:
        text = f"x and y of places span {across:.2g} m around ({x:.7g}, {y:.7g})"
        yield Finding(
            "unit of places",
            text,
            "are they degrees? convert them to metres, as data=rssi_wide does",
        )
    elif links.frame is None and len(sites) > 1 and span < 0.3:  # less than a table
        yield Finding("unit of places", f"places span {span:.3g} m", "are they in km or degrees?")
    elif links.task.is_scalar and scale_of(sites):  # spectra and channels show it themselves
        text = f"places span {span:.3g} m, as if {scale_of(sites)}"
        yield Finding("unit of places", text, "give them in metres")
    if len(sites) > 1 and measured:
        positions = _positions(links)[measured]
        closest = torch.cdist(sites.double(), positions.double()).min().item()
        if closest > 10 * max(span, 1e-6):
            text = f"receivers are {closest:.3g} m from all places, which span {span:.3g} m"
            yield Finding("receivers far away", text, "are units and origin alike?")


def scale_of(places: Float[Tensor, "n 3"]) -> str:
    """Name of an apparent scaling of places, such as to 0..1; empty if there is none."""
    low, high = places.min().item(), places.max().item()
    for lower, upper in ((0.0, 1.0), (-1.0, 1.0), (-0.5, 0.5)):
        margin = 0.15 * (upper - lower)  # places seldom reach the walls of the room that was scaled
        if 0 <= low - lower <= margin and 0 <= upper - high <= margin:
            return f"scaled to {lower:g}..{upper:g} along each axis"
    # Standardised coordinates have deviation 1 and mean 0.
    deviation_error = (places.std(0, correction=0) - 1).abs().max()
    mean_error = places.mean(0).abs().max()
    return "standardised along each axis" if max(deviation_error, mean_error) < 0.1 else ""


def sites_of(query: Query) -> Float[Tensor, "k 3"]:
    """The distinct places of transmitters [m]."""
    _, numbers = query.place_keys.unique(return_inverse=True)  # (n,)
    sites = query.transmitters.new_zeros((int(numbers.max()) + 1, 3))
    sites[numbers] = query.transmitters
    return sites


def check_arrays(links: Any) -> Iterator[Finding]:
    """Findings about elements in another unit or frame, and coordinates that float32 rounds."""
    transmitters = links.query.transmitters
    places = torch.cat((transmitters, _positions(links)))
    room = _diagonal(places)
    carriers = links.query.frequencies
    wavelength = speed_of_light / carriers.max().item() if carriers is not None else 0.0
    for receiver in links.receivers:
        elements = receiver.array.elements
        extent = _diagonal(elements)
        aside = elements.mean(0).norm().item()  # from the receiver's position [m]
        if extent > room > 0:
            yield Finding(
                "unit of elements",
                f"the array of {receiver.name} is {extent:.3g} m across, transmitters and "
                f"receivers {room:.3g} m",
                "are its elements in m?",
            )
        elif len(elements) > 1 and aside > 2 * extent:
            yield Finding(
                "frame of elements",
                f"the elements of {receiver.name} are {aside:.3g} m from its position",
                "elements are relative to it",
            )
        elif len(elements) > 1 and wavelength:
            apart = torch.pdist(elements).min().item()
            if apart > 3 * wavelength:
                yield Finding(
                    "unit of elements",
                    f"elements of {receiver.name} are {apart:.3g} m apart, "
                    f"{apart / wavelength:.3g} wavelengths",
                    "are they in m?",
                )
    # Half of the last digit of float32 at the largest coordinate [m].
    rounding = places.abs().max().item() * torch.finfo(torch.float32).eps / 2
    if links.task.dtype.is_complex and rounding > wavelength / 300 > 0:
        yield Finding(
            "origin",
            f"positions are rounded by up to {rounding:.2g} m, {rounding / wavelength:.2g} "
            "wavelengths, which phases show",
            "subtract a common origin from all",
        )


def check_walls(walls: Float[Tensor, "k 3"], places: Float[Tensor, "n 3"]) -> Iterator[Finding]:
    """A finding if walls are in another unit or area than the places, in the floor plan.

    Args:
        walls: Points of the walls [m].
        places: Transmitters and receivers [m].
    """
    across = _diagonal(walls[:, :2])
    room = _diagonal(places[:, :2])
    if across and room and not 1 / 50 < across / room < 50:  # millimetres differ by 1000
        text = f"the walls are {across:.3g} m across, transmitters and receivers {room:.3g} m"
        yield Finding("unit of walls", text, "are both in m?")
        return
    lower, upper = walls[:, :2].amin(0), walls[:, :2].amax(0)
    # Gap between the two boxes along x and y; negative where they overlap.
    gaps = torch.maximum(lower - places[:, :2].amax(0), places[:, :2].amin(0) - upper)  # (2,)
    apart = gaps.clamp_min(0).norm().item()
    if apart > 0.1 * (across + room):  # a single wall may also be some distance away
        text = f"the walls are {apart:.3g} m from all transmitters and receivers"
        yield Finding("frame of walls", text, "are both in one frame?")


def check_edges(links: Any) -> Iterator[Finding]:
    """Findings of ``check_walls`` about the walls that came with the data."""
    if len(links.edges):
        places = torch.cat((links.query.transmitters, _positions(links)))
        yield from check_walls(links.edges.flatten(0, 1), places)


def check_constant(links: Any) -> Iterator[Finding]:
    """A finding about labels of several values that are all equal."""
    labels = links.labels[evenly(torch.arange(len(links)), 256)].flatten(1)  # (k, m)
    constant = (labels == labels[:, :1]).all(1)
    if labels.shape[1] > 1 and constant.any():
        text = f"{int(constant.sum())} of {len(labels)} labels have one value throughout"
        yield Finding("constant labels", text)


def _measured(links: Any) -> list[int]:
    """Numbers of the receivers whose place is given, and not estimated from levels."""
    numbers = range(len(links.receivers))
    return [k for k in numbers if links.uncertainties is None or not links.uncertainties[k]]


def _positions(links: Any) -> Float[Tensor, "r 3"]:
    """Positions of all receivers [m]."""
    positions = [receiver.pose.position for receiver in links.receivers]
    return torch.stack(positions).to(links.query.transmitters)


def _diagonal(points: Float[Tensor, "k d"]) -> float:
    """Diagonal of the box around points [m]."""
    return (points.amax(0) - points.amin(0)).norm().item()
