"""Detection of received levels with gross errors, which contradict the levels around them."""

import math
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gaigs.data import Links
from gaigs.kriging.links import coordinates, distances
from gaigs.processes import torch_threads


@torch_threads(1)  # more take longer for short vectors
def without_gross_errors(links: Links, size: float = 6.0) -> Links:
    """A copy of the links in which known levels with gross errors are removed from the split.

    Labels are scalars. One gross error may spoil a whole fit. The expected level is a line over the
    logarithm of the distance to the receiver, fitted robustly (``errors_of_law``). A level is
    removed if its error exceeds ``size`` standard deviations, and also differs by this much from
    the errors of the five nearest levels at its receiver. Errors that neighbours share, or that
    more than one level in twenty has, are effects of the room; such levels stay. The standard
    deviation is 1.48 times the median error of the receiver or of all receivers, whichever is
    larger, and at least 1 dB. With fewer than 20 known links nothing is removed.

    Source: Maronna, Martin and Yohai, Robust Statistics, 2006, sections 4.4 and 5.2.
    """
    index = links.split.known
    if len(index) < 20:
        return links
    query, labels = links.query[index], links.labels[index].double()
    scene = links.scene
    places = coordinates(scene, query, 1.0) if scene.one_radio else query.transmitters
    positions = scene.positions(links.labels)[query.receivers]
    lengths = (query.transmitters - positions).norm(dim=1).clamp_min(0.1)
    errors = torch.zeros_like(labels)
    radios = scene.radio_of(query.receivers)
    for radio in radios.unique():
        rows = radios == radio
        errors[rows] = errors_of_law(lengths[rows].double().log10(), labels[rows])
    common = robust_deviation(errors)
    is_kept = torch.ones_like(index, dtype=torch.bool)
    for radio in radios.unique():
        rows = (radios == radio).nonzero()[:, 0]
        threshold = size * torch.maximum(common, robust_deviation(errors[rows]))
        is_kept[rows] = ~are_alone(places[rows], errors[rows], threshold)
    split: Any = links.split
    kept = index[is_kept]
    train = split.train[torch.isin(split.train, kept)]
    validation = split.validation[torch.isin(split.validation, kept)]
    return replace(links, split=replace(split, train=train, validation=validation))


def are_alone(
    places: Float[Tensor, "k d"],
    errors: Float[Tensor, " k"],
    threshold: Float[Tensor, ""],
    neighbours: int = 5,
) -> Bool[Tensor, " k"]:
    """True for errors above ``threshold`` that also differ by more than it from their neighbours'.

    Neighbours are the ``neighbours`` nearest places. If more than one error in twenty would be
    True, all are False, since so many are an effect of the room.
    """
    is_alone = torch.zeros_like(errors, dtype=torch.bool)
    large = (errors.abs() > threshold).nonzero()[:, 0]
    if len(errors) <= neighbours or not len(large):
        return is_alone
    nearest = []
    for rows in large.split(256):  # limits memory
        apart = distances(places[rows], places)  # (rows, k)
        is_itself = rows[:, None] == torch.arange(len(errors))
        apart = apart.masked_fill(is_itself, math.inf)
        nearest.append(apart.topk(neighbours, largest=False).indices)
    differences = (errors[large, None] - errors[torch.cat(nearest)]).abs()  # (large, neighbours)
    differs = differences.amin(1) > threshold  # from all neighbours
    are_few = differs.sum() <= max(1, len(errors) // 20)
    is_alone[large] = differs & are_few
    return is_alone


def errors_of_law(decades: Float[Tensor, " k"], levels: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
    """Levels minus a line over ``decades``, the log10 of distances.

    The line is fitted with Cauchy's weights, so a few gross errors hardly move it.
    """
    weights = torch.ones_like(levels)
    for _ in range(20):
        # Weighted least squares of y = slope x, with x and y relative to their means.
        shares = weights / weights.sum()
        x = decades - shares @ decades
        y = levels - shares @ levels
        slope = shares @ (x * y) / (shares @ x.square()).clamp_min(1e-6)
        errors = y - slope * x
        # Cauchy's weight at twice the deviation is a half.
        weights = 1 / (1 + (errors / (2 * robust_deviation(errors))).square())
    return errors


def robust_deviation(errors: Float[Tensor, " k"]) -> Float[Tensor, ""]:
    """Standard deviation estimated as 1.48 times the median magnitude of errors; at least 1."""
    return (1.4826 * errors.abs().median()).clamp_min(1.0)
