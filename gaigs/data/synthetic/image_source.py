"""The image-source method in a furnished box room, in float64; docs/data.md has its formulas."""

import itertools
import math
from dataclasses import dataclass

import torch
from jaxtyping import Complex, Float, Int
from scipy.constants import epsilon_0
from torch import Tensor

from gaigs.core.antenna import Receiver
from gaigs.core.propagation import free_space, fresnel
from gaigs.data.simulation import sample_band

MATERIALS = {
    "concrete": (5.24, 0.0462, 0.7822),
    "brick": (3.91, 0.0238, 0.16),
    "plasterboard": (2.73, 0.0085, 0.9395),
    "wood": (1.99, 0.0047, 1.0718),
    "glass": (6.31, 0.0036, 1.3394),
    "ceiling_board": (1.48, 0.0011, 1.0750),
    "metal": (1.0, 1e7, 0.0),
}
"""Relative permittivity, and c and d of the conductivity c (f / GHz)^d [S/m], 1 to 40 GHz.

Source: ITU-R P.2040-3, table 3.
"""

TABULATED = {
    **MATERIALS,
    "chipboard": (2.58, 0.0217, 0.7800),
    "plywood": (2.71, 0.33, 0.0),
    "marble": (7.074, 0.0055, 0.9262),
}
"""Materials of the standard's table, also those in no simulated room."""


@dataclass(frozen=True)
class Box:
    """A piece of furniture: a box along the room's axes that attenuates waves through it."""

    name: str
    # Opposite corners, world frame [m].
    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    loss_db: float  # penetration loss of one passage of any length [dB]


@dataclass(frozen=True)
class Room:
    """A box room with one corner at the world's origin."""

    size: tuple[float, float, float]  # extent along x, y and z [m]
    # Materials of the walls at x = 0, x = size, y = 0, y = size, of the floor and of the ceiling.
    walls: tuple[str, str, str, str, str, str]
    furniture: tuple[Box, ...] = ()


def permittivity(material: str, frequency: float) -> complex:
    """Complex relative permittivity of a material at a frequency [Hz], for exp(+j omega t).

    Source: ITU-R P.2040-3, section 2.1.4.
    """
    if material not in MATERIALS:
        raise ValueError(f"unknown material {material!r}; there are: {', '.join(MATERIALS)}")
    if not 1e9 <= frequency <= 40e9:
        raise ValueError(
            "frequency must lie in 1e9..40e9 Hz, where materials are tabulated, "
            f"got {frequency:.6g}"
        )
    omega_epsilon = 2 * math.pi * epsilon_0 * frequency
    return complex(MATERIALS[material][0], -conductivity(material, frequency) / omega_epsilon)


def conductivity(material: str, frequency: float) -> float:
    """Conductivity of a material [S/m] at a frequency [Hz]; extrapolated outside the tables."""
    _, c, d = TABULATED[material]
    return c * (frequency / 1e9) ** d


def cells(order: int) -> Int[Tensor, "p 3"]:
    """Numbers (i, j, k) along x, y and z of the room's mirrored copies.

    A path to a copy has |i| + |j| + |k| reflections, at most ``order``. Copies with fewer
    reflections come first.
    """

    def reflections(cell: tuple[int, ...]) -> int:
        return sum(map(abs, cell))

    steps = range(-order, order + 1)
    near = [cell for cell in itertools.product(steps, repeat=3) if reflections(cell) <= order]
    return torch.tensor(sorted(near, key=reflections))


def mirror(
    points: Float[Tensor, "*#batch 3"], cell: Int[Tensor, "*#batch 3"], size: Float[Tensor, "3"]
) -> Tensor:
    """Positions of the room's points [m] in a mirrored copy of the room.

    Args:
        cell: Number of the copy along each axis, from ``cells``. Odd numbers are mirrored.
        size: Extent of the room [m].
    """
    return cell * size + torch.where(cell % 2 == 0, points, size - points)


def passes(
    start: Float[Tensor, "*#batch 3"],
    end: Float[Tensor, "*#batch 3"],
    lower: Float[Tensor, "*#batch 3"],
    upper: Float[Tensor, "*#batch 3"],
) -> Tensor:
    """True for segments from ``start`` to ``end`` that pass through boxes along the axes.

    Args:
        lower, upper: Opposite corners of the boxes [m].
    """
    ray = end - start
    # Shares of the segment at which it crosses the planes of the faces. A segment within a face
    # gives 0 / 0 = NaN, which counts as not passing.
    first = (lower - start) / ray
    second = (upper - start) / ray
    # The part inside a box is between the last entry and the first exit of the three axes.
    entry = torch.minimum(first, second).amax(-1).clamp(min=0)
    exit_ = torch.maximum(first, second).amin(-1).clamp(max=1)
    return entry < exit_


@dataclass(frozen=True)
class Paths:
    """Paths from transmitters to one receiver position, each straight from an image."""

    # Mirrored transmitters, world frame [m]; the first is the transmitter itself.
    images: Float[Tensor, "b p 3"]
    # Product of the path's reflection coefficients and penetration losses; free space has 1.
    gains: Complex[Tensor, "b p"]


