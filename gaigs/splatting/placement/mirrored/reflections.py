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
        """Strengths of the sequences times the reflection coefficients at all their reflections."""
        for first, part in self.parts(coefficients):
            strengths = torch.cat((strengths[:, :first], strengths[:, first:] * part), 1)
        return strengths

    def parts(
        self, values: Inexact[Tensor, "b w *s"]
    ) -> Iterator[tuple[int, Inexact[Tensor, "b k *s"]]]:
        """Yields the values at the last bounce of every path, then at the last but one, and so on.

        Each part comes with the number of the first path that has such a bounce. All later paths
        have it, too.
        """
        counts = [self.exists.shape[1] - first for first in self.firsts]
        return zip(self.firsts, values.split(counts, 1), strict=True)


def seen_from(planes: Float[Tensor, "*w 4"], origin: Float[Tensor, "3"]) -> Float[Tensor, "*w 4"]:
    """Planes (normal, offset along it [m]), with offsets from another ``origin`` [m]."""
    normals, offsets = planes[..., :3], planes[..., 3:]
    return torch.cat((normals, offsets - normals @ origin.to(normals)[:, None]), -1)


def largest_order(planes: int, most: int) -> int:
    """Largest order with at most ``most`` sequences of ``planes``, a number of two or more."""
    order = 0
    count = 1
    longest = planes  # sequences of the next order
    while count + longest <= most:
        order += 1
        count += longest
        longest *= planes - 1
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
    return points - 2 * ((points * normals).sum(-1) - offsets)[..., None] * normals


def images(
    points: Float[Tensor, "b 3"],
    sequences: Int[Tensor, "n order"],
    normals: Float[Tensor, "w 3"],
    offsets: Float[Tensor, "*#b w"],
) -> list[Float[Tensor, "b n 3"]]:
    """Images of transmitters [m] in the first 0, 1, ..., order planes of each sequence.

    Sequences come from ``all_sequences``. ``offsets`` may differ between transmitters.
    """
    seen = [points[:, None].expand(-1, len(sequences), -1)]
    for first, column in zip(_firsts(sequences), sequences.unbind(1), strict=True):
        here = column[first:]
        moved = reflect(seen[-1][:, first:], normals[here], offsets[..., here])
        seen.append(torch.cat((seen[-1][:, :first], moved), 1))
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
    """
    # Where each path has arrived on its way back from the receiver (b, n, 3).
    here = receivers[:, None].expand(-1, len(sequences), -1)
    numbers = torch.arange(len(sequences), device=here.device)
    exists = torch.ones(here.shape[:2], dtype=torch.bool, device=here.device)
    firsts = _firsts(sequences)[::-1]
    rounding = torch.finfo(here.dtype).eps
    starts: list[Tensor] = []
    ends: list[Tensor] = []
    path: list[Tensor] = []
    planes = [numbers[:0]]
    cosines = [receivers[:, :0]]
    # From the last plane to the first, each with the sequences that have one so far back.
    for back, first in enumerate(firsts, 1):
        plane = sequences[first:, -back]
        n = normals[plane]
        d = offsets[plane]
        # The line to the image in all planes that are not folded back yet crosses this plane.
        begin = here[:, first:]
        way = seen[-back][:, first:] - begin  # (b, sequences, 3)
        height = (begin * n).sum(-1) - d  # of the beginning over the plane
        rise = (way * n).sum(-1)
        length = way.norm(dim=-1)
        with torch.no_grad():
            beyond = height + rise  # height of the image
            # An end within 4 roundings of the distances of both ends and of the plane is on the
            # plane.
            least = 4 * rounding * (begin.norm(dim=-1) + length + d.abs())
            is_apart = (height.abs() > least) & (beyond.abs() > least)
            exists[:, first:] &= (height * beyond < 0) & is_apart
        # A line along the plane, which rises by less than 1e-9 m, does not meet it.
        share = -height / torch.where(rise.abs() > 1e-9, rise, -1e-9)
        at = begin + share.clamp(0, 1)[..., None] * way
        cosines.append(rise.abs() / length.clamp_min(torch.finfo(length.dtype).tiny))
        planes.append(plane)
        starts.append(at)
        ends.append(begin)
        path.append(numbers[first:])
        here = torch.cat((here[:, :first], at), 1)
    plane = torch.cat(planes)
    return Folded(
        start=torch.cat((*starts, seen[0]), 1),
        end=torch.cat((*ends, here), 1),
        path=torch.cat((*path, numbers)),
        firsts=firsts,
        planes=plane,
        normals=normals[plane],
        cosines=torch.cat(cosines, 1),
        exists=exists,
    )


def distinct(normals: Float[Tensor, "k 3"], least: float) -> list[Float[Tensor, "3"]]:
    """Normals without repetition; two count as parallel if |cosine| is within ``least`` of 1."""
    apart: list[Tensor] = []
    for normal in normals:
        if all((normal @ other).abs() < 1 - least for other in apart):
            apart.append(normal)
    return apart


def square_normals(normals: Float[Tensor, "w 3"], plane: int) -> list[Float[Tensor, "3"]]:
    """The normal of a plane, and normals within 18 degrees of it that would make the room square.

    Such normals are horizontal, vertical, or perpendicular to another plane's. They are worth a
    trial, since a fit of powers leaves tilt errors of some degrees, and phases need exact tilts.
    """
    up = normals.new_tensor([0.0, 0.0, 1.0])
    normal = normals[plane]
    others = normals[torch.arange(len(normals)) != plane]
    across = torch.linalg.cross(others, up.expand_as(others))
    square = torch.cat((up[None], normal[None] * (1 - up), others, across))
    square = functional.normalize(square[square.norm(dim=1) > 0.5], dim=1)
    square = square * (square @ normal).sign()[:, None]
    return distinct(torch.cat((normal[None], square[square @ normal > 0.95])), 2e-5)


def tangents(normal: Float[Tensor, "3"]) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
    """Two unit vectors perpendicular to a normal and to each other."""
    other = torch.zeros_like(normal)
    other[normal.abs().argmin()] = 1
    first = functional.normalize(torch.linalg.cross(normal, other), dim=0)
    return first, torch.linalg.cross(normal, first)


def reflection_points(
    starts: Float[Tensor, "b 3"], ends: Float[Tensor, "b 3"], planes: Float[Tensor, "w 4"]
) -> Float[Tensor, "b w 3"]:
    """Points at which planes reflect waves from starts to ends [m].

    If start and end are on opposite sides of a plane, one of them is first mirrored in the plane.
    """
    normals, offsets = planes[:, :3], planes[:, 3]
    start_heights = starts @ normals.T - offsets  # (b, w)
    end_heights = ends @ normals.T - offsets
    start_feet = starts[:, None] - start_heights[..., None] * normals  # (b, w, 3)
    end_feet = ends[:, None] - end_heights[..., None] * normals
    # The bounce divides the line of the feet as the heights.
    start_heights = start_heights.abs().clamp_min(1e-6)[..., None]
    end_heights = end_heights.abs().clamp_min(1e-6)[..., None]
    return (start_feet * end_heights + end_feet * start_heights) / (start_heights + end_heights)


def polarised(
    normals: Float[Tensor, "*#n 3"], te: Complex[Tensor, "*n"], tm: Complex[Tensor, "*n"]
) -> Complex[Tensor, "*n"]:
    """Reflection coefficients for vertical polarisation.

    They are TE at vertical planes, TM at horizontal ones, and a mean weighted by n_z² otherwise.
    """
    level = normals[..., 2].square()
    return (1 - level) * te + level * tm
