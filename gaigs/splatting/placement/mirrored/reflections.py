"""Reflection paths: sequences of planes, images, and the straight legs of each path."""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import torch
from jaxtyping import Bool, Complex, Float, Inexact, Int
from torch import Tensor
from torch.nn import functional


class Folded(NamedTuple):
    """Paths of n sequences of planes through the room. A leg is a straight piece of a path.

    Legs are in the order of folding, from the receiver to the transmitter: first the legs from the
    last bounce of each sequence, then the legs from the last but one, and so on. The final n legs
    start at the transmitter. All other legs start at a bounce.
    """

    # Ends of all legs [m].
    start: Float[Tensor, "b s 3"]
    end: Float[Tensor, "b s 3"]
    path: Int[Tensor, " s"]  # number of each leg's sequence
    # Number of the first sequence with one bounce or more, with two or more, and so on.
    firsts: list[int]
    planes: Int[Tensor, " w"]  # number of each bounce's plane
    normals: Float[Tensor, "w 3"]  # normal of each bounce's plane
    cosines: Float[Tensor, "b w"]  # cosines of the angles of incidence
    # True if a path meets its planes in their order, from inside the room.
    exists: Bool[Tensor, "b n"]

    @property
    def bounces(self) -> Float[Tensor, "b w 3"]:
        """Points where planes reflect [m]."""
        return self.start[:, : len(self.planes)]

    def reflected(
        self, strengths: Complex[Tensor, "b n *s"], coefficients: Complex[Tensor, "b w *s"]
    ) -> Complex[Tensor, "b n *s"]:
        """Strengths of the sequences times the reflection coefficients at all their bounces."""
        for first, factors in self.parts(coefficients):
            without_bounce = strengths[:, :first]
            with_bounce = strengths[:, first:] * factors
            strengths = torch.cat((without_bounce, with_bounce), 1)
        return strengths

    def parts(
        self, values: Inexact[Tensor, "b w *s"]
    ) -> Iterator[tuple[int, Inexact[Tensor, "b k *s"]]]:
        """Yields the values at the last bounce of every path, then at the last but one, and so on.

        Values come with the number of the first path that has such a bounce. Paths are sorted by
        their number of bounces, so all later paths have such a bounce, too.
        """
        # Number of paths with at least one bounce, with at least two, and so on.
        counts = [self.exists.shape[1] - first for first in self.firsts]
        return zip(self.firsts, values.split(counts, 1), strict=True)


def seen_from(planes: Float[Tensor, "*w 4"], origin: Float[Tensor, "3"]) -> Float[Tensor, "*w 4"]:
    """The same planes (normal, offset [m]) in a frame whose origin is at ``origin`` [m].

    The offset of a plane is its distance from the frame's origin along its normal.
    """
    normals = planes[..., :3]
    offsets = planes[..., 3:]  # (..., 1)
    nearer = normals @ origin.to(normals)[:, None]  # (..., 1)
    return torch.cat((normals, offsets - nearer), -1)


def largest_order(planes: int, most: int) -> int:
    """Largest order of reflections for which ``all_sequences`` has at most ``most`` sequences.

    ``planes`` is the number of planes, two or more.
    """
    order = 0
    count = 1  # the direct path
    added = planes  # sequences of exactly order + 1 planes
    while count + added <= most:
        order += 1
        count += added
        added *= planes - 1  # no plane follows itself
    return order


def all_sequences(planes: int, order: int) -> Int[Tensor, "n order"]:
    """All sequences of at most ``order`` planes, each in the order in which a wave meets them.

    No plane follows itself. Shorter sequences come first, and are padded with -1 at their start.
    """
    sequences = []
    for length in range(order + 1):
        for sequence in itertools.product(range(planes), repeat=length):
            if all(a != b for a, b in itertools.pairwise(sequence)):
                sequences.append([-1] * (order - length) + list(sequence))
    return torch.tensor(sequences, dtype=torch.long).view(len(sequences), order)


