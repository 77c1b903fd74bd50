"""Conventions of places, arrays and channels, and how to correct data written under another one."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation
from torch import Tensor

from gaigs.core.geometry import from_spherical, to_spherical
from gaigs.data.checks.hypotheses import Hypothesis, Sample
from gaigs.data.checks.waves import direct_distances

Move = Callable[[Tensor], Tensor]


def conventions(sample: Sample, measure: Callable[[Sample], float]) -> Iterator[Hypothesis]:
    """Other conventions in which the data may have been written, most likely first.

    Args:
        sample: Links as read.
        measure: Function that rates how well geometry explains a sample, such as ``coherence``. The
            order of receivers with the best rating is one of the conventions.
    """
    ends: list[tuple[str, ...]] = [("tx",), ("rx",), ("tx", "rx")]
    yield from of_subcarriers(sample)
    if any(array.any() for array in sample.elements):
        ends = [("tx",), ("rx",), ("elements",), ("tx", "rx"), ("tx", "rx", "elements")]
        yield from of_arrays(sample)
    yield from of_axes(sample, ends)
    yield from of_frames()
    yield from of_angles()
    yield from of_units(ends)
    yield from of_receivers(sample, measure)


def of_subcarriers(sample: Sample) -> Iterator[Hypothesis]:
    """Conventions of subcarriers: order, unit, and phases without the carrier's part."""
    if len(sample.frequencies) > 1:
        name = "subcarriers are in reversed order, or path coefficients are conjugate"
        mend = "h = h[..., ::-1], or of conjugate coefficients h = h.conj()[..., ::-1]"
        yield changing(name, ["labels"], lambda labels: labels.flip(2), mend)
    for unit, factor in {"kHz": 1e3, "MHz": 1e6}.items():
        mend = f"frequencies = {factor:g} * frequencies"
        yield changing(
            f"frequencies are in {unit}", ["frequencies"], partial(torch.mul, other=factor), mend
        )
    # Elements and subcarriers whose phase is equal at all links: |mean phasor| is 1.
    is_constant = sample.labels.sgn().mean(0).abs() > 0.9999  # (e, s)
    # Phases were stored relative to the first subcarrier.
    is_relative = is_constant[:, 0].any() and not is_constant[:, -1].any()
    if is_relative or is_constant.all():
        return  # the carrier's phase was never stored
    name = "the carrier's phase over the delay is missing"
    mend = "multiply each path by np.exp(-2j * np.pi * carrier * tau) before the sum"
    # Distances count from the array's middle, or from each of several elements.
    has_several = sample.labels.shape[1] > 1
    for at_elements in (False, True) if has_several else (False,):
        yield Hypothesis(name, partial(_with_carrier, at_elements=at_elements), mend)


