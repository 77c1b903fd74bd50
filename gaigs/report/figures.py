"""Figures of a task, registered for its class. Drawing modules are imported when something is drawn."""

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gaigs.data import Links
from gaigs.report.runs import as_baseline
from gaigs.task import Task

registered: dict[type[Task], type["TaskFigures"]] = {}
"""Figures of plug-ins, by task."""


class TaskFigures:
    """Figures of a task. A subclass overrides the methods for which it has figures."""

    def of_run(self, task: Task, folder: Path, links: Links) -> dict:
        """Figures of one run by file name, drawn from the files in its folder."""
        return {}

    def of_systems(self, task: type[Task], files: Mapping[str, Path], split: str) -> dict:
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
        return {key.removeprefix(f"{kind}_"): run[key] for key in run.files if key.startswith(f"{kind}_")}


def scores_of_systems(files: Mapping[str, Path], kind: str) -> dict[str, ndarray]:
    """The arrays ``<kind>_<model>`` of several ``predictions.npz``: each system's own, then the baselines of the first.

    A baseline with the name of a system and other scores is marked as a baseline.
    """
    own, baselines = {}, {}
    for name, file in files.items():
        (model, own[name]), *others = own_scores(file, kind).items()
        baselines = baselines or {other: scores for other, scores in others if other != f"{model}_trend"}
    others = {name: scores for name, scores in baselines.items() if not np.array_equal(own.get(name), scores)}
    return own | {as_baseline(name) if name in own else name: scores for name, scores in others.items()}


def examples(scores: Float[ndarray, " t"]) -> dict[int, str]:
    """Indices of the samples that are shown, with their rank in a score as the name."""
    order = np.argsort(scores)
    ranks = {"10th percentile": 0.1, "median": 0.5, "90th percentile": 0.9}
    return {int(order[round(rank * (len(order) - 1))]): name for name, rank in ranks.items()}
