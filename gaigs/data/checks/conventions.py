"""Conventions of channels, places and arrays, with what mends data that were written under them."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import torch
from jaxtyping import Float
from scipy.constants import speed_of_light
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from gaigs.data.checks.hypotheses import Hypothesis, Sample
from gaigs.geometry import from_spherical, to_spherical


def conventions(sample: Sample, measure: Callable[[Sample], float]) -> Iterator[Hypothesis]:
    """All other conventions of a sample; of equal ones the first is the likeliest fault.

    The order of receivers is the best one by a measure of the geometry, such as ``coherence``.
    """
    count = sample.labels.shape[1]
    with_arrays = any(array.any() for array in sample.elements)
    yield from of_subcarriers(sample)
    if with_arrays:
        yield from of_arrays(count)
    if not torch.allclose(sample.rotations, torch.eye(3).to(sample.rotations)):
        yield from of_rotations()
    yield from of_axes(sample, with_arrays)
    yield from of_angles()
    yield from of_units(sample, with_arrays)
    yield from of_receivers(sample, measure)


def of_subcarriers(sample: Sample) -> Iterator[Hypothesis]:
    """Orders of subcarriers, and phases that lack a part."""
    if len(sample.frequencies) > 1:
        name = "subcarriers are in reversed order, or path coefficients are conjugate"
        mend = "h = h[..., ::-1], or of conjugate coefficients h = h.conj()[..., ::-1]"
        yield Hypothesis(name, partial(_flipped, axis=2), mend)
    is_constant = sample.labels.sgn().mean(0).abs() > 0.9999  # (e, s), the phase of all links
    is_relative = is_constant[:, 0].any() and not is_constant[:, -1].any()
    if is_relative or is_constant.all():
        return  # phases were taken off, or never stored
    name = "the carrier's phase over the delay is missing"
    mend = "multiply each path by np.exp(-2j * np.pi * carrier * tau) before the sum"
    for at_elements in (False, True)[: sample.labels.shape[1]]:
        yield Hypothesis(name, partial(_with_carrier, at_elements=at_elements), mend)


def of_arrays(count: int) -> Iterator[Hypothesis]:
    """Orders of elements."""
    yield Hypothesis("elements are in reversed order", partial(_flipped, axis=1), "h = h[:, ::-1]")
    for rows in range(2, count // 2 + 1):
        if count % rows == 0:
            mend = f"h = h.reshape(len(h), {rows}, {count // rows}, -1).swapaxes(1, 2).reshape(h.shape)"
            name = "elements are in another order of rows and columns"
            yield Hypothesis(name, partial(_transposed, rows=rows), mend)


def of_rotations() -> Iterator[Hypothesis]:
    """Orientations of arrays."""
    changes = (
        ("rotations lead from the world to the array", _inverse, "rotation = rotation.T"),
        ("elements have the world's axes", _upright, "rotation = np.eye(3)"),
        ("quaternions have the order w, x, y, z", partial(_rolled, places=-1), "quaternion = np.roll(quaternion, -1)"),
        ("quaternions have the order x, y, z, w", partial(_rolled, places=1), "quaternion = np.roll(quaternion, 1)"),
    )
    for name, change, mend in changes:
        yield Hypothesis(name, change, mend)


def of_axes(sample: Sample, with_arrays: bool) -> Iterator[Hypothesis]:
    """Axes that are exchanged or point the other way."""
    ends: list[tuple[str, ...]] = [("tx",), ("rx",)]
    if with_arrays:
        ends += [("elements",), ("tx", "rx")]
    orders = {"x and y": [1, 0, 2], "y and z": [0, 2, 1], "x and z": [2, 1, 0]}
    turns = {"y, z, x": [2, 0, 1], "z, x, y": [1, 2, 0]}
    for own in ends:
        subject = " and ".join(own)
        for name, order in orders.items():
            yield _moved(own, f"{subject} have {name} exchanged", f"[:, {order}]", torch.eye(3)[:, order])
        for name, order in turns.items() if len(own) == 1 and own[0] != "elements" else ():
            yield _moved(own, f"{subject} have the order {name}", f"[:, {order}]", torch.eye(3)[:, order])
        for axis, name in enumerate("xyz"):
            points = torch.cat((sample.transmitters, sample.positions))[:, axis]
            if own[0] != "elements" and ((points >= 0).all() or (points <= 0).all()):
                continue  # a wall or floor in the plane of the axes reflects so
            signs = [1, 1, 1]
            signs[axis] = -1
            yield _moved(own, f"{subject} have {name} negated", f" * {signs}", torch.tensor(signs).diag())


def of_angles() -> Iterator[Hypothesis]:
    """Places computed from angles, about their receiver or the origin."""
    changes = (
        ("azimuths clockwise from north", _clockwise, "azimuth = np.pi / 2 - azimuth"),
        ("elevations taken for polar angles, or the reverse", _tilted, "elevation = np.pi / 2 - elevation"),
        ("elevations taken for polar angles, or the reverse", _sunk, "elevation = np.pi / 2 - elevation"),
        ("radians taken for degrees", _widened, "angles = np.rad2deg(angles)"),
    )
    for name, move, mend in changes:
        yield Hypothesis(f"tx are of {name}", partial(_about_receivers, move=move), mend)
        yield Hypothesis(f"tx are of {name} about the origin", partial(_about_origin, move=move), mend)


def of_units(sample: Sample, with_arrays: bool) -> Iterator[Hypothesis]:
    """Places and elements in other units than metres, frequencies in other units than Hz."""
    for unit, factor in {"kHz": 1e3, "MHz": 1e6}.items():
        change = partial(_at_frequencies, factor=factor)
        yield Hypothesis(f"frequencies are in {unit}", change, f"frequencies = {factor:g} * frequencies")
    units = {"mm": 1e-3, "cm": 1e-2, "inches": 0.0254, "feet": 0.3048, "km": 1e3}
    ends: list[tuple[str, ...]] = [("tx", "rx"), ("tx",), ("rx",)]
    if with_arrays:
        wavelength = speed_of_light / sample.frequencies.mean().item()
        yield _scaled(("elements",), "wavelengths", wavelength)
        yield _scaled(("elements",), "half wavelengths", wavelength / 2)
        ends += [("tx", "rx", "elements"), ("elements",)]
    for own in ends:
        for unit, factor in units.items():
            yield _scaled(own, unit, factor)


def of_receivers(sample: Sample, measure: Callable[[Sample], float]) -> Iterator[Hypothesis]:
    """The order of receivers by which the links of each fit one's place best; shifted by one if there are many."""
    count = len(sample.positions)
    own = torch.arange(count)
    orders = [own.roll(1), own.roll(-1)][: count - 1]
    if 2 < count <= 8:
        fits = torch.zeros(count, count)  # links of one receiver at the place of another
        for receiver in sample.receivers.unique().tolist():
            links = sample.at((sample.receivers == receiver).nonzero()[:, 0])
            for place in range(count):
                fits[receiver, place] = measure(replace(links, receivers=torch.full_like(links.receivers, place)))
        orders.append(torch.from_numpy(linear_sum_assignment(-fits.numpy())[1]))
    for order in orders:
        is_shift = len((order - own).remainder(count).unique()) == 1
        name = "rows of rx are exchanged" + ", as by numbers from 1" * is_shift
        yield Hypothesis(name, partial(_renumbered, order=order), f"rx = rx[{order.tolist()}]")


