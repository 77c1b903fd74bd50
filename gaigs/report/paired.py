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
    """Paired tests of models against the best baseline."""

    baseline: str  # name of the best baseline
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
    """A paired bootstrap test of each model against the best baseline, for each metric.

    Places are drawn with replacement, all links of a place together, since they are dependent.
    Model and baseline are scored on the same drawn places. The result is None without baselines or
    with a single place.

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
    values = {name: task.summarise(dict(arrays)) for name, arrays in scores.items()}
    model, *others = values
    baselines = [name for name in others if name != f"{model}_trend"]
    distinct_places, place_of_link = torch.unique(places, return_inverse=True)
    if not baselines or len(distinct_places) < 2:
        return None
    metric_name, metric = headline(task.name, values)
    choose = max if metric.higher_is_better else min
    best = choose(baselines, key=lambda name: values[name][metric_name])
    by_place = place_of_link.argsort(stable=True)  # links of place 0, then of place 1, ...
    counts = place_of_link.bincount().numpy()  # links of each place
    firsts = counts.cumsum() - counts  # position of each place's first link in ``by_place``
    place_count = max(2, most * len(counts) // len(place_of_link))
    chosen = drawn(torch.arange(len(counts)), place_count).numpy()
    random = np.random.default_rng(seed)
    differences: dict[tuple[str, str], list[float]] = {}  # model less baseline, by resample
    for _ in range(resamples):
        sample = chosen[random.integers(0, len(chosen), len(chosen))]
        lengths = counts[sample]
        # Positions in ``by_place`` of all links of the first drawn place, then of the second, ...:
        # an index that counts all drawn links, shifted to the links of each place.
        shifts = firsts[sample] - (lengths.cumsum() - lengths)
        positions = shifts.repeat(lengths) + np.arange(lengths.sum())
        rows = by_place[positions]
        summaries = {}
        for name, arrays in scores.items():
            summaries[name] = task.summarise({key: array[rows] for key, array in arrays.items()})
        baseline_summary = summaries.pop(best)
        for name, summary in summaries.items():
            for key, value in summary.items():
                differences.setdefault((name, key), []).append(value - baseline_summary[key])
    p: dict[str, dict[str, float]] = {}
    for (name, key), sampled in differences.items():
        if np.isnan(sampled).any():  # a score is unknown, or both are infinite
            continue
        # Two-sided: twice the smaller tail; + 1 counts the observed difference as a resample.
        tails = np.less_equal(sampled, 0).sum(), np.greater_equal(sampled, 0).sum()
        p.setdefault(name, {})[key] = min(1.0, 2 * (int(min(tails)) + 1) / (resamples + 1))
    return Paired(best, len(chosen), p)
