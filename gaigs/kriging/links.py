"""Links as look-ups see them: known links, distances between links, labels in the directions of a
batch.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.core.geometry import Grid
from gaigs.core.query import Batch, Query, evenly
from gaigs.core.scene import Scene
from gaigs.data import Links, Split

PART = 256
"""Labels held in memory at a time: a spectrum takes 130 KB."""


def known_links(links: Links) -> list[Int[Tensor, " k"]]:
    """Training and validation links of each receiver; raises a ``ValueError`` for a receiver
    without.
    """
    known = [links.known(receiver) for receiver in range(len(links.receivers))]
    without = [
        receiver.name
        for receiver, index in zip(links.receivers, known, strict=True)
        if not len(index)
    ]
    if without:
        kind = "known" if len(links.split.validation) else "training"
        raise ValueError(
            f"split {links.split.name!r} has no {kind} links of {', '.join(without)}; choose another split"
        )
    return known


def check_known(links: Links) -> None:
    """Raises the ``ValueError`` of ``known_links`` for all known links, and for those of a
    validation.
    """
    known_links(links)
    known_links(replace(links, split=links.split.validating()))


def thinned(links: Links, most: int) -> Links:
    """The same links with at most ``most`` known links of each receiver, evenly spread."""
    chosen = torch.cat([evenly(index, most) for index in known_links(links)])
    split = links.split
    train, validation = (part[torch.isin(part, chosen)] for part in (split.train, split.validation))
    return replace(links, split=Split(split.name, train, validation, split.test, split.groups))


FOLDS = 10
"""Folds of known links that are predicted from all others, to choose a hyperparameter."""


def folds_of(links: Links, index: Int[Tensor, " k"]) -> Int[Tensor, " k"]:
    """Fold of some links, from 0; groups of the split, or places, are random whole folds, as the
    test is.
    """
    groups = links.split.groups
    if groups is None:
        _, groups = links.query.transmitters.unique(dim=0, return_inverse=True)
    numbers, group = groups[index].unique(return_inverse=True)
    order = torch.randperm(len(numbers), generator=torch.Generator().manual_seed(0))
    return (order % FOLDS)[group]


def without_gross_errors(links: Links, size: float = 6.0) -> Links:
    """Links of one number each without known levels that no room explains: one of them moves a
    whole fit.

    Levels fall with the logarithm of the distance to their receiver. A level is left out if its
    error by this law is more than ``size`` standard deviations, and as far from those of the five
    nearest levels of its receiver: what neighbours share is a part of the room. So is what more
    than one in twenty have. The line has Cauchy's weights, so few levels do not move it. The
    deviation is 1.48 times the median error, the larger one of the receiver and of all receivers, 1
    dB or more. Fewer than 20 known links keep all.

    Source: Maronna, Martin and Yohai, Robust Statistics, 2006, sections 4.4 and 5.2.
    """
    index = links.split.known
    if len(index) < 20:
        return links
    query, labels, positions = (
        links.query[index],
        links.labels[index].double(),
        links.scene.positions(links.labels),
    )
    lengths = (query.transmitters - positions[query.receivers]).norm(dim=1).clamp_min(0.1)
    errors = torch.zeros_like(labels)
    for receiver in query.receivers.unique():
        own = query.receivers == receiver
        errors[own] = law_errors(lengths[own].double().log10(), labels[own])
    usual = deviation(errors)
    kept = torch.ones_like(index, dtype=torch.bool)
    for receiver in query.receivers.unique():
        own = (query.receivers == receiver).nonzero()[:, 0]
        most = size * torch.maximum(usual, deviation(errors[own]))
        far = own[errors[own].abs() > most]
        if len(own) > 5 and len(far):
            apart = distances(query.transmitters[far], query.transmitters[own])
            around = own[
                apart.masked_fill(far[:, None] == own, math.inf).topk(5, largest=False).indices
            ]
            alone = (errors[far, None] - errors[around]).abs().amin(1) > most
            kept[far] = ~alone | (alone.sum() > max(1, len(own) // 20))
    parts = links.split.parts()
    train, validation = (
        parts[name][torch.isin(parts[name], index[kept])] for name in ("train", "validation")
    )
    return replace(
        links, split=Split(links.split.name, train, validation, parts["test"], links.split.groups)
    )


def law_errors(decades: Float[Tensor, " k"], levels: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
    """Levels less those of a line over the logarithm of the distance, by least squares with
    Cauchy's weights.
    """
    weights = torch.ones_like(levels)
    for _ in range(20):
        shares = weights / weights.sum()
        steps, errors = decades - shares @ decades, levels - shares @ levels
        slope = shares @ (steps * errors) / (shares @ steps.square()).clamp_min(1e-6)
        errors = errors - slope * steps
        weights = 1 / (1 + (errors / (2 * deviation(errors))).square())
    return errors


def deviation(errors: Float[Tensor, " k"]) -> Float[Tensor, ""]:
    """Standard deviation of normal errors by their median size, at least 1 in the label's unit."""
    return (1.4826 * errors.abs().median()).clamp_min(1.0)