def of_arrays(sample: Sample) -> Iterator[Hypothesis]:
    """Conventions of arrays: order and unit of their elements, and their orientation."""
    yield changing(
        "elements are in reversed order",
        ["labels"],
        lambda labels: labels.flip(1),
        "h = h[:, ::-1]",
    )
    count = sample.labels.shape[1]
    for rows in range(2, count // 2 + 1):
        if count % rows == 0:
            mend = (
                f"h = h.reshape(len(h), {rows}, {count // rows}, -1).swapaxes(1, "
                "2).reshape(h.shape)"
            )
            name = "elements are in another order of rows and columns"
            yield changing(name, ["labels"], partial(_transposed, rows=rows), mend)
    wavelength = speed_of_light / sample.frequencies.mean().item()
    yield _scaled(["elements"], "wavelengths", wavelength)
    yield _scaled(["elements"], "half wavelengths", wavelength / 2)
    yield from of_orientations(sample)


def of_orientations(sample: Sample) -> Iterator[Hypothesis]:
    """Other conventions of rotations; none if all receivers have the world's axes."""
    if torch.allclose(sample.rotations, torch.eye(3).to(sample.rotations)):
        return
    for name, move, mend in (
        (
            "rotations lead from the world to the array",
            lambda turns: turns.mT,
            "rotation = rotation.T",
        ),
        ("elements have the world's axes", lambda turns: turns.mT @ turns, "rotation = np.eye(3)"),
        (
            "quaternions have the order w, x, y, z",
            partial(_rolled, by=-1),
            "quaternion = np.roll(quaternion, -1)",
        ),
        (
            "quaternions have the order x, y, z, w",
            partial(_rolled, by=1),
            "quaternion = np.roll(quaternion, 1)",
        ),
    ):
        yield changing(name, ["rotations"], move, mend)


def of_axes(sample: Sample, ends: Sequence[Sequence[str]]) -> Iterator[Hypothesis]:
    """Conventions with axes that are exchanged or point the other way.

    Args:
        ends: Groups of point names (``tx``, ``rx``, ``elements``) that are changed together.
    """
    exchanged = {"x and y": [1, 0, 2], "y and z": [0, 2, 1], "x and z": [2, 1, 0]}
    points = torch.cat((sample.transmitters, sample.positions))
    # If all points are on one side of a plane of the axes, there may be a wall in this plane. It
    # reflects as if the axis were negated, so the check of signs would be ambiguous.
    has_wall = (points >= 0).all(0) | (points <= 0).all(0)
    for subjects in ends:
        text = " and ".join(subjects)
        for name, order in exchanged.items():
            matrix = torch.eye(3)[:, order]
            yield _everywhere(subjects, f"{text} have {name} exchanged", f"[:, {order}]", matrix)
        for axis, name in enumerate("xyz"):
            signs = [1, 1, 1]
            signs[axis] = -1
            if subjects == ("elements",) or not has_wall[axis]:
                matrix = torch.tensor(signs).diag()
                yield _everywhere(subjects, f"{text} have {name} negated", f" * {signs}", matrix)
    for subjects in ends:
        if subjects not in (("tx",), ("rx",)):
            continue
        for name, order in {"y, z, x": [2, 0, 1], "z, x, y": [1, 2, 0]}.items():
            text = f"{subjects[0]} have the order {name}"
            yield _everywhere(subjects, text, f"[:, {order}]", torch.eye(3)[:, order])


def of_angles() -> Iterator[Hypothesis]:
    """Faults of places that were computed from angles at their receiver or at the origin."""
    north = "azimuths clockwise from north"
    polar = "elevations taken for polar angles, or the reverse"
    complement = "elevation = np.pi / 2 - elevation"
    for name, move, mend in (
        (north, lambda points: points[:, [1, 0, 2]], "azimuth = np.pi / 2 - azimuth"),
        (polar, _tilted, complement),
        # Below the horizon the azimuth is turned by half a circle.
        (polar, lambda points: -_tilted(points), complement),
        ("radians taken for degrees", _widened, "angles = np.rad2deg(angles)"),
    ):
        yield Hypothesis(f"tx are of {name}", partial(_about_receivers, move=move), mend)
        yield changing(f"tx are of {name} about the origin", ["transmitters"], move, mend)


def of_units(ends: Sequence[Sequence[str]]) -> Iterator[Hypothesis]:
    """Conventions with places and elements in other units than metres; km is the rarest.

    Args:
        ends: Groups of point names (``tx``, ``rx``, ``elements``) that are changed together.
    """
    units = {"mm": 1e-3, "cm": 1e-2, "inches": 0.0254, "feet": 0.3048, "km": 1e3}
    for unit, factor in units.items():
        for subjects in sorted(ends, key=len, reverse=True):
            yield _scaled(subjects, unit, factor)


def of_frames() -> Iterator[Hypothesis]:
    """Convention under which each transmitter is given relative to its receiver."""
    yield Hypothesis("tx are relative to rx", _from_receivers, "tx = tx + rx")


def of_plans(sample: Sample) -> Iterator[Hypothesis]:
    """Conventions with receivers counted from another corner or point of the floor plan."""
    low, high = sample.transmitters.amin(0), sample.transmitters.amax(0)
    for name, axes in {"x": [0], "y": [1], "x and y": [0, 1]}.items():
        move = partial(_mirrored, ends=low + high, axes=axes)
        mend = (
            f"rx[:, {axes}] = (tx.min(0) + tx.max(0) - rx)[:, {axes}], as rows of a picture run "
            "downwards"
        )
        yield changing(f"rx have {name} from the other end", ["positions"], move, mend)
    yield _everywhere(
        ("rx",), "rx have x and y negated", " * [-1, -1, 1]", torch.diag(torch.tensor([-1, -1, 1]))
    )
    for name, point, mend in (
        ("lowest corner", low, "tx.min(0)"),
        ("middle", (low + high) / 2, "(tx.min(0) + tx.max(0)) / 2"),
    ):
        shift = point * point.new_tensor([1, 1, 0])  # heights stay
        yield changing(
            f"the origin of rx is the {name} of tx",
            ["positions"],
            shift.add,
            f"rx[:, :2] += ({mend})[:2]",
        )


def of_receivers(sample: Sample, measure: Callable[[Sample], float]) -> Iterator[Hypothesis]:
    """Conventions with the receivers in another order.

    Orders are shifts by one and, for 3 to 8 receivers, the order with the best ``measure``.
    """
    count = len(sample.positions)
    read = torch.arange(count)
    # Two receivers have a single shift, and one receiver has none.
    orders = [read.roll(1), read.roll(-1)][: count - 1]
    if 2 < count <= 8:
        # Measure of each receiver's links if it stood at each place (receiver, place).
        fits = torch.zeros(count, count)
        for receiver in sample.receivers.unique().tolist():
            links = sample.at((sample.receivers == receiver).nonzero()[:, 0])
            for place in range(count):
                moved = replace(links, receivers=torch.full_like(links.receivers, place))
                fits[receiver, place] = measure(moved)
        orders.append(torch.from_numpy(linear_sum_assignment(-fits.numpy())[1]))
    for order in orders:
        is_shift = len((order - read).remainder(count).unique()) == 1
        name = "rows of rx are exchanged" + ", as by numbers from 1" * is_shift
        yield changing(name, ["receivers"], order.__getitem__, f"rx = rx[{order.tolist()}]")


def changing(name: str, parts: Sequence[str], move: Move, mend: str) -> Hypothesis:
    """A convention that changes the fields ``parts`` of a ``Sample`` by ``move``."""
    return Hypothesis(name, partial(_changed, parts=parts, move=move), mend)


def _everywhere(ends: Sequence[str], name: str, mend: str, matrix: Tensor) -> Hypothesis:
    """The convention under which stored points have to be multiplied by a matrix.

    Args:
        ends: Names of the points: ``tx``, ``rx`` or ``elements``.
        mend: The same multiplication in numpy, which the advice appends to each of these names.
        matrix: Matrix (3, 3), multiplied from the right.
    """
    parts = {"tx": "transmitters", "rx": "positions", "elements": "elements"}
    lines = "; ".join(f"{end} = {end}{mend}" for end in ends)
    return changing(
        name, [parts[end] for end in ends], partial(torch.matmul, other=matrix.double()), lines
    )


def _scaled(ends: Sequence[str], unit: str, factor: float) -> Hypothesis:
    """The convention under which points of ``ends`` are in a unit of ``factor`` metres."""
    subject = ends[-1]
    if len(ends) > 1:
        subject = f"{', '.join(ends[:-1])} and {subject}"
    return _everywhere(ends, f"{subject} are in {unit}", f" * {factor:.4g}", factor * torch.eye(3))


def _changed(sample: Sample, parts: Sequence[str], move: Move) -> Sample:
    """The sample with ``move`` applied to the fields ``parts``, or to each array in a tuple."""
    moved = {}
    for name in parts:
        value = getattr(sample, name)
        moved[name] = tuple(map(move, value)) if isinstance(value, tuple) else move(value)
    return replace(sample, **moved)


def _about_receivers(sample: Sample, move: Move) -> Sample:
    """The sample with transmitters moved relative to their receivers."""
    stands = sample.positions[sample.receivers]
    return replace(sample, transmitters=stands + move(sample.transmitters - stands))


def _from_receivers(sample: Sample) -> Sample:
    """The sample if its transmitters are read as offsets from their receivers."""
    return replace(sample, transmitters=sample.transmitters + sample.positions[sample.receivers])


def _mirrored(
    points: Float[Tensor, "r 3"], ends: Float[Tensor, "3"], axes: Sequence[int]
) -> Float[Tensor, "r 3"]:
    """Points mirrored along ``axes``; ``ends`` is the sum of lowest and highest coordinates."""
    moved = points.clone()
    moved[:, axes] = (ends - points)[:, axes]
    return moved


def _transposed(labels: Complex[Tensor, "n e s"], rows: int) -> Complex[Tensor, "n e s"]:
    """Channels with elements sorted by columns of a planar array, instead of by ``rows`` rows."""
    planar = labels.unflatten(1, (rows, -1))  # (n, rows, columns, s)
    return planar.transpose(1, 2).flatten(1, 2)


def _rolled(rotations: Float[Tensor, "r 3 3"], by: int) -> Float[Tensor, "r 3 3"]:
    """Rotations after the four numbers of their quaternions are rolled by ``by``."""
    quaternions = Rotation.from_matrix(rotations.numpy()).as_quat()
    rolled = np.roll(quaternions, by, 1)
    return torch.from_numpy(Rotation.from_quat(rolled).as_matrix())


def _tilted(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Points with pi / 2 - elevation in place of the elevation; azimuth and distance stay."""
    azimuths, elevations, distances = to_spherical(points)
    return distances[:, None] * from_spherical(azimuths, math.pi / 2 - elevations)


def _widened(points: Float[Tensor, "n 3"]) -> Float[Tensor, "n 3"]:
    """Points with azimuth and elevation multiplied by 180 / pi; the distance stays."""
    azimuths, elevations, distances = to_spherical(points)
    factor = math.degrees(1)
    return distances[:, None] * from_spherical(factor * azimuths, factor * elevations)


def _with_carrier(sample: Sample, at_elements: bool) -> Sample:
    """Channels times the direct wave's phase factor at the middle of the band.

    Args:
        at_elements: True to take the distance to each element, false to the array's middle.
    """
    distances = direct_distances(sample)
    if not at_elements:
        distances = distances.mean(1, keepdim=True)
    wavenumber = -2 * math.pi * sample.frequencies.mean() / speed_of_light
    phases = wavenumber * distances  # (n, e)
    phasors = torch.polar(torch.ones_like(phases), phases)
    return replace(sample, labels=sample.labels * phasors[..., None])
