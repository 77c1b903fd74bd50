"""Words of planes: the reflections of a path in their order, its images, and its way through the room."""

import itertools
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn import functional

NOWHERE = 1e-9
"""A ray whose ends are as far from a plane as each other, to this many metres, runs along it and meets it nowhere."""


UNTOLD = 4
"""A point whose height over a plane is less than so many roundings of its and the plane's distance from the origin is
on it: on which side it stands is not told."""


class Bounces(NamedTuple):
    """Where the paths with at least so many bounces meet a plane.

    Attributes:
        first: These are the words from this one on.
        planes: Of each of them (w,).
        points: Where they meet it (b, w, 3) [m].
        cosines: Of the angles of incidence (b, w).
    """

    first: int
    planes: Int[Tensor, "w"]
    points: Float[Tensor, "b w 3"]
    cosines: Float[Tensor, "b w"]


class Folded(NamedTuple):
    """Paths as they run through the room; a leg is a straight piece from one bounce to the next.

    Attributes:
        start, end: Of all legs (b, s, 3) [m].
        path: The word that a leg belongs to (s,).
        bounces: The last one of each word, the last but one, and so on.
        exists: Whether a path meets its planes in their order, from inside the room (b, n).
    """

    start: Float[Tensor, "b s 3"]
    end: Float[Tensor, "b s 3"]
    path: Int[Tensor, "s"]
    bounces: list[Bounces]
    exists: Bool[Tensor, "b n"]


def all_words(planes: int, order: int) -> Int[Tensor, "n order"]:
    """All words of at most ``order`` planes, none twice in a row; by length, shorter ones with -1 in front.

    The first plane of a word is the one that the transmitter's wave meets first.
    """
    found = []
    for length in range(order + 1):
        for word in itertools.product(range(planes), repeat=length):
            if all(a != b for a, b in itertools.pairwise(word)):
                found.append([-1] * (order - length) + list(word))
    return torch.tensor(found, dtype=torch.long).view(len(found), order)


def reflect(
    points: Float[Tensor, "*batch 3"], normals: Float[Tensor, "*batch 3"], offsets: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 3"]:
    """Images of points [m] in planes n . x = d: the closed form of the sandwich product with a plane's vector."""
    return points - 2 * ((points * normals).sum(-1) - offsets)[..., None] * normals


def images(
    points: Float[Tensor, "b 3"], words: Int[Tensor, "n order"], normals: Float[Tensor, "w 3"], offsets: Tensor
) -> list[Float[Tensor, "b n 3"]]:
    """Images of transmitters under the first 0, 1, ..., order planes of each word [m].

    Args:
        points: Transmitters [m].
        words: Sorted by length, as ``all_words`` has them.
        normals: Of unit length.
        offsets: Of the planes (w,) [m].
    """
    found = [points[:, None].expand(-1, len(words), -1)]
    for column in words.unbind(1):
        first = int((column < 0).sum())
        here = column[first:]
        moved = reflect(found[-1][:, first:], normals[here], offsets[here])
        found.append(torch.cat((found[-1][:, :first], moved), 1))
    return found


def fold(
    seen: list[Float[Tensor, "b n 3"]],
    receivers: Float[Tensor, "b 3"],
    words: Int[Tensor, "n order"],
    normals: Float[Tensor, "w 3"],
    offsets: Float[Tensor, "w"],
) -> Folded:
    """Folds straight lines from the receivers to the last images back into the room, at one plane after the other.

    A line that does not cross its plane is bent at the end nearer to it; such a path does not exist. Nor does one from
    or to a point on the plane: of two planes in one place a path meets neither after the other.

    Args:
        seen: What ``images`` gives.
        receivers: Where each query is heard [m].
        words, normals, offsets: As for ``images``.
    """
    here = receivers[:, None].expand(-1, len(words), -1)
    numbers = torch.arange(len(words), device=here.device)
    exists = torch.ones(here.shape[:2], dtype=torch.bool, device=here.device)
    starts, ends, path, bounces = [], [], [], []
    for step in reversed(range(words.shape[1])):
        first = int((words[:, step] < 0).sum())
        plane = words[first:, step]
        n, d = normals[plane], offsets[plane]
        begin, target = here[:, first:], seen[step + 1][:, first:]
        above, below = (begin * n).sum(-1) - d, (target * n).sum(-1) - d
        fall = above - below
        share = above / torch.where(fall.abs() > NOWHERE, fall, NOWHERE)
        at = begin + share.clamp(0, 1)[..., None] * (target - begin)
        apart = _is_told(above, begin, d) & _is_told(below, target, d)
        exists = torch.cat((exists[:, :first], exists[:, first:] & (share > 0) & (share < 1) & apart), 1)
        cosines = (functional.normalize(target - begin, dim=-1) * n).sum(-1).abs()
        bounces.append(Bounces(first, plane, at, cosines))
        starts.append(at)
        ends.append(begin)
        path.append(numbers[first:])
        here = torch.cat((here[:, :first], at), 1)
    starts.append(seen[0])
    ends.append(here)
    path.append(numbers)
    return Folded(torch.cat(starts, 1), torch.cat(ends, 1), torch.cat(path), bounces, exists)


def _is_told(
    heights: Float[Tensor, "b w"], points: Float[Tensor, "b w 3"], offsets: Float[Tensor, "w"]
) -> Bool[Tensor, "b w"]:
    """Whether points are on one side of a plane for sure."""
    rounding = torch.finfo(points.dtype).eps
    return heights.abs() > UNTOLD * rounding * (points.detach().norm(dim=-1) + offsets.detach().abs())
