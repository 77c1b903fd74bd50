"""Arrays of ``predictions.npz`` for the figures of a task."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray


def as_baseline(name: str) -> str:
    """The displayed name of a baseline, to tell it from a system of the same name."""
    return f"{name} (baseline)"


def own_scores(file: Path, kind: str) -> dict[str, ndarray]:
    """Arrays ``<kind>_<model>`` of a ``predictions.npz`` by model, the run's model first."""
    start = f"{kind}_"
    with np.load(file) as run:
        return {key.removeprefix(start): run[key] for key in run.files if key.startswith(start)}


def scores_of_systems(files: Mapping[str, Path], kind: str) -> dict[str, ndarray]:
    """Scores ``kind`` of each system's model, then of the first system's baselines, by name.

    A baseline is left out if a system of the same name has the same scores.
    """
    systems: dict[str, ndarray] = {}
    baselines: dict[str, ndarray] = {}
    for name, file in files.items():
        by_model = own_scores(file, kind)
        model = next(iter(by_model))
        systems[name] = by_model.pop(model)
        by_model.pop(f"{model}_trend", None)
        baselines = baselines or by_model
    others: dict[str, ndarray] = {}
    for name, scores in baselines.items():
        if not np.array_equal(systems.get(name), scores):
            others[as_baseline(name) if name in systems else name] = scores
    return systems | others


class Examples(NamedTuple):
    """Labels, predictions and scores of some test links, for a figure."""

    labels: ndarray  # labels (k, *shape)
    predictions: ndarray  # predictions, likewise
    scores: Float[ndarray, " k"]  # score of each sample
    names: list[str]  # rank of each sample among all


def read_examples(file: Path, kind: str) -> Examples:
    """The samples at the 10th percentile, the median and the 90th percentile of a score.

    The score is ``<kind>_<model>`` of the run's model.
    """
    scores = next(iter(own_scores(file, kind).values()))
    order = np.argsort(scores)
    names = {}  # by the number of the sample; of few samples one may have two ranks
    for name, fraction in (("10th percentile", 0.1), ("median", 0.5), ("90th percentile", 0.9)):
        rank = round(fraction * (len(order) - 1))
        names[int(order[rank])] = name
    shown = [*names]
    with np.load(file) as run:
        labels = run["labels"][shown]
        predictions = run["prediction"][shown]
    return Examples(labels, predictions, scores[shown], [*names.values()])
