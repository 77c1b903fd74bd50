"""Blends of two predictions, and scores to choose between them."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.core.task import Task
from gaigs.data import Links


def validation_scores(
    links: Links, values: Tensor, index: Int[Tensor, " k"] | None = None
) -> Float[Tensor, " k"]:
    """The task's monitored score of predictions ``values``, with its sign so that higher is better.

    The predictions are of the validation links, or of the links ``index``.
    """
    task = links.task
    labels = links.labels[links.split.validation if index is None else index]
    scores = task.scores(labels, values)[task.monitor].double()
    return scores if task.higher_is_better else -scores


def blend(task: Task, one: Tensor | None, other: Tensor | None, weight: float) -> Tensor:
    """weight one + (1 - weight) other, as a new tensor.

    For channels of unknown phase ``one`` is first aligned to ``other``. A prediction with a weight
    of 0 is not read and may be None, since its NaN would spoil the sum.
    """
    if weight in (0, 1):
        return (one if weight else other).clone()
    return torch.add(weight * task.align(one, other), other, alpha=1 - weight)


def is_surely_better(
    one: Float[Tensor, " k"], other: Float[Tensor, " k"], *, errors: float = 2.0
) -> bool:
    """True if the mean of ``one`` is higher than the mean of ``other`` by ``errors`` standard
    errors.

    The standard error is of paired differences, link by link. False for fewer than two scores.
    """
    gain = one - other
    return len(gain) > 1 and bool(gain.mean() > errors * gain.std() / math.sqrt(len(gain)))
