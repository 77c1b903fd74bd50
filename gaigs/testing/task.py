"""The check of kind ``task``."""

import functools
import io
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from gaigs.core.geometry import Grid
from gaigs.core.query import Batch, Query
from gaigs.core.task import Metric, Task
from gaigs.registry import registry
from gaigs.testing.checks import flat, require, require_close, require_refusal


def check_task(task: Task, *thinnings: Mapping) -> None:
    """Checks a task: its state restores it, true values score best, broken ones are refused,
    thinning is consistent.

    ``thinnings`` are further options of its ``thinning``. The contract is that of
    ``gaigs.core.task.Task``.
    """
    _check_facts(task)
    _check_state(task)
    generator = torch.Generator().manual_seed(0)
    shape = (5, *task.shape, 2)  # uniform in [0, 1], in both parts of complex labels
    labels, noise = torch.view_as_complex(
        torch.rand(2, *shape, generator=generator, dtype=torch.float64)
    )
    if not task.dtype.is_complex:
        labels, noise = labels.real, noise.real
    labels, noise = labels.to(task.dtype), noise.to(task.dtype)
    _check_scores(task, labels, noise)
    _check_refusals(task, labels, noise)
    for options in ({}, *thinnings):
        _check_thinning(task, dict(options))


def _check_facts(task: Task) -> None:
    require(
        task.name in registry("task").names(),
        f"a task must have its registered name, got {task.name!r}",
    )
    texts = dict.fromkeys(("quantity", "unit", "normalisation", "monitor", "pair_score"), str)
    for name, kind in {**texts, "higher_is_better": bool, "is_noisy": bool, "shape": tuple}.items():
        found = getattr(task, name)
        require(isinstance(found, kind), f"{name} must be a {kind.__name__}, got {found!r}")
    if task.directions is not None:
        require(isinstance(task.directions, Grid), "directions must be a Grid")
        require(
            task.directions.shape == task.shape,
            f"directions must be of the label's shape {task.shape}",
        )
    metrics = type(task).metrics().values()
    require(
        all(isinstance(metric, Metric) for metric in metrics),
        "metrics must be gaigs.core.task.Metric",
    )
    require(any(metric.is_brief for metric in metrics), "at least one metric must be brief")


def _check_state(task: Task) -> None:
    file = io.BytesIO()
    torch.save(task.state(), file)
    file.seek(0)
    again = registry("task").build(torch.load(file, weights_only=True))
    facts = lambda task: (
        task.shape,
        task.dtype,
        task.unit,
        task.normalisation,
        task.monitor,
        task.higher_is_better,
    )
    same = (
        type(again) is type(task)
        and facts(again) == facts(task)
        and flat(again.state()) == flat(task.state())
    )
    require(same, "the task's state must restore it")


def _check_scores(task: Task, labels: Tensor, noise: Tensor) -> None:
    values = labels + noise
    perfect, worse = (
        task.scores(labels, labels),
        task.scores(labels, values.clone().requires_grad_()),
    )
    require(
        task.monitor in perfect,
        f"scores must have the monitored one, {task.monitor!r}, got {', '.join(perfect)}",
    )
    for name, score in (*perfect.items(), *worse.items()):
        right = (
            tuple(score.shape) == (5,)
            and score.dtype == torch.float64
            and score.device.type == "cpu"
        )
        require(
            right,
            f"the score {name} must be (5,) float64 on the CPU, got {score.shape}, {score.dtype}",
        )
        require(score.isfinite().all(), f"the score {name} must be finite")
        require(not score.requires_grad, "scores must not carry a gradient")
    sign = 1 if task.higher_is_better else -1
    gain = sign * (perfect[task.monitor] - worse[task.monitor])
    require(gain.gt(0).all(), "true values must score best")
    for name, score in task.scores(labels[-1:], values[-1:]).items():
        require_close(
            score, worse[name][-1:], 1e-9, f"the score {name} must not depend on the other samples"
        )

    metrics = type(task).metrics()
    best, second = task.summarise(perfect), task.summarise(worse)
    known = [
        name for name in metrics if name in best
    ]  # a task's options may leave some without a meaning
    require(
        known and [*best] == known,
        f"summarise must give some of {', '.join(metrics)}, got {', '.join(best)}",
    )
    require(
        all(type(number) is float for number in best.values()), "summarise must give plain numbers"
    )
    for name in known:
        metric = metrics[name]
        better = best[name] > second[name] if metric.higher_is_better else best[name] < second[name]
        require(
            better,
            f"true values must have the best {name}, got {best[name]} and else {second[name]}",
        )
    if (averaged := task.averaged(worse)) is not None:
        require(
            [*averaged] == [*worse],
            f"averaged must give {', '.join(worse)}, got {', '.join(averaged)}",
        )
        gain = sign * (averaged[task.monitor] - worse[task.monitor])
        require(gain.ge(0).all(), "averaged must be no worse")
    for array in task.stored(labels, values, worse).values():
        right = isinstance(array, np.ndarray) and len(array) == 5
        require(right, "stored must give arrays of numpy with a row for each sample")


def _check_refusals(task: Task, labels: Tensor, values: Tensor) -> None:
    wrong = {
        "of different number": (labels, values[1:]),
        "with an axis too many": (labels[..., None], values[..., None]),
        "of a single sample without its axis": (labels[0], values[0]),
        "that are NaN": (
            labels,
            torch.where(torch.arange(labels.numel()).view_as(labels) == 1, torch.nan, values),
        ),
        "measured that are infinite": (torch.full_like(labels, torch.inf), values),
    }
    for case, pair in wrong.items():
        require_refusal(
            functools.partial(task.scores, *pair), f"values {case} must be a ValueError"
        )
    none = task.scores(labels[:0], values[:0])
    require(all(len(score) == 0 for score in none.values()), "no samples must have no scores")
    require_refusal(lambda: task.summarise(none), "a summary of no samples must be a ValueError")


def _check_thinning(task: Task, options: dict) -> None:
    """Each label is the number of its pixel, which shows if labels and directions were thinned
    differently.
    """
    thin = task.thinning(**options)
    count = max(1, int(np.prod(task.shape)))
    numbers = torch.arange(count, dtype=torch.float64).reshape(task.shape).expand(2, *task.shape)
    query = Query(torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), torch.tensor([0, 1]))
    batch = Batch(query, task.directions, numbers, (0.5, 0.25))
    part, again = (thin(batch, torch.Generator().manual_seed(3)) for _ in range(2))
    require(torch.equal(part.labels, again.labels), "only the generator may decide the thinning")
    require(part.shares == batch.shares, "thinning must keep the shares")
    require(
        torch.equal(part.query.transmitters, query.transmitters), "thinning must keep the query"
    )
    require(part.labels[0].numel(), "thinning must leave a label")
    require(torch.equal(part.labels[0], part.labels[1]), "all links must keep the same directions")
    if task.directions is None:
        require(part.directions is None, "labels without directions must have none when thinned")
        return
    require(
        tuple(part.labels.shape[1:]) == tuple(part.directions.shape),
        "labels and directions must be of one shape",
    )
    pixels = task.directions.flatten().vectors()[part.labels[0].long()]
    require_close(
        part.directions.vectors(), pixels, 1e-6, "labels and directions must be thinned together"
    )
    if part.labels[0].numel() < count:
        other = [thin(batch, torch.Generator().manual_seed(seed)).labels for seed in range(8)]
        moved = any(x.shape != part.labels.shape or not torch.equal(x, part.labels) for x in other)
        require(moved, "thinning must keep other directions in another step")
