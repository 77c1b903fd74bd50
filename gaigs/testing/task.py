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
    """Checks a task: its state, its scores, its errors, its thinning.

    True values must score best. The contract is in ``gaigs.core.task.Task``.

    Args:
        task: The task.
        thinnings: Further options of its ``thinning``.
    """
    _check_facts(task)
    _check_state(task)
    generator = torch.Generator().manual_seed(0)
    shape = (2, 5, *task.shape, 2)  # uniform in [0, 1], in both parts of complex labels
    drawn = torch.view_as_complex(torch.rand(*shape, generator=generator, dtype=torch.float64))
    if not task.dtype.is_complex:
        drawn = drawn.real
    labels, noise = drawn.to(task.dtype)
    values = labels + noise
    perfect = task.scores(labels, labels)
    worse = task.scores(labels, values.clone().requires_grad_())
    _check_scores(task, perfect, worse)
    for name, score in task.scores(labels[-1:], values[-1:]).items():
        rule = f"the score {name} must not depend on the other samples"
        require_close(score, worse[name][-1:], 1e-9, rule)
    _check_summaries(task, perfect, worse)
    for array in task.stored(labels, values, worse).values():
        is_right = isinstance(array, np.ndarray) and len(array) == 5
        require(is_right, "stored must give arrays of numpy with a row for each sample")
    _check_refusals(task, labels, noise)
    for options in ({}, *thinnings):
        _check_thinning(task, dict(options))


def _check_facts(task: Task) -> None:
    """Checks the types of the task's attributes and metrics."""
    is_registered = task.name in registry("task").names()
    require(is_registered, f"a task must have its registered name, got {task.name!r}")
    texts = ("quantity", "unit", "normalisation", "monitor", "pair_score")
    types: dict[str, type] = dict.fromkeys(texts, str)
    types |= {"higher_is_better": bool, "is_noisy": bool, "shape": tuple}
    for name, kind in types.items():
        value = getattr(task, name)
        require(isinstance(value, kind), f"{name} must be a {kind.__name__}, got {value!r}")
    if task.directions is not None:
        require(isinstance(task.directions, Grid), "directions must be a Grid")
        fits = task.directions.shape == task.shape
        require(fits, f"directions must be of the label's shape {task.shape}")
    metrics = type(task).metrics().values()
    are_metrics = all(isinstance(metric, Metric) for metric in metrics)
    require(are_metrics, "metrics must be gaigs.core.task.Metric")
    require(any(metric.is_brief for metric in metrics), "at least one metric must be brief")


def _check_state(task: Task) -> None:
    """Checks that a stored state builds the same task."""
    file = io.BytesIO()
    torch.save(task.state(), file)
    file.seek(0)
    again = registry("task").build(torch.load(file, weights_only=True))
    names = ("shape", "dtype", "unit", "normalisation", "monitor", "higher_is_better")
    same = [getattr(again, name) == getattr(task, name) for name in names]
    same += [type(again) is type(task), flat(again.state()) == flat(task.state())]
    require(all(same), "the task's state must restore it")


def _check_scores(task: Task, perfect: Mapping[str, Tensor], worse: Mapping[str, Tensor]) -> None:
    """Checks scores of five samples: ``perfect`` for the labels as values, ``worse`` for others."""
    names = ", ".join(perfect)
    has_monitor = task.monitor in perfect
    require(has_monitor, f"scores must have the monitored one, {task.monitor!r}, got {names}")
    for name, score in (*perfect.items(), *worse.items()):
        is_right = tuple(score.shape) == (5,) and score.dtype == torch.float64
        rule = f"the score {name} must be (5,) float64 on the CPU"
        require(
            is_right and score.device.type == "cpu", f"{rule}, got {score.shape}, {score.dtype}"
        )
        require(score.isfinite().all(), f"the score {name} must be finite")
        require(not score.requires_grad, "scores must not carry a gradient")
    gain = perfect[task.monitor] - worse[task.monitor]
    require((gain if task.higher_is_better else -gain).gt(0).all(), "true values must score best")