def reflect(
    points: Float[Tensor, "*#batch 3"],
    normals: Float[Tensor, "*#batch 3"],
    offsets: Float[Tensor, "*#batch"],
) -> Float[Tensor, "*batch 3"]:
    """Images of points [m] in planes n . x = d: x - 2 (n . x - d) n.

    The formula is the closed form of the sandwich product with a plane's vector.
    """
    heights = (points * normals).sum(-1) - offsets  # n . x - d
    return points - 2 * heights[..., None] * normals


def images(
    points: Float[Tensor, "b 3"],
    sequences: Int[Tensor, "n order"],
    normals: Float[Tensor, "w 3"],
    offsets: Float[Tensor, "*#b w"],
) -> list[Float[Tensor, "b n 3"]]:
    """Images of transmitters at ``points`` [m] in the first 0, 1, ..., order planes of sequences.

    Sequences come from ``all_sequences``. Offsets [m] may differ between transmitters.
    """
    seen = [points[:, None].expand(-1, len(sequences), -1)]
    for first, column in zip(_firsts(sequences), sequences.unbind(1), strict=True):
        last = seen[-1]  # (b, n, 3)
        planes = column[first:]  # earlier sequences have no plane in this column
        reflected = reflect(last[:, first:], normals[planes], offsets[..., planes])
        seen.append(torch.cat((last[:, :first], reflected), 1))
    return seen


def _firsts(sequences: Int[Tensor, "n order"]) -> list[int]:
    """For each column, number of the first sequence whose entry is a plane (not -1)."""
    return (sequences < 0).sum(0).tolist()


def fold(
    seen: list[Float[Tensor, "b n 3"]],
    receivers: Float[Tensor, "b 3"],
    sequences: Int[Tensor, "n order"],
    normals: Float[Tensor, "w 3"],
    offsets: Float[Tensor, " w"],
) -> Folded:
    """Folds straight lines from the receivers to the last images back into the room.

    A path does not exist if its line does not cross one of its planes. Its bounce is then set to
    the end nearer to the plane. A path with an end on the plane does not exist either, so no path
    meets two coincident planes in succession.

    Args:
        seen: Result of ``images`` [m].
        receivers: Position of each link's receiver [m].
        sequences, normals, offsets: As for ``images``.
    """
    # Where each path has arrived on its way back from the receiver (b, n, 3).
    arrived = receivers[:, None].expand(-1, len(sequences), -1)
    numbers = torch.arange(len(sequences), device=arrived.device)
    exists = torch.ones(arrived.shape[:2], dtype=torch.bool, device=arrived.device)
    firsts = _firsts(sequences)[::-1]
    rounding = torch.finfo(arrived.dtype).eps
    starts: list[Tensor] = []
    ends: list[Tensor] = []
    path: list[Tensor] = []
    planes = [numbers[:0]]
    cosines = [receivers[:, :0]]
    # The bounces in turn from the last to the first. Sequences before ``first`` have fewer bounces
    # than ``back``.
    for back, first in enumerate(firsts, 1):
        plane = sequences[first:, -back]
        normal = normals[plane]
        offset = offsets[plane]
        # The line to the image in all planes that are not folded back yet crosses this plane.
        begin = arrived[:, first:]
        line = seen[-back][:, first:] - begin  # (b, sequences, 3)
        height = (begin * normal).sum(-1) - offset  # of the beginning over the plane
        rise = (line * normal).sum(-1)
        length = line.norm(dim=-1)
        with torch.no_grad():
            image_height = height + rise
            # An end within 4 roundings of the distances of both ends and of the plane is on the
            # plane.
            least = 4 * rounding * (begin.norm(dim=-1) + length + offset.abs())
            is_apart = (height.abs() > least) & (image_height.abs() > least)
            exists[:, first:] &= (height * image_height < 0) & is_apart
        # A line along the plane, which rises by less than 1e-9 m, does not meet it.
        fraction = -height / torch.where(rise.abs() > 1e-9, rise, -1e-9)
        bounce = begin + fraction.clamp(0, 1)[..., None] * line
        cosines.append(rise.abs() / length.clamp_min(torch.finfo(length.dtype).tiny))
        planes.append(plane)
        starts.append(bounce)
        ends.append(begin)
        path.append(numbers[first:])
        arrived = torch.cat((arrived[:, :first], bounce), 1)
    plane = torch.cat(planes)
    return Folded(
        start=torch.cat((*starts, seen[0]), 1),
        end=torch.cat((*ends, arrived), 1),
        path=torch.cat((*path, numbers)),
        firsts=firsts,
        planes=plane,
        normals=normals[plane],
        cosines=torch.cat(cosines, 1),
        exists=exists,
    )


