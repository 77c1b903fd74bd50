"""Doubts about data that were read: sizes in another unit or frame, spectra without a direction."""

from typing import Any

import torch
from jaxtyping import Float
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.io.images import GreyImages
from gaigs.task.spectrum import SSIM_WINDOW, Spectrum

SPANS = 0.3, 1000.0
"""Least and largest usual extent of a measured room [m]; others are probably in another unit."""

LARGEST = 50.0
"""Ratio of two diagonals above which one is probably in another unit: millimetres differ by 1000."""


def doubts(links: Any) -> list[str]:
    """Sentences about places, walls, arrays and spectra of ``Links`` that do not fit the other data.

    Raises:
        ValueError: All spectra are constant, or too small for SSIM.
    """
    transmitters, receivers, task = links.query.transmitters, links.receivers, links.task
    stands = torch.stack([receiver.pose.position for receiver in receivers]).to(transmitters)
    places = torch.cat((transmitters, stands))
    found = places_doubts(links)
    found += [walls_doubt(links.edges.flatten(0, 1), places)] if len(links.edges) else []
    room, carriers = _diagonal(places), links.query.frequencies
    wavelength = speed_of_light / carriers.max().item() if carriers is not None else 0.0
    for receiver in receivers:
        elements = receiver.array.elements
        extent, aside = _diagonal(elements), elements.mean(0).norm().item()
        if extent > room > 0:
            found.append(
                f"the array of {receiver.name} is {extent:.3g} m across, transmitters and receivers {room:.3g} m; "
                "are its elements in m?"
            )
        elif len(elements) > 1 and aside > 2 * extent:
            found.append(
                f"the elements of {receiver.name} are {aside:.3g} m from its position; elements are relative to it"
            )
        elif len(elements) > 1 and wavelength and (apart := torch.pdist(elements).min().item()) > 3 * wavelength:
            found.append(
                f"elements of {receiver.name} are {apart:.3g} m apart, "
                f"{apart / wavelength:.3g} wavelengths; are they in m?"
            )
    rounding = places.abs().max().item() * torch.finfo(torch.float32).eps / 2
    if task.dtype.is_complex and rounding > wavelength / 300 > 0:
        found.append(
            f"positions are rounded by up to {rounding:.2g} m, {rounding / wavelength:.2g} wavelengths, which phases "
            "show; subtract a common origin from all"
        )
    if isinstance(task, Spectrum):
        found += _spectra_doubts(task, links.labels)
    return [doubt for doubt in found if doubt]


def places_doubts(links: Any) -> list[str]:
    """Sentences about an unusual extent of the places, and receivers far from all of them."""
    sites = links.query.transmitters.unique(dim=0)
    given = [k for k in range(len(links.receivers)) if links.uncertainties is None or not links.uncertainties[k]]
    span, found = (sites.amax(0) - sites.amin(0)).max().item(), []
    if links.frame is None and not SPANS[0] <= span <= SPANS[1]:
        found.append(f"places span {span:.3g} m; are they in mm, cm or km?")
    if len(sites) > 1 and given:
        stands = torch.stack([links.receivers[k].pose.position for k in given])
        closest = torch.cdist(sites.double(), stands.double()).min().item()
        if closest > 10 * max(span, 1e-6):
            found.append(
                f"receivers are {closest:.3g} m from all places, which span {span:.3g} m; are units and origin alike?"
            )
    return found


def walls_doubt(walls: Float[Tensor, "k 3"], places: Float[Tensor, "n 3"]) -> str:
    """A sentence if walls are in another unit or elsewhere than transmitters and receivers as seen from above."""
    own, room = _diagonal(walls[:, :2]), _diagonal(places[:, :2])
    if own and room and not 1 / LARGEST < own / room < LARGEST:
        return f"the walls are {own:.3g} m across, transmitters and receivers {room:.3g} m; are both in m?"
    lower, upper = walls[:, :2].amin(0), walls[:, :2].amax(0)
    apart = torch.maximum(lower - places[:, :2].amax(0), places[:, :2].amin(0) - upper).clamp_min(0).norm().item()
    if apart > 0.1 * (own + room):  # a single wall stands apart, too
        return f"the walls are {apart:.3g} m from all transmitters and receivers; are both in one frame?"
    return ""


def _diagonal(points: Float[Tensor, "k d"]) -> float:
    return (points.amax(0) - points.amin(0)).norm().item()


def _spectra_doubts(task: Spectrum, labels: Tensor | GreyImages) -> list[str]:
    """Counts of constant spectra, and of min-max spectra without a pixel of 0 or of 1."""
    if min(task.shape) < SSIM_WINDOW:
        rows, columns = task.shape
        raise ValueError(f"spectra must have {SSIM_WINDOW} x {SSIM_WINDOW} pixels or more, got {rows} x {columns}")
    parts = (labels[index].flatten(1) for index in torch.arange(len(labels)).split(256))
    low, high = torch.cat([torch.stack((part.amin(1), part.amax(1)), 1) for part in parts]).T
    constant = low == high
    if constant.all():
        raise ValueError(f"a spectrum must have pixels of different values; all {len(labels)} are constant")
    whole = ~torch.tensor(task.normalisation.startswith("min-max")) | ((low == 0) & (high == 1)) | constant
    found = []
    for which, defect in ((constant, "are constant"), (~whole, "lack a pixel of 0 or of 1")):
        if which.any():
            first = int(which.nonzero()[0])
            span = f"{low[first]:.3g} to {high[first]:.3g}"
            found.append(f"{int(which.sum())} of {len(labels)} spectra {defect}, first that of link {first}, {span}")
    return found
