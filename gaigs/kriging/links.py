"""What look-ups share: the links they learn from, how far apart links are, and labels in the directions asked for."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.data import Links
from gaigs.directions import Directions, Grid
from gaigs.query import Batch, Query
from gaigs.scene import Scene


def known_links(links: Links) -> list[Int[Tensor, "k"]]:
    """Those of each receiver that are not held out for the test.

    Raises:
        ValueError: A receiver has none.
    """
    known = [links.known(receiver) for receiver in range(len(links.receivers))]
    without = [receiver.name for receiver, index in zip(links.receivers, known, strict=True) if not len(index)]
    if without:
        raise ValueError(
            f"each receiver must have links to train or validate on, but on split {links.split.name!r} there are none "
            f"of {', '.join(without)}; choose another split, or leave the receiver out of the data"
        )
    return known


def evenly(index: Int[Tensor, "k"], most: int) -> Int[Tensor, "j"]:
    """At most so many of the links, evenly spread over their order."""
    if len(index) <= most:
        return index
    return index[torch.linspace(0, len(index) - 1, most).round().long()]


# --- how far apart links are ---


def coordinates(scene: Scene, query: Query, scale: float | None) -> Float[Tensor, "b d"]:
    """Places whose Euclidean distance is that of links: d² = |dx|² + (scale d ln f)², float64.

    Args:
        scene: Says whether the frequency counts.
        query: The links.
        scale: Distance that a step of 1 in the logarithm of the frequency counts as [m]; None where the training links
            have a single carrier, or none, and positions are all.

    Raises:
        ValueError: The frequency counts, and the query says none.
    """
    positions = query.transmitters.double()
    if scale is None:
        return positions
    half = (scene.frequencies[-1] / scene.frequencies[0]).double().log() / 2
    return torch.cat((positions, scale * half * scene.band_positions(query).double()[:, None]), 1)


def distances(a: Float[Tensor, "*c m d"], b: Float[Tensor, "*c n d"]) -> Float[Tensor, "*c m n"]:
    """Of all pairs [m].

    Plain differences: by the matrix product, links at one place would get different distances.
    """
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


def scale_bounds(scene: Scene) -> tuple[float, float]:
    """Least and largest ``scale`` of ``coordinates`` that the training links tell from less or more [m].

    With the least, the whole band counts as much as the step to the next place; with the largest, the step to the next
    carrier counts as much as the box's longest edge.
    """
    logarithms = scene.frequencies.double().log()
    edge = (scene.upper - scene.lower).max().item()
    band, step = (logarithms[-1] - logarithms[0]).item(), logarithms.diff().median().item()
    return scene.spacing / band, max(edge, scene.spacing) / step


# --- labels in the directions asked for ---


def at_directions(values: Tensor, batch: Batch, scene: Scene) -> Tensor:
    """Whole labels (b, rows, columns) in the directions that a batch asks for, each in the nearest row and column.

    Labels without directions, and those asked for in all of the label's own, come out as they are.
    """
    own, asked = scene.task.directions, batch.directions
    if own is None or asked is None or _is_same(asked, own):  # the usual case, told at once
        return values
    rows = _nearest(asked.elevations, own.elevations, None).to(values.device)
    columns = _nearest(asked.azimuths, own.azimuths, 2 * math.pi).to(values.device)
    if not isinstance(asked, Grid):
        return values[:, rows, columns]
    is_whole = rows.tolist() == [*range(own.shape[0])] and columns.tolist() == [*range(own.shape[1])]
    return values if is_whole else values[:, rows][:, :, columns]


def _is_same(asked: Directions, own: Grid) -> bool:
    """Whether a label is asked for in all of its own directions."""
    if not isinstance(asked, Grid) or asked.shape != own.shape:
        return False
    pairs = (asked.elevations, own.elevations), (asked.azimuths, own.azimuths)
    return all(torch.equal(a.to(b), b) for a, b in pairs)


def _nearest(asked: Float[Tensor, "k"], own: Float[Tensor, "n"], period: float | None) -> Int[Tensor, "k"]:
    """Which of some angles is nearest to each [rad]."""
    apart = asked.double().cpu()[:, None] - own.double().cpu()
    if period is not None:
        apart = apart - period * (apart / period).round()
    return apart.abs().argmin(1)