def single_readings(links: Links, index: Int[Tensor, " k"]) -> Int[Tensor, " j"]:
    """One random link for each place, receiver and carrier: repeated readings have nearly the same
    error.
    """
    if not len(index):
        return index
    _, which = links.query[index].unique(with_receivers=True)
    order = torch.randperm(len(index), generator=torch.Generator().manual_seed(0))
    last = order.new_zeros(int(which.max()) + 1).index_copy(0, which[order], order)
    return index[last.sort().values]


def coordinates(scene: Scene, query: Query, scale: float | Tensor) -> Float[Tensor, "b d"]:
    """Points whose Euclidean distance is the distance of links, d² = |dx|² + (scale d ln f)²;
    float64.

    ``scale`` [m] has no effect unless the training links have several carriers.
    """
    positions = query.transmitters.double()
    if not scene.has_band:
        return positions
    half = (scene.frequencies[-1] / scene.frequencies[0]).double().log() / 2
    return torch.cat((positions, scale * half * scene.band_positions(query).double()[:, None]), 1)


def scaled(places: Float[Tensor, "k d"], scale: float) -> Float[Tensor, "k d"]:
    """The ``coordinates`` of a scale, from those of scale 1."""
    return torch.cat((places[:, :3], scale * places[:, 3:]), 1)


def distances(a: Float[Tensor, "*c m d"], b: Float[Tensor, "*c n d"]) -> Float[Tensor, "*c m n"]:
    """Distances of all pairs [m].

    Differences are plain: the matrix product would give copies of a place different distances.
    """
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


AROUND = 8
"""Measured places around another that tell whether a receiver hears it."""


def chance_to_hear(
    asked: Float[Tensor, "g d"],
    known: Float[Tensor, "k 3"],
    hears: Float[Tensor, "k r"],
    towards: float | Tensor,
) -> Float[Tensor, "g r"]:
    """Probability that each receiver hears a place: the share of the known places around that it
    hears.

    One place more is counted, of which it hears the part ``towards``; ``hears`` has 1 where it
    hears a known place.
    """
    count = min(AROUND, len(known))
    parts = (
        distances(part[:, :3], known).topk(count, largest=False).indices
        for part in asked.split(PART)
    )
    return torch.cat([(hears[around].sum(1) + towards) / (count + 1) for around in parts])


def scale_bounds(scene: Scene) -> tuple[float, float]:
    """Least and largest ``scale`` of ``coordinates`` that the training links can distinguish [m].

    The least puts the whole band as far as the next place, the largest the next carrier as far as
    the longest edge.
    """
    logarithms = scene.frequencies.double().log()
    edge = (scene.upper - scene.lower).max().item()
    band, step = (logarithms[-1] - logarithms[0]).item(), logarithms.diff().median().item()
    return scene.spacing / band, max(edge, scene.spacing) / step


def at_directions(values: Tensor, batch: Batch, scene: Scene) -> Tensor:
    """Labels (b, rows, columns) in the directions of a batch, each from the nearest row and column."""
    own, asked = scene.task.directions, batch.directions
    if own is None or asked is None or own.matches(asked):  # the usual case, found at once
        return values
    rows = _nearest(asked.elevations, own.elevations, None).to(values.device)
    columns = _nearest(asked.azimuths, own.azimuths, 2 * math.pi).to(values.device)
    return values[:, rows][:, :, columns] if isinstance(asked, Grid) else values[:, rows, columns]


def _nearest(
    asked: Float[Tensor, " k"], own: Float[Tensor, " n"], period: float | None
) -> Int[Tensor, " k"]:
    """Index of the own angle nearest to each asked one; angles and period in [rad]."""
    apart = asked.double().cpu()[:, None] - own.double().cpu()
    if period is not None:
        apart = apart - period * (apart / period).round()
    return apart.abs().argmin(1)
