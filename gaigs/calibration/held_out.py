"""Links that calibrate a model: each is predicted by a model that has not seen it."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Inexact, Int
from torch import Tensor

from gaigs.calibration.conformal import Calibration, nearest
from gaigs.core import stages
from gaigs.core.query import evenly
from gaigs.data import Links, with_places
from gaigs.kriging.links import folds_of, single_readings

LOOK_UP_FOLDS = 5
"""Number of folds of the known links that calibrate a look-up."""


class Unseen(NamedTuple):
    """A model, with links that it has not seen and links that it knows."""

    model: Any
    asked: Int[Tensor, " k"]  # indices of links that it has not seen
    known: Int[Tensor, " j"]  # indices of links that it knows


class Fold(NamedTuple):
    """A held-out fold of the known links."""

    rest: Links  # the data set with a split that lacks the fold's links
    asked: Int[Tensor, " k"]  # indices of the fold's links to predict


class Answers(NamedTuple):
    """Predictions of some links."""

    values: Inexact[Tensor, " k *shape"]  # predictions
    deviations: Float[Tensor, " k ..."]  # standard deviations of the labels (k,) or (k, *shape)
    are_stated: bool  # True if the model states its deviations; False if they are a default


def held_out_folds(links: Links, count: int = LOOK_UP_FOLDS, most: int = 1000) -> Iterator[Fold]:
    """Yields one held-out fold of the known links after the other, until the time is up.

    Links of a fold are to be predicted by a model of the other folds. All ``count`` folds together
    have about ``most`` links, evenly chosen.
    """
    index, receivers = links.split.known, links.scene.radio_of(links.query.receivers)
    folds = folds_of(links, index) % count
    asked = evenly(single_readings(links, index), most)
    for fold in range(count):
        if stages.is_up():
            return
        is_known = folds != fold
        # If all links of a receiver are in this fold, they are not held out.
        is_known |= torch.isin(receivers[index], receivers[index[is_known]], invert=True)
        asked_of_fold = index[~is_known & torch.isin(index, asked)]
        if not len(asked_of_fold):
            continue
        rest = replace(links, split=links.split.only(index[is_known]))
        # Estimated places of receivers are estimated again, without the fold.
        if links.uncertainties is not None and links.uncertainties.any():
            is_estimated = links.uncertainties > 0
            unknown = torch.where(is_estimated, math.inf, 0.0)
            rest = with_places(replace(rest, uncertainties=unknown))
        yield Fold(rest, asked_of_fold)


def validation_halves(links: Links) -> list[tuple[Int[Tensor, " k"], Int[Tensor, " j"]]]:
    """The two halves of the validation links, as a pair in both orders.

    If all links are in one group, which cannot be halved, they are paired with themselves.
    """
    validation = links.split.validation
    halves = folds_of(links, validation) % 2
    first, second = validation[halves == 0], validation[halves == 1]
    if not len(first) or not len(second):
        return [(validation, validation)]
    return [(first, second), (second, first)]


def calibrate(
    links: Links,
    name: str,
    count: int,
    unseen: Iterable[Unseen],
    answer: Callable[[Any, Int[Tensor, " k"]], Answers],
) -> Calibration | None:
    """Calibrates a model's intervals by its errors at links that it has not seen.

    Args:
        links: Links with the split of the model.
        name: Name of the model, for messages.
        count: Number of models that ``unseen`` yields if time suffices.
        unseen: Models fitted without a part of the links, and that part.
        answer: Function from a model and indices of links to its predictions.

    Returns:
        The calibration; None if ``unseen`` gives no model.
    """
    query = links.scene.by_radio(links.query)
    asked, answers, near = [], [], []
    for part in stages.track(unseen, "intervals", count):
        if count > 1 and stages.is_up():  # the model was fitted in haste
            break
        asked.append(part.asked)
        answers.append(answer(part.model, part.asked))
        if not answers[-1].are_stated:
            known = query[part.known]
            near.append(nearest(query[part.asked], known.transmitters, known.receivers))
    if stages.is_up() and len(asked) < count:
        stages.leave_out(f"{len(asked)} of {count} folds calibrate {name}")
    if not asked:
        return None
    index = torch.cat(asked)
    values = torch.cat([part.values for part in answers])
    deviations = torch.cat([part.deviations for part in answers])
    are_stated = not near
    return Calibration.of(
        links.task,
        links.labels[index],
        values,
        deviations,
        query[index],
        None if are_stated else torch.cat(near),
        query[links.split.known],
    )