def distinct(normals: Float[Tensor, "k 3"], least: float) -> list[Float[Tensor, "3"]]:
    """Unit normals, of which parallel ones are taken once, with the first one's sign.

    Two normals count as parallel if the magnitude of their cosine is within ``least`` of 1.
    """
    unique: list[Tensor] = []
    for normal in normals:
        if all((normal @ earlier).abs() < 1 - least for earlier in unique):
            unique.append(normal)
    return unique


def square_normals(normals: Float[Tensor, "w 3"], plane: int) -> list[Float[Tensor, "3"]]:
    """The normal of a plane, and normals within 18 degrees of it that would make the room square.

    Such normals are vertical, horizontal, parallel to another plane's normal, or horizontal and
    perpendicular to it. They are worth a trial, since a fit of powers leaves tilt errors of some
    degrees, and phases need exact tilts. ``plane`` is the number of the plane.
    """
    up = normals.new_tensor([0.0, 0.0, 1.0])
    normal = normals[plane]
    horizontal = normal * (1 - up)
    others = normals[torch.arange(len(normals)) != plane]
    across = torch.linalg.cross(others, up.expand_as(others))  # horizontal, perpendicular to others
    square = torch.cat((up[None], horizontal[None], others, across))
    # Shorter vectors come from nearly vertical normals, whose horizontal part is uncertain.
    square = functional.normalize(square[square.norm(dim=1) > 0.5], dim=1)
    square = square * (square @ normal).sign()[:, None]  # to the same side as the normal
    near = square[square @ normal > 0.95]  # the cosine of 18 degrees
    return distinct(torch.cat((normal[None], near)), 2e-5)


def tangents(normal: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Two unit vectors perpendicular to a normal and to each other."""
    # The axis that is the least parallel to the normal.
    axis = torch.zeros_like(normal)
    axis[normal.abs().argmin()] = 1
    first = functional.normalize(torch.linalg.cross(normal, axis), dim=0)
    return first, torch.linalg.cross(normal, first)


def reflection_points(
    starts: Float[Tensor, "b 3"], ends: Float[Tensor, "b 3"], planes: Float[Tensor, "w 4"]
) -> Float[Tensor, "b w 3"]:
    """Points at which planes reflect waves from starts to ends [m].

    Planes are (normal, offset [m]). If start and end are on opposite sides of a plane, one of them
    is first mirrored in the plane.
    """
    normals, offsets = planes[:, :3], planes[:, 3]
    start_heights = starts @ normals.T - offsets  # (b, w)
    end_heights = ends @ normals.T - offsets
    start_feet = starts[:, None] - start_heights[..., None] * normals  # (b, w, 3)
    end_feet = ends[:, None] - end_heights[..., None] * normals
    # Angles of incidence and reflection are equal, so the bounce divides the line between both
    # feet of the perpendiculars in the ratio of the heights.
    # At least 1e-6 m, so that ends on the plane do not divide by 0.
    start_heights = start_heights.abs().clamp_min(1e-6)[..., None]
    end_heights = end_heights.abs().clamp_min(1e-6)[..., None]
    return (start_feet * end_heights + end_feet * start_heights) / (start_heights + end_heights)


def polarised(
    normals: Float[Tensor, "*#n 3"], te: Complex[Tensor, "*n"], tm: Complex[Tensor, "*n"]
) -> Complex[Tensor, "*n"]:
    """Reflection coefficients of planes for vertical polarisation.

    They are TE at vertical planes, TM at horizontal ones, and a mean weighted by n_z² otherwise,
    with n_z the vertical component of the plane's unit normal.
    """
    level = normals[..., 2].square()
    return (1 - level) * te + level * tm
