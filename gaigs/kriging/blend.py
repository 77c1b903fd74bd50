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
    """The task's monitored score of each prediction in ``values``, negated if lower is better.

    The predictions are for the validation links, or for the links ``index``.
    """
    task = links.task
    labels = links.labels[links.split.validation if index is None else index]
    scores = task.scores(labels, values)[task.monitor].double()
    return scores if task.higher_is_better else -scores


def blend(task: Task, one: Tensor | None, other: Tensor | None, weight: float) -> Tensor:
    """The weighted mean of two predictions, weight ``one`` + (1 - weight) ``other``, a new tensor.

    For channels of unknown phase ``one`` is first aligned to ``other``. A prediction with a weight
    of 0 is not read, so it may be None or NaN.
    """
    if weight in (0, 1):
        only = one if weight else other
        return only.clone()
    return torch.add(weight * task.align(one, other), other, alpha=1 - weight)


def is_surely_better(
    one: Float[Tensor, " k"], other: Float[Tensor, " k"], *, errors: float = 2.0
) -> bool:
    """True if the mean score ``one`` exceeds the mean ``other`` by ``errors`` standard errors.

    Both have scores of the same k links. The standard error is that of the mean difference between
    both scores of a link. The result is False for fewer than two links.
    """
    gains = one - other
    return len(gains) > 1 and bool(gains.mean() > errors * gains.std() / math.sqrt(len(gains)))
