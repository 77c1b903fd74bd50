"""Known links, distances between links, and labels in the directions of a batch."""

import math
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn import functional

from gaigs.core.geometry import Grid
from gaigs.core.query import Batch, Query, evenly
from gaigs.core.scene import Scene
from gaigs.data import Links

PART = 256
"""Number of labels held in memory at a time; a spectrum takes 130 KB."""


def known_links(links: Links, any_receiver: bool = False) -> list[Int[Tensor, " k"]]:
    """Indices of the training and validation links, a tensor for each receiver.

    With ``one_radio`` a single tensor has all links.

    Raises:
        ValueError: A receiver has no links. With ``any_receiver`` this is allowed if the split
            holds out receivers, since the model needs no links there.
    """
    if links.one_radio:
        return [links.split.known]
    known = [links.known(receiver) for receiver in range(len(links.receivers))]
    pairs = zip(links.receivers, known, strict=True)
    without_links = [receiver.name for receiver, index in pairs if not len(index)]
    if without_links and not (any_receiver and links.split.by_receivers):
        kind = "known" if len(links.split.validation) else "training"
        remedy = "choose another split"
        if links.split.by_receivers:
            remedy += ", or a model for receivers without links"
        raise ValueError(
            f"split {links.split.name!r} has no {kind} links of {', '.join(without_links)}; "
            f"{remedy}"
        )
    return known


def check_known(links: Links) -> None:
    """Raises the ``ValueError`` of ``known_links`` for all known links and for validation links."""
    known_links(links, any_receiver=True)
    known_links(replace(links, split=links.split.validating()), any_receiver=True)


def limit_known(links: Links, most: int) -> Links:
    """The same links with at most ``most`` known links of each receiver, evenly spread."""
    chosen = torch.cat([evenly(index, most) for index in known_links(links, any_receiver=True)])
    split: Any = links.split
    train = split.train[torch.isin(split.train, chosen)]
    validation = split.validation[torch.isin(split.validation, chosen)]
    return replace(links, split=replace(split, train=train, validation=validation))


def folds_of(links: Links, index: Int[Tensor, " k"], count: int = 10) -> Int[Tensor, " k"]:
    """Random fold, from 0, of each link ``index``; links of a group or place share a fold."""
    groups = links.split.groups
    if groups is None:
        groups = place_numbers(links.query.transmitters[index])
    else:
        groups = groups[index]
    numbers, group_of_link = groups.unique(return_inverse=True)
    order = torch.randperm(len(numbers), generator=torch.Generator().manual_seed(0))
    fold_of_group = order % count
    return fold_of_group[group_of_link]


def place_numbers(places: Float[Tensor, "k 3"]) -> Int[Tensor, " k"]:
    """Number of each place, in the order of coordinates; equal places have equal numbers."""
    any_receiver = torch.zeros(len(places), dtype=torch.long)
    _, numbers = Query(places, any_receiver).unique(with_receivers=False)
    return numbers


def single_readings(links: Links, index: Int[Tensor, " k"]) -> Int[Tensor, " j"]:
    """One random link for each place, receiver and carrier, since repeated readings err alike."""
    if not len(index):
        return index
    _, numbers = links.query[index].unique(with_receivers=True)  # equal for repeated readings (k,)
    order = torch.randperm(len(index), generator=torch.Generator().manual_seed(0))
    # Of several copies to a number the last one in the random order stays.
    chosen = order.new_zeros(int(numbers.max()) + 1).index_copy(0, numbers[order], order)
    return index[chosen.sort().values]


def coordinates(
    scene: Scene, query: Query, scale: float | Tensor, features: Float[Tensor, "b c"] | None = None
) -> Float[Tensor, "b d"]:
    """Coordinates of links (float64) whose Euclidean distance D is the distance of two links.

    With a difference dx of the transmitters [m] and df of ln(carrier), D² = |dx|² + (scale df)².
    With ``one_radio`` |dx|² includes both ends. With ``features`` df is their difference instead.
    ``scale`` [m] is used only if the training links have several carriers, or if there are
    features.
    """
    positions = query.transmitters.double()
    if scene.one_radio:
        positions = torch.cat((positions, scene.positions(positions)[query.receivers]), 1)  # (b, 6)
    if features is not None:
        return torch.cat((positions, scale * features), 1)
    if not scene.has_band:
        return positions
    half_band = (scene.frequencies[-1] / scene.frequencies[0]).double().log() / 2
    carriers = scene.band_positions(query).double()[:, None]  # (b, 1), from -1 to 1
    return torch.cat((positions, scale * half_band * carriers), 1)


