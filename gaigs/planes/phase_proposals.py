"""A periodogram that finds planes near a known one whose reflections have equal phases."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float
from torch import Tensor
from torch.nn import functional

from gaigs.core.propagation import slab
from gaigs.planes.channel_links import ChannelData, ReceiverChannels, materials_of
from gaigs.planes.strengths import fit_free
from gaigs.splatting.placement.mirrored.reflections import polarised, reflect, tangents


class Phasors(NamedTuple):
    """Paths with a single reflection at a plane, from b places."""

    # Strengths over the root of the channels' power, with phases relative to the direct path.
    values: Complex[Tensor, " b"]
    slopes: Float[Tensor, "b 3"]  # derivatives of the path length by offset and two tilts
    cosines: Float[Tensor, " b"]  # cosines of the angles of incidence


class SlabPeak(NamedTuple):
    """Maximum of the periodogram over both tilts, at one offset."""

    height: float
    shift: Float[Tensor, "3"]  # change of the offset [m] and two tilts [rad]
    slab: Float[Tensor, "3"]  # as in ``SLABS``


def propose_by_phases(
    data: ChannelData,  # training channels
    planes: Float[Tensor, "w 4"],  # all known planes
    number: int,  # the plane that is moved
    reach: float,  # largest move along the normal [m]
    tilt: float,  # largest turn towards either side [rad]
    slabs: Float[Tensor, "m 3"],  # slabs that are tried
) -> list[tuple[Float[Tensor, "4"], Float[Tensor, "3"]]]:
    """Variants of plane ``number``, with slabs, whose reflections have equal phases at all places.

    Returns:
        Planes (4,) and slabs (3,): at most eight half-spaces and eight slabs, highest maxima of the
        periodogram first.
    """
    plane = planes[number]
    axes = tangents(plane[:3])
    grids = _grids(data, reach, tilt)
    offsets, tilts, other_tilts = grids
    parts = []
    references = data.reference_phases(planes, data.receivers)
    for receiver, phase in zip(data.receivers, references, strict=True):
        parts.append(_phasors(data, receiver, phase, planes, number))
    values, slopes, cosines = (torch.cat(column) for column in zip(*parts, strict=True))
    # Phase factors of the change in path length by each offset o, tilt t and other tilt u.
    factors = []
    for axis, grid in enumerate(grids):
        phases = 2 * math.pi / data.wavelength * slopes[:, axis, None] * grid  # (b, steps)
        factors.append(torch.polar(torch.ones_like(phases), phases))
    peaks: list[SlabPeak] = []
    for material in slabs:
        permittivity, thickness = materials_of(material)
        te, tm = slab(permittivity, cosines, thickness / data.wavelength)
        expected = polarised(plane[:3], te, tm)  # reflection coefficients Gamma (b,)
        # sum_b Re(a_b Gamma_b* exp(j k L_b(offset, tilts))) on the grid, as a product of matrices,
        # where a are ``values``, and L changes of the lengths.
        products = (values * expected.conj())[:, None] * factors[0]  # (b, o)
        products = products[:, :, None] * factors[1][:, None]  # (b, o, t)
        sums = (products.flatten(1).mT @ factors[2]).real  # (o t, u)
        sums = sums.unflatten(0, (len(offsets), -1)).flatten(1)  # (o, t u)
        highest, best_tilts = sums.max(1)
        highest = highest / (values.abs() * expected.abs()).sum()
        for step in range(len(highest)):
            # A maximum over five offsets: the neighbours are parts of the same lobe.
            if highest[step] == highest[max(0, step - 2) : step + 3].max():
                first = tilts[best_tilts[step] // len(other_tilts)]
                second = other_tilts[best_tilts[step] % len(other_tilts)]
                shift = torch.stack((offsets[step], first, second))
                peaks.append(SlabPeak(highest[step].item(), shift, material))
    peaks.sort(key=lambda peak: -peak.height)
    return [
        (_shifted(plane, axes, peak.shift), peak.slab)
        for peak in _distinct_peaks(peaks, data.wavelength / 6)
    ]


def _grids(data: ChannelData, reach: float, tilt: float) -> list[Float[Tensor, " k"]]:
    """Grids of the periodogram: offsets [m], and tilts [rad] towards two axes."""
    wavelength = data.wavelength
    # A step changes a path's length by an eighth (offset) or a fifth (tilt) of a wavelength at
    # most, so no lobe is missed: reflection points are within half a diagonal of the middle. Each
    # side has four steps or more.
    offset_step = min(wavelength / 16, reach / 4)
    tilt_step = min(wavelength / 5 / data.frame.diagonal, tilt / 4)
    offset_count = min(round(reach / offset_step), data.options.offset_cells)
    tilt_count = min(round(tilt / tilt_step), data.options.tilt_cells)
    offsets = offset_step * torch.arange(-offset_count, offset_count + 1).double()
    tilts = tilt_step * torch.arange(-tilt_count, tilt_count + 1).double()
    return [offsets, tilts, tilts]


def _shifted(
    plane: Float[Tensor, "4"],
    axes: tuple[Float[Tensor, "3"], Float[Tensor, "3"]],
    shift: Float[Tensor, "3"],
) -> Float[Tensor, "4"]:
    """A plane moved by ``shift[0]`` [m] and rotated by ``shift[1:]`` [rad] towards two axes."""
    turned = functional.normalize(plane[:3] + shift[1] * axes[0] + shift[2] * axes[1], dim=0)
    return torch.cat((turned, (plane[3] + shift[0])[None]))


def _phasors(
    data: ChannelData,
    receiver: ReceiverChannels,
    phase: Complex[Tensor, " c"],
    planes: Float[Tensor, "w 4"],
    number: int,
) -> Phasors:
    """Paths of one receiver with a single reflection, at plane ``number``.

    Their strengths are fitted together with those of all other paths. Only the places with the
    strongest reflections are used, about 120 over all receivers.
    """
    sequences = data.sequences(planes)
    is_single = sequences[:, :-1].lt(0).all(1) & (sequences[:, -1] == number)
    path = int(is_single.nonzero())
    waves = receiver.waves(receiver.images(planes, sequences))
    channels = receiver.flat.to(torch.complex64)
    strengths = fit_free(waves.to(torch.complex64), channels, 1e-4).strengths[:, path]
    normal, offset = planes[number, :3], planes[number, 3]
    axes = tangents(normal)

    def path_lengths(shift: Float[Tensor, "3"]) -> Float[Tensor, " b"]:
        plane = _shifted(planes[number], axes, shift)
        to_images = reflect(receiver.places, plane[:3], plane[3]) - receiver.position
        return to_images.norm(dim=1)

    slopes = torch.autograd.functional.jacobian(path_lengths, torch.zeros(3).double())  # (b, 3)
    to_images = reflect(receiver.places, normal, offset) - receiver.position  # (b, 3)
    cosines = (functional.normalize(to_images, dim=1) @ normal).abs().clamp(1e-3, 1)
    weights = strengths.abs() * waves[:, path].norm(dim=1) / receiver.flat.norm(dim=1)  # (b,)
    values = weights * strengths.sgn() * phase.conj()
    places_per_receiver = max(16, 120 // len(data.receivers))
    strongest = weights.argsort(descending=True)[:places_per_receiver]
    return Phasors(values[strongest], slopes[strongest], cosines[strongest])


def _distinct_peaks(peaks: list[SlabPeak], least: float) -> list[SlabPeak]:
    """At most eight half-spaces and eight slabs, the best one of each lobe.

    Two peaks of one kind are in the same lobe if their offsets differ by less than ``least`` [m].
    """
    half_spaces: list[SlabPeak] = []
    slabs: list[SlabPeak] = []
    distinct: list[SlabPeak] = []
    for peak in peaks:
        has_thickness = peak.slab[2] < 0  # a logarithm; half-spaces have 0, 1 m
        same_kind = slabs if has_thickness else half_spaces
        is_apart = all((peak.shift - other.shift)[0].abs() > least for other in same_kind)
        if len(same_kind) < 8 and is_apart:
            same_kind.append(peak)
            distinct.append(peak)
    return distinct