def _moved(ends: Sequence[str], name: str, mend: str, matrix: Tensor) -> Hypothesis:
    lines = "; ".join(f"{end} = {end}{mend}" for end in ends)
    return Hypothesis(name, partial(_mapped, ends=ends, matrix=matrix.double()), lines)


def _scaled(ends: Sequence[str], unit: str, factor: float) -> Hypothesis:
    lines = "; ".join(f"{end} = {factor:.4g} * {end}" for end in ends)
    name = f"{', '.join(ends[:-1])} and {ends[-1]}" if len(ends) > 1 else ends[0]
    change = partial(_mapped, ends=ends, matrix=factor * torch.eye(3, dtype=torch.float64))
    return Hypothesis(f"{name} are in {unit}", change, lines)


def _mapped(sample: Sample, ends: Sequence[str], matrix: Float[Tensor, "3 3"]) -> Sample:
    """The sample with points of some ends times a matrix."""
    if "tx" in ends:
        sample = replace(sample, transmitters=sample.transmitters @ matrix)
    if "rx" in ends:
        sample = replace(sample, positions=sample.positions @ matrix)
    if "elements" in ends:
        sample = replace(sample, elements=tuple(array @ matrix for array in sample.elements))
    return sample


def _flipped(sample: Sample, axis: int) -> Sample:
    return replace(sample, labels=sample.labels.flip(axis))


