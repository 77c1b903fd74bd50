"""Levels that no room explains."""

import math
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gaigs.data import Links
from gaigs.kriging.links import coordinates, distances


def without_gross_errors(links: Links, size: float = 6.0) -> Links:
    """Links of one number each without known levels that no room explains: one of them moves a
    whole fit.

    Levels fall with the logarithm of the distance to their receiver. A level is left out if its
    error by this law is more than ``size`` standard deviations, and as far from the errors of the
    five nearest levels of its receiver: what neighbours share is a part of the room. So is what
    more than one in twenty have. The line has Cauchy's weights, so few levels do not move it. The
    deviation is 1.48 times the median error, the larger one of the receiver and of all receivers, 1
    dB or more. Fewer than 20 known links keep all.

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
        most = size * torch.maximum(common, robust_deviation(errors[rows]))
        is_kept[rows] = ~are_alone(places[rows], errors[rows], most)
    parts = links.split.parts()
    train, validation = (
        parts[name][torch.isin(parts[name], index[is_kept])] for name in ("train", "validation")
    )
    split: Any = links.split
    return replace(links, split=replace(split, train=train, validation=validation))


def are_alone(
    places: Float[Tensor, "k d"],
    errors: Float[Tensor, " k"],
    most: Float[Tensor, ""],
    neighbours: int = 5,
) -> Bool[Tensor, " k"]:
    """True for errors above ``most`` that differ by more than ``most`` from all errors nearby.

    These are at the nearest ``neighbours`` places. All are False if more than one in twenty would
    be True: what so many have is a part of the room.
    """
    is_alone = torch.zeros_like(errors, dtype=torch.bool)
    far = (errors.abs() > most).nonzero()[:, 0]
    if len(errors) <= neighbours or not len(far):
        return is_alone
    near = []
    for part in far.split(256):  # for memory's sake
        apart = distances(places[part], places)  # (f, k)
        itself = part[:, None] == torch.arange(len(errors))
        near.append(apart.masked_fill(itself, math.inf).topk(neighbours, largest=False).indices)
    differs = (errors[far, None] - errors[torch.cat(near)]).abs().amin(1) > most
    is_few = differs.sum() <= max(1, len(errors) // 20)
    is_alone[far] = differs & is_few
    return is_alone


def errors_of_law(decades: Float[Tensor, " k"], levels: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
    """Levels less a line over the logarithm of the distance, by least squares with
    Cauchy's weights.
    """
    weights = torch.ones_like(levels)
    for _ in range(20):
        shares = weights / weights.sum()
        steps = decades - shares @ decades
        errors = levels - shares @ levels
        slope = shares @ (steps * errors) / (shares @ steps.square()).clamp_min(1e-6)
        errors = errors - slope * steps
        # Cauchy's weight at twice the deviation is a half.
        weights = 1 / (1 + (errors / (2 * robust_deviation(errors))).square())
    return errors


def robust_deviation(errors: Float[Tensor, " k"]) -> Float[Tensor, ""]:
    """Standard deviation of normal errors by their median size, at least 1 in the label's unit."""
    return (1.4826 * errors.abs().median()).clamp_min(1.0)
