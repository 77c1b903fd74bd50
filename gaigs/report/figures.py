"""Figures of a task, registered for its class; drawing modules are imported when needed."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from gaigs.core.task import Task
from gaigs.data import Links

registered: dict[type[Task], type["TaskFigures"]] = {}
"""Figures of plug-ins, by task."""


class TaskFigures:
    """Base class of a task's figures; a task overrides the methods for its figures."""

    def of_run(self, task: Any, folder: Path, links: Links) -> dict[str, Any]:
        """Figures of one run by file name, drawn from the files in its folder."""
        return {}

    def of_systems(self, task: type[Any], files: Mapping[str, Path], split: str) -> dict[str, Any]:
        """Figures that compare several systems, by file name.

        Args:
            task: Class of the task.
            files: ``predictions.npz`` of each system by name, all with the same test links.
            split: Name of the split.
        """
        return {}


def register(task: type[Task]) -> Callable[[type[TaskFigures]], type[TaskFigures]]:
    """A class decorator: figures of a task, and of its subclasses without other figures.

    Example: docs/plugins.md, the task ``arrival``.
    """

    def remember(figures: type[TaskFigures]) -> type[TaskFigures]:
        registered[task] = figures
        return figures

    return remember
