"""Figures of a task, registered for its class. Drawing modules are imported when something is
drawn.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gaigs.core.task import Task
from gaigs.data import Links
from gaigs.report.runs import as_baseline

registered: dict[type[Task], type["TaskFigures"]] = {}
"""Figures of plug-ins, by task."""


class TaskFigures:
    """Figures of a task. A subclass overrides the methods for which it has figures."""

    def of_run(self, task: Any, folder: Path, links: Links) -> dict[str, Any]:
        """Figures of one run by file name, drawn from the files in its folder."""
        return {}

    def of_systems(self, task: type[Any], files: Mapping[str, Path], split: str) -> dict[str, Any]:
        """Figures that compare several systems, by file name.

        Args:
            task: Class of the task.
            files: ``predictions.npz`` of each system, by its name; all with the same test links.
            split: Name of the split.
        """
        return {}


def register(task: type[Task]) -> Callable[[type[TaskFigures]], type[TaskFigures]]:
    """A class decorator: figures of a task and of its subclasses without figures of their own.

    Example: docs/plugins.md, the task ``arrival``.
    """

    def remember(figures: type[TaskFigures]) -> type[TaskFigures]:
        registered[task] = figures
        return figures

    return remember


def own_scores(file: Path, kind: str) -> dict[str, ndarray]:
    """The arrays ``<kind>_<model>`` of ``predictions.npz`` by model, the run's own model first."""
    with np.load(file) as run:
        return {
            key.removeprefix(f"{kind}_"): run[key]
            for key in run.files
            if key.startswith(f"{kind}_")
        }


def scores_of_systems(files: Mapping[str, Path], kind: str) -> dict[str, ndarray]:
    """The arrays ``<kind>_<model>`` of each system's own model, then those of the first system's
    baselines.
    """
    own: dict[str, ndarray] = {}
    baselines: dict[str, ndarray] = {}
    for name, file in files.items():
        (model, own[name]), *others = own_scores(file, kind).items()
        baselines = baselines or {
            other: scores for other, scores in others if other != f"{model}_trend"
        }
    marked = {as_baseline(name) if name in own else name: name for name in baselines}
    return own | {
        title: baselines[name]
        for title, name in marked.items()
        if not np.array_equal(own.get(name), baselines[name])
    }


class Examples(NamedTuple):
    """Test samples for a figure: labels and predictions (k, *shape), scores, and names of their
    ranks.
    """

    labels: ndarray
    predictions: ndarray
    scores: Float[ndarray, " k"]
    names: list[str]


def read_examples(file: Path, kind: str) -> Examples:
    """The samples of ``predictions.npz`` at three ranks of the own model's score
    ``<kind>_<model>``.
    """
    scores = next(iter(own_scores(file, kind).values()))
    order = np.argsort(scores)
    ranks = {"10th percentile": 0.1, "median": 0.5, "90th percentile": 0.9}
    chosen = {int(order[round(rank * (len(order) - 1))]): name for name, rank in ranks.items()}
    shown = [*chosen]
    with np.load(file) as run:
        return Examples(
            run["labels"][shown], run["prediction"][shown], scores[shown], [*chosen.values()]
        )
