"""What a score of a task is in a table, and what error it is in a figure with logarithmic axes."""

from typing import NamedTuple

from gaigs.registry import registry
from gaigs.report.table import monitor_names
from gaigs.task import Metric


class Scale(NamedTuple):
    """Of the score by whose mean the best checkpoints are chosen.

    Attributes:
        monitor: The score's name.
        title: What a reader calls its mean.
        unit: E.g. "dB"; empty for a ratio.
        higher_is_better: Whether it is a similarity; else it is an error.
        compared: What a reader calls the metric by which runs are compared, where that is another one.
    """

    monitor: str
    title: str
    unit: str
    higher_is_better: bool
    compared: str | None

    @property
    def error_title(self) -> str:
        """What ``error`` gives."""
        if not self.higher_is_better:
            return self.title
        return f"squared error over power, at the {self.title}" if self.unit else f"1 - {self.title}"

    def error(self, score: float) -> float:
        """An error above 0: itself; 1 less a similarity; of a ratio in dB the inverse ratio."""
        if not self.higher_is_better:
            return score
        return 10 ** (-score / 10) if self.unit else 1 - score

    def reaches(self, score: float, level: float) -> bool:
        """Whether a score is at least as good."""
        return score >= level if self.higher_is_better else score <= level


def scale_of(task: str) -> Scale:
    """The scale of a task, by its name.

    Raises:
        ValueError, ImportError: It is not installed.
    """
    known: dict[str, Metric] = registry("task").get(task).metrics()
    first = next(iter(known))
    monitor, mean = monitor_names(task)
    title, better, _ = known[mean or first]
    unit = title.partition("[")[2].rstrip("]")
    return Scale(monitor, title, unit, better, known[first].title if mean not in (None, first) else None)