def _transposed(sample: Sample, rows: int) -> Sample:
    grid = sample.labels.unflatten(1, (rows, -1))  # (n, rows, columns, s)
    return replace(sample, labels=grid.transpose(1, 2).flatten(1, 2))


def _inverse(sample: Sample) -> Sample:
    return replace(sample, rotations=sample.rotations.mT)


def _upright(sample: Sample) -> Sample:
    return replace(sample, rotations=torch.eye(3).to(sample.rotations).expand_as(sample.rotations))


def _rolled(sample: Sample, places: int) -> Sample:
    """Rotations by quaternions whose four numbers are rolled."""
    quaternions = torch.from_numpy(Rotation.from_matrix(sample.rotations.numpy()).as_quat()).roll(places, 1)
    return replace(sample, rotations=torch.from_numpy(Rotation.from_quat(quaternions.numpy()).as_matrix()))


def _at_frequencies(sample: Sample, factor: float) -> Sample:
    return replace(sample, frequencies=factor * sample.frequencies)


def _renumbered(sample: Sample, order: Tensor) -> Sample:
    return replace(sample, receivers=order[sample.receivers])


def _about_receivers(sample: Sample, move: Callable[[Tensor], Tensor]) -> Sample:
    stands = sample.positions[sample.receivers]
    return replace(sample, transmitters=stands + move(sample.transmitters - stands))


def _about_origin(sample: Sample, move: Callable[[Tensor], Tensor]) -> Sample:
    return replace(sample, transmitters=move(sample.transmitters))


def _clockwise(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    return points[:, [1, 0, 2]]


def _tilted(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Points with their angle from the z axis as elevation."""
    azimuths, elevations, distances = to_spherical(points)
    return distances[:, None] * from_spherical(azimuths, math.pi / 2 - elevations)


def _sunk(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """The same of points below the horizon, where their azimuth is turned by half a circle."""
    return -_tilted(points)


def _widened(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Points at 180 / pi times their azimuth and elevation."""
    azimuths, elevations, distances = to_spherical(points)
    return distances[:, None] * from_spherical(math.degrees(1) * azimuths, math.degrees(1) * elevations)


def _with_carrier(sample: Sample, at_elements: bool) -> Sample:
    """Channels times the direct wave's phase at the middle of the band."""
    places = sample.positions[:, None]  # (r, 1, 3)
    if at_elements:
        elements = pad_sequence([*sample.elements], batch_first=True)
        places = places + torch.einsum("rwa,rea->rew", sample.rotations, elements)
    distances = (sample.transmitters[:, None] - places[sample.receivers]).norm(dim=-1)  # (n, e)
    phases = -2 * math.pi * sample.frequencies.mean() / speed_of_light * distances
    return replace(sample, labels=sample.labels * torch.polar(torch.ones_like(phases), phases)[..., None])
