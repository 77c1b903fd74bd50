"""Blends of two predictions, and the scores by which one is chosen."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.core.task import Task
from gaigs.data import Links


def validation_scores(
    links: Links, values: Tensor, index: Int[Tensor, " k"] | None = None
) -> Float[Tensor, " k"]:
    """Monitored scores of predictions of the validation links, or others, higher ones better."""
    task = links.task
    labels = links.labels[links.split.validation if index is None else index]
    scores = task.scores(labels, values)[task.monitor].double()
    return scores if task.higher_is_better else -scores


def blend(task: Task, one: Tensor | None, other: Tensor | None, weight: float) -> Tensor:
    """weight one + (1 - weight) other, a tensor of its own; of channels of unknown phase, ``one``
    is aligned to ``other``. A part without weight may be None: it is not read, since a NaN of it
    would count.
    """
    if weight in (0, 1):
        return (one if weight else other).clone()
    return torch.add(weight * task.align(one, other), other, alpha=1 - weight)


def is_surely_better(
    one: Float[Tensor, " k"], other: Float[Tensor, " k"], *, errors: float = 2.0
) -> bool:
    """True if scores are higher by more than some standard errors; False of fewer than two."""
    gain = one - other
    return len(gain) > 1 and bool(gain.mean() > errors * gain.std() / math.sqrt(len(gain)))
