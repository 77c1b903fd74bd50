"""Paired tests of scores: does a model differ significantly from the best baseline?"""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gaigs.core.query import drawn
from gaigs.core.task import Task
from gaigs.report.scores import headline


class Paired(NamedTuple):
    """Models against the best baseline."""

    baseline: str
    places: int  # number of the test links' places that are drawn from
    # Probability of a difference as large by chance, by the names of model and metric.
    p: dict[str, dict[str, float]]


def paired(
    task: Task,
    scores: Mapping[str, dict[str, Tensor]],
    places: Tensor,
    resamples: int = 1000,
    seed: int = 0,
    most: int = 25_000,
) -> Paired | None:
    """A paired bootstrap over places, for each metric; None without baselines or with one place.

    Links of one place are dependent, so they are drawn together. Model and baseline are scored on
    the same drawn places.

    Args:
        task: Task of the labels.
        scores: Scores of the task for every test link (k,), by name of the model and of the score;
            the run's model first.
        places: A number for the place of each link (k,).
        resamples: Number of resamples; the smallest probability is 2 / (resamples + 1).
        seed: Seed of the resamples.
        most: Approximate number of links; with more of them, resamples use a random part of the
            places.

    Source: Efron and Tibshirani, An Introduction to the Bootstrap, 1993, chapters 8 and 16.
    """
    values = {name: task.summarise(dict(parts)) for name, parts in scores.items()}
    own, *others = values
    names = [name for name in others if name != f"{own}_trend"]
    numbers, groups = torch.unique(places, return_inverse=True)
    if not names or len(numbers) < 2:
        return None
    metric, title = headline(task.name, values)
    best = (max if title.higher_is_better else min)(names, key=lambda name: values[name][metric])
    order = groups.argsort(stable=True)
    counts = groups.bincount().numpy()  # links of each place
    firsts = counts.cumsum() - counts  # in the order
    chosen = drawn(torch.arange(len(counts)), max(2, most * len(counts) // len(groups))).numpy()
    random = np.random.default_rng(seed)
    gaps: dict[tuple[str, str], list[float]] = {}
    for _ in range(resamples):
        sample = chosen[random.integers(0, len(chosen), len(chosen))]
        lengths = counts[sample]
        # All links of the first drawn place, then all of the second, and so on.
        shifts = firsts[sample] - (lengths.cumsum() - lengths)
        rows = order[shifts.repeat(lengths) + np.arange(lengths.sum())]
        summaries = {}
        for name, parts in scores.items():
            summaries[name] = task.summarise({key: part[rows] for key, part in parts.items()})
        theirs = summaries.pop(best)
        for name, summary in summaries.items():
            for key, value in summary.items():
                gaps.setdefault((name, key), []).append(value - theirs[key])
    p: dict[str, dict[str, float]] = {}
    for (name, key), differences in gaps.items():
        if np.isnan(differences).any():  # a score is unknown, or both are infinite
            continue
        # Two-sided: the smaller tail of the differences, the observed one counted in.
        tails = np.less_equal(differences, 0).sum(), np.greater_equal(differences, 0).sum()
        p.setdefault(name, {})[key] = min(1.0, 2 * (int(min(tails)) + 1) / (resamples + 1))
    return Paired(best, len(chosen), p)