def trace(
    room: Room,
    transmitters: Float[Tensor, "b 3"],
    receiver: Float[Tensor, "3"],
    frequency: float,
    order: int,
) -> Paths:
    """Every path with at most ``order`` reflections between positions [m].

    Gains are at a frequency [Hz]. The field is vertically polarised: TE at the four walls, TM at
    floor and ceiling. The furniture is mirrored with the room, so a path is the straight line from
    the receiver to an image.

    Source: Allen and Berkley, Image method for efficiently simulating small-room acoustics, 1979;
    ITU-R P.2040-3.
    """
    if order < 0:
        raise ValueError(f"order must be the largest number of reflections, 0 or more, got {order}")
    transmitters = transmitters.double()
    receiver = receiver.double()
    size = transmitters.new_tensor(room.size)
    points = torch.cat((receiver[None], transmitters))
    if len(blocked := points[~is_free(room, points)]):
        raise ValueError(
            f"transmitters and receiver must lie inside the room of {room.size} m and outside its "
            f"furniture, got {blocked[0].round(decimals=4).tolist()}; move it"
        )
    cell = cells(order).to(size.device)  # (p, 3)
    images = mirror(transmitters[:, None], cell, size)  # (b, p, 3)
    rays = images - receiver
    # Cosine of the angle of incidence on a wall across each axis.
    cosines = rays.abs() / rays.norm(dim=-1, keepdim=True)  # (b, p, 3)

    gains = torch.ones_like(cosines[..., 0], dtype=torch.complex128)
    for wall, material in enumerate(room.walls):
        axis, side = divmod(wall, 2)  # side 0 is at coordinate 0, side 1 at the room's size
        te, tm = fresnel(permittivity(material, frequency), cosines[..., axis])
        # Two opposite walls share the |i| reflections of copy i. If |i| is odd, the wall on the
        # image's side has one more.
        is_towards = cell[:, axis] > 0 if side else cell[:, axis] < 0
        reflections = (cell[:, axis].abs() + is_towards) // 2  # (p,)
        gains = gains * (tm if axis == 2 else te) ** reflections

    if room.furniture:
        boxes = room.furniture
        corners = size.new_tensor([(box.lower, box.upper) for box in boxes])  # (boxes, 2, 3)
        mirrored = mirror(corners[:, :, None], cell, size)  # (boxes, 2, copies, 3)
        ends = images[:, :, None, None]  # (b, p, 1, 1, 3)
        lower, upper = mirrored.aminmax(dim=1)  # (boxes, copies, 3)
        through = passes(receiver, ends, lower, upper)  # (b, p, boxes, copies)
        counts = through.sum(-1).double()  # copies of each box that a path passes, (b, p, boxes)
        loss_db = counts @ size.new_tensor([box.loss_db for box in boxes])
        gains = gains * 10 ** (-loss_db / 20)
    return Paths(images, gains)


def bounces(
    room: Room, images: Float[Tensor, "b p 3"], receiver: Float[Tensor, "3"], order: int
) -> Float[Tensor, "b p order 3"]:
    """Reflection points of paths [m], in order from the receiver; NaN after the last one.

    The walls of all mirrored copies are planes of a lattice. A straight line to an image crosses a
    plane at each reflection. The crossings are folded back into the room.
    """
    start = receiver.to(images)
    size = images.new_tensor(room.size)
    ray = images - start  # (b, p, 3)
    numbers = torch.arange(1 - order, order + 1).to(images)
    planes = numbers[:, None] * size  # coordinates of the planes across each axis, (2 order, 3)
    # Shares of the line at which it crosses each plane; planes beyond its ends count as NaN.
    shares = ((planes - start) / ray[:, :, None]).flatten(2)  # (b, p, 6 order)
    shares = torch.where((shares > 0) & (shares < 1), shares, torch.nan)
    shares = shares.sort(-1).values[..., :order]  # (b, p, order)
    points = (start + shares[..., None] * ray[:, :, None]) / size
    # Every other copy of the room is mirrored: a triangle wave of period 2.
    return (points - 2 * (points / 2).round()).abs() * size


def is_free(room: Room, points: Float[Tensor, "*batch 3"]) -> Tensor:
    """True for points inside the room and outside its furniture."""
    free = ((points > 0) & (points < points.new_tensor(room.size))).all(-1)
    for box in room.furniture:
        above_lower = points >= points.new_tensor(box.lower)
        below_upper = points <= points.new_tensor(box.upper)
        free &= ~(above_lower & below_upper).all(-1)
    return free


def frequency_offsets(room: Room, bandwidth: float, order: int) -> Float[Tensor, " f"]:
    """Frequencies from ``sample_band`` for the room's longest path, relative to the middle [Hz]."""
    return sample_band(bandwidth, (order + 1) * math.hypot(*room.size))


def respond(
    paths: Paths, receiver: Receiver, frequency: float, offsets: Float[Tensor, " f"]
) -> Complex[Tensor, "b elements f"]:
    """Field at each element of a receiver's array, along paths from unit-power transmitters.

    The phase is of a spherical wave from each image to each element. Gains and the elements'
    pattern are computed at the array's centre and the carrier; ``offsets`` are relative to the
    carrier [Hz].
    """
    frequencies = frequency + offsets.double()
    if frequencies.min() <= 0:
        raise ValueError(
            f"frequencies must be positive, got {frequencies.min():.6g} Hz; narrow the bandwidth"
        )
    position = receiver.pose.position.double()
    rotation = receiver.pose.rotation.double()
    elements = position + receiver.array.elements.double() @ rotation.T  # (elements, 3)
    fields = []
    # 16 transmitters at a time: the waves of all paths take many times the memory of their sums.
    for images, gains in zip(paths.images.split(16), paths.gains.split(16), strict=True):
        local = (images - position) @ rotation  # in the receiver's frame, (16, p, 3)
        gains = gains * receiver.array.gain(local / local.norm(dim=-1, keepdim=True))
        distances = (images[:, :, None] - elements).norm(dim=-1)  # (16, p, elements)
        waves = free_space(distances[..., None], frequencies)  # (16, p, elements, f)
        fields.append(torch.einsum("bp,bpnf->bnf", gains, waves))
    return torch.cat(fields)
