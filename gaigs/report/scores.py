"""Scores of one run beside its baselines' scores: which ones count, a table, a sentence."""

import itertools
from collections.abc import Mapping

from rich.console import Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from gaigs.core.task import Metric, Task
from gaigs.registry import registry
from gaigs.report.table import best_in_bold, stacked

COSTS = {
    "train_seconds": "training [s]",
    "inference_ms": "inference [ms]",
    "render_ms": "rendering [ms]",
    "num_parameters": "parameters",
    "num_gaussians": "Gaussians",
    "checkpoint_bytes": "checkpoint [MB]",
}
"""Titles of the costs in ``metrics.json``, in the order of a table."""


def train_seconds(metrics: Mapping) -> float | None:
    """Duration of a run's training and kriging [s]; None for a look-up."""
    seconds = metrics.get("train_seconds")
    return None if seconds is None else seconds + metrics.get("kriging", {}).get("seconds", 0.0)


def task_class(name: str) -> type[Task]:
    """The class of a task; a ValueError if the task is not installed."""
    kind: type[Task] = registry("task").get(name)
    return kind


def headline(task: str, models: Mapping[str, Mapping]) -> tuple[str, Metric]:
    """The first of a task's metrics that the first model has.

    Channels of unknown phase lack the plain SNR.
    """
    known = task_class(task).metrics()
    scores = next(iter(models.values()))
    name = next((name for name in known if name in scores), next(iter(known)))
    return name, known[name]


def monitor_names(task: str) -> tuple[str, str | None]:
    """The score that picks the best checkpoint, and the metric that is its mean or None."""
    kind = task_class(task)
    known = kind.metrics()
    # For some tasks the monitor is a property of the instance.
    monitor = kind.monitor if isinstance(kind.monitor, str) else next(iter(known))
    return monitor, next((name for name in (f"{monitor}_mean", monitor) if name in known), None)


def metrics_table(metrics: Mapping) -> Group:
    """Models down, metrics across, the best of each in bold; below it the same at each receiver."""
    known = task_class(metrics["task"]).metrics()
    models = metrics["models"]
    first, metric = headline(metrics["task"], models)
    # A split's name may end with a seed of its own.
    run = f"run with seed {metrics['seed']} on" if "seed" in metrics else "evaluated on"
    caption = escape(f"split {metrics['split']}\n{run} {metrics['device']}")
    table = Table(title="Test scores", caption=caption)
    table.add_column("model", no_wrap=True)
    columns = []
    for name, shown in known.items():
        # A terminal has room for five metrics; of more, only the brief ones are shown.
        has_room = shown.is_brief or len(known) <= 5
        if has_room and all(name in scores for scores in models.values()):
            table.add_column(stacked(shown.title), justify="right")
            columns.append(_texts(models, name, shown))
    if validation := metrics.get("validation"):
        table.add_column(stacked(f"{metric.title}, validation"), justify="right")
        columns.append(_texts(validation, first, metric))
    for model in models:
        table.add_row(escape(model), *(texts.get(model, "") for texts in columns))
    receivers = metrics.get("receivers")
    return Group(table, *([_receivers_table(receivers, first, metric)] if receivers else []))


def _receivers_table(receivers: Mapping, name: str, metric: Metric, max_rows: int = 20) -> Table:
    """Receivers down, models across: one metric; of many receivers the first."""
    table = Table("receiver", title=f"{escape(metric.title)} at each receiver")
    if len(receivers) > max_rows:
        table.caption = (
            f"the first {max_rows} of {len(receivers)} receivers; all are in metrics.json"
        )
    for model in next(iter(receivers.values())):
        table.add_column(escape(model), justify="right")
    for receiver, models in itertools.islice(receivers.items(), max_rows):
        # Markup would make emojis of addresses such as 00:cd:11.
        table.add_row(Text(receiver), *_texts(models, name, metric).values())
    return table


def _texts(models: Mapping[str, Mapping], name: str, metric: Metric) -> dict[str, str]:
    """One metric by model, the best in bold."""
    values = [scores[name] for scores in models.values()]
    return dict(zip(models, best_in_bold(values, metric.higher_is_better), strict=True))


def verdict(metrics: Mapping) -> str:
    """A sentence that compares the run's model, the first one, with the baselines by one metric."""
    (model, scores), *baselines = metrics["models"].items()
    name, metric = headline(metrics["task"], metrics["models"])
    quantity, _, unit = metric.title.removesuffix("]").partition(" [")
    digits = 2 if unit else 3
    if unit:
        unit = f" {unit}"
    comparisons = []
    for other, theirs in baselines:
        gap = f"{scores[name] - theirs[name]:+.{digits}f}"
        side = "above" if gap[0] == "+" else "below"
        is_level = float(gap) == 0
        comparisons.append(f"level with {other}" if is_level else f"{gap[1:]}{unit} {side} {other}")
    listed = [", ".join(comparisons[:-1]), *comparisons[-1:]]
    text = " and ".join(filter(None, listed)) or f"at {scores[name]:.{digits}f}{unit}"
    hint = "" if metric.higher_is_better else " (lower is better)"
    return f"{model} is {text} in {quantity}{hint} on split {metrics['split']}."