def _check_summaries(
    task: Task, perfect: Mapping[str, Tensor], worse: Mapping[str, Tensor]
) -> None:
    """Checks the task's summaries of scores, and of scores of averaged samples."""
    metrics = type(task).metrics()
    best = task.summarise(perfect)
    second = task.summarise(worse)
    known = [name for name in metrics if name in best]  # options may leave one without a meaning
    rule = f"summarise must give some of {', '.join(metrics)}, got {', '.join(best)}"
    require(known and [*best] == known, rule)
    are_plain = all(type(number) is float for number in best.values())
    require(are_plain, "summarise must give plain numbers")
    for name in known:
        gain = best[name] - second[name]
        is_better = gain > 0 if metrics[name].higher_is_better else gain < 0
        rule = f"true values must have the best {name}, got {best[name]} and else {second[name]}"
        require(is_better, rule)
    averaged = task.averaged(worse)
    if averaged is not None:
        names = f"{', '.join(worse)}, got {', '.join(averaged)}"
        require([*averaged] == [*worse], f"averaged must give {names}")
        gains = averaged[task.monitor] - worse[task.monitor]
        gains = gains if task.higher_is_better else -gains
        require(gains.ge(0).all(), "averaged must be no worse")


def _check_refusals(task: Task, labels: Tensor, values: Tensor) -> None:
    """Checks that wrong shapes and numbers raise errors, and that no samples have no scores."""
    broken = torch.arange(labels.numel()).view_as(labels) == 1
    wrong = {
        "of different number": (labels, values[1:]),
        "with an axis too many": (labels[..., None], values[..., None]),
        "of a single sample without its axis": (labels[0], values[0]),
        "that are NaN": (labels, torch.where(broken, torch.nan, values)),
        "measured that are infinite": (torch.full_like(labels, torch.inf), values),
    }
    for case, pair in wrong.items():
        call = functools.partial(task.scores, *pair)
        require_refusal(call, f"values {case} must be a ValueError")
    empty = task.scores(labels[:0], values[:0])
    require(all(len(score) == 0 for score in empty.values()), "no samples must have no scores")
    require_refusal(lambda: task.summarise(empty), "a summary of no samples must be a ValueError")


def _check_thinning(task: Task, options: dict) -> None:
    """Checks that a task's thinning keeps the same pixels of labels and of directions."""
    thin = task.thinning(**options)
    count = max(1, int(np.prod(task.shape)))
    # The value of a label's pixel is the pixel's number, which shows where a kept value is from.
    numbers = torch.arange(count, dtype=torch.float64).reshape(task.shape).expand(2, *task.shape)
    query = Query(torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]), torch.tensor([0, 1]))
    batch = Batch(query, task.directions, numbers, (0.5, 0.25))
    part = thin(batch, torch.Generator().manual_seed(3))
    again = thin(batch, torch.Generator().manual_seed(3))
    require(torch.equal(part.labels, again.labels), "only the generator may decide the thinning")
    require(part.shares == batch.shares, "thinning must keep the shares")
    stays = torch.equal(part.query.transmitters, query.transmitters)
    require(stays, "thinning must keep the query")
    first, second = part.labels.unbind()
    require(first.numel(), "thinning must leave a label")
    require(torch.equal(first, second), "all links must keep the same directions")
    if task.directions is None:
        require(part.directions is None, "labels without directions must have none when thinned")
        return
    is_one_shape = tuple(first.shape) == tuple(part.directions.shape)
    require(is_one_shape, "labels and directions must be of one shape")
    pixels = task.directions.flatten().vectors()[first.long()]
    rule = "labels and directions must be thinned together"
    require_close(part.directions.vectors(), pixels, 1e-6, rule)
    if first.numel() < count:
        others = [thin(batch, torch.Generator().manual_seed(seed)).labels for seed in range(8)]
        moved = any(not torch.equal(other, part.labels) for other in others)
        require(moved, "thinning must keep other directions in another step")