def coarse(spectra: Float[Tensor, "b rows columns"]) -> Float[Tensor, "b c"]:
    """Means of spectra over 3 x 8 parts, float64; an array hardly resolves more parts."""
    return functional.adaptive_avg_pool2d(spectra[:, None], (3, 8)).flatten(1).double()


def scaled(places: Float[Tensor, "k d"], scale: float) -> Float[Tensor, "k d"]:
    """``coordinates`` with another ``scale``, from coordinates with scale 1."""
    ends = edges_of(places)
    return torch.cat((places[:, :ends], scale * places[:, ends:]), 1)


def edges_of(places: Float[Tensor, "*k d"]) -> int:
    """Number of ``coordinates`` that are spatial: 3, or 6 if both ends move."""
    return places.shape[-1] // 3 * 3


def distances(a: Float[Tensor, "*c m d"], b: Float[Tensor, "*c n d"]) -> Float[Tensor, "*c m n"]:
    """Distances of all pairs [m]; by differences, so that they are 0 for equal places."""
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


class Near(NamedTuple):
    """The j known places nearest to each of m places, nearest first."""

    apart: Float[Tensor, "m j"]  # [m]
    rows: Int[Tensor, "m j"]  # numbers of the known places


def nearest_places(asked: Float[Tensor, "m d"], known: Float[Tensor, "k d"], count: int) -> Near:
    """The ``count`` nearest known places of each asked place, or all if there are fewer."""
    count = min(count, len(known))
    # A k-d tree split at the middles of boxes stays fast if a place is measured often.
    tree = cKDTree(known.double().cpu().numpy(), balanced_tree=False)
    points = asked.double().cpu().numpy().reshape(-1, known.shape[1])
    ranks = [*range(1, count + 1)]  # a list keeps the axis of neighbours if count is 1
    apart, rows = tree.query(points, k=ranks)
    return Near(torch.from_numpy(apart).to(known.device), torch.from_numpy(rows).to(known.device))


def reception_probability(
    asked: Float[Tensor, "g d"],
    known: Float[Tensor, "k 3"],
    receives: Float[Tensor, "k r"],
    prior: float | Tensor,
    neighbours: int = 8,
) -> Float[Tensor, "g r"]:
    """Probability that each receiver receives from a place.

    Args:
        asked: Places [m].
        known: Known places [m].
        receives: 1 where a receiver receives from a known place.
        prior: Probability without measurements; it counts as one more known place.
        neighbours: Number of nearest known places to average.
    """
    count = min(neighbours, len(known))
    probabilities = []
    for places in asked.split(16 * PART):  # limits memory
        near = nearest_places(places[:, :3], known, count).rows
        probabilities.append((receives[near].sum(1) + prior) / (count + 1))
    return torch.cat(probabilities)


def scale_bounds(scene: Scene) -> tuple[float, float]:
    """Smallest and largest ``scale`` [m] of ``coordinates`` that the training links can
    distinguish.

    The scale converts the logarithm of the carrier into a distance. With the smallest scale the
    whole band equals the spacing of the places. With the largest, the distance of neighbouring
    carriers equals the longest edge of the transmitters' box.
    """
    logarithms = scene.frequencies.double().log()
    edge = (scene.upper - scene.lower).max().item()
    band = (logarithms[-1] - logarithms[0]).item()
    step = logarithms.diff().median().item()
    return scene.spacing / band, max(edge, scene.spacing) / step


def at_directions(values: Tensor, batch: Batch, scene: Scene) -> Tensor:
    """Labels (b, rows, columns) in the directions of a batch, from the nearest row and column.

    Labels without directions are unchanged.
    """
    grid, asked = scene.task.directions, batch.directions
    if grid is None or asked is None or grid.matches(asked):  # the usual case, recognised at once
        return values
    rows = nearest_angles(asked.elevations, grid.elevations, None).to(values.device)
    columns = nearest_angles(asked.azimuths, grid.azimuths, 2 * math.pi).to(values.device)
    return values[:, rows][:, :, columns] if isinstance(asked, Grid) else values[:, rows, columns]


def nearest_angles(
    asked: Float[Tensor, " k"], known: Float[Tensor, " n"], period: float | None
) -> Int[Tensor, " k"]:
    """Index of the known angle nearest to each given one; angles and period in [rad]."""
    apart = asked.double().cpu()[:, None] - known.double().cpu()  # (k, n)
    if period is not None:
        apart = apart - period * (apart / period).round()
    return apart.abs().argmin(1)
