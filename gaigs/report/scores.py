"""Scores of one run next to its baselines' scores: main metric, a table, a sentence."""

import itertools
from collections.abc import Mapping
from typing import Any

from rich.console import Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from gaigs.core.results import library
from gaigs.core.task import Metric, Task
from gaigs.registry import registry
from gaigs.report.table import best_in_bold, latex, stacked, tex

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
    """Name and metric of a run's main score: the first metric of the task that its model has.

    For example, channels of unknown phase have no SNR.

    Args:
        models: Scores by name of the model, the run's model first.
    """
    known = task_class(task).metrics()
    scores = next(iter(models.values()))
    name = next((name for name in known if name in scores), next(iter(known)))
    return name, known[name]


def monitor_names(task: str) -> tuple[str, str | None]:
    """The score that chooses the best checkpoint; and the metric of its mean, None without one."""
    kind = task_class(task)
    known = kind.metrics()
    # For some tasks the monitor is a property of the instance.
    monitor = kind.monitor if isinstance(kind.monitor, str) else next(iter(known))
    return monitor, next((name for name in (f"{monitor}_mean", monitor) if name in known), None)


def metrics_table(metrics: Mapping) -> Group:
    """Tables of scores, models down and metrics across; then one metric at each receiver.

    The best value of each metric is bold.
    """
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
        # A terminal has room for five numbers; of more, only the brief metrics are shown.
        has_room = shown.is_brief or len(known) + bool(metrics.get("paired")) <= 5
        if has_room and all(name in scores for scores in models.values()):
            table.add_column(stacked(shown.title), justify="right")
            columns.append(_texts(models, name, shown))
    if test := metrics.get("paired"):
        table.add_column(stacked(f"p against {test['baseline']}"), justify="right")
        columns.append({model: f"{p[first]:.2g}" for model, p in test["p"].items() if first in p})
    if validation := metrics.get("validation"):
        table.add_column(stacked(f"{metric.title}, validation"), justify="right")
        columns.append(_texts(validation, first, metric))
    for model in models:
        table.add_row(escape(model), *(texts.get(model, "") for texts in columns))
    receivers = metrics.get("receivers")
    return Group(table, *([_receivers_table(receivers, first, metric)] if receivers else []))


def _receivers_table(receivers: Mapping, name: str, metric: Metric, max_rows: int = 20) -> Table:
    """A table of one metric at the first ``max_rows`` receivers, receivers down, models across."""
    table = Table("receiver", title=f"{escape(metric.title)} at each receiver")
    if len(receivers) > max_rows:
        table.caption = (
            f"the first {max_rows} of {len(receivers)} receivers; all are in metrics.json"
        )
    for model in next(iter(receivers.values())):
        table.add_column(stacked(model), justify="right")
    for receiver, models in itertools.islice(receivers.items(), max_rows):
        # Markup would make emojis of addresses such as 00:cd:11.
        table.add_row(Text(receiver), *_texts(models, name, metric).values())
    return table


def _texts(
    models: Mapping[str, Mapping], name: str, metric: Metric, bold: str = "[bold]{}[/bold]"
) -> dict[str, str]:
    """One metric as text by model, the best value in the format ``bold``."""
    values = [scores[name] for scores in models.values()]
    return dict(zip(models, best_in_bold(values, metric.higher_is_better, bold), strict=True))


def score_frame(metrics: Mapping) -> Any:
    """The scores as a ``pandas.DataFrame``, each next to the p value of its paired test."""
    pandas = library("pandas", "to_dataframe")
    test = metrics.get("paired") or {"p": {}}
    rows: dict[str, dict] = {}
    for model, scores in metrics["models"].items():
        rows[model] = {}
        for name, metric in task_class(metrics["task"]).metrics().items():
            if name in scores:
                rows[model][metric.title] = scores[name]
                rows[model][f"{metric.title}, p"] = test["p"].get(model, {}).get(name)
    frame = pandas.DataFrame.from_dict(rows, orient="index").astype(float)
    frame.index.name = "model"
    frame.attrs = {"split": metrics["split"], "best_baseline": test.get("baseline")}
    return frame


def score_latex(metrics: Mapping) -> str:
    """The scores as a table in LaTeX, see ``Evaluation.to_latex``."""
    models = metrics["models"]
    test = metrics.get("paired")
    columns = [["model", *map(tex, models)]]
    for name, metric in task_class(metrics["task"]).metrics().items():
        if all(name in scores for scores in models.values()):
            texts = _texts(models, name, metric, r"\textbf{{{}}}")
            for model in texts if test else ():
                texts[model] += "$^*$" if test["p"].get(model, {}).get(name, 1.0) < 0.05 else ""
            columns.append([tex(metric.title), *texts.values()])
    lines = [[*line] for line in zip(*columns, strict=True)]
    note = (
        f"Test scores on split {tex(metrics['split'])}. Bold: the best, and all that print alike."
    )
    if test:
        chance = f"$p<0.05$ in a paired bootstrap over {test['places']:,} places"
        note += f" $^*$: differs from {tex(test['baseline'])}, the best baseline ({chance})."
    return latex(lines, 1, note)


def verdict(metrics: Mapping) -> str:
    """A sentence that compares main scores: of the model, the best baseline, and before kriging."""
    (model, scores), *baselines = metrics["models"].items()
    name, metric = headline(metrics["task"], metrics["models"])
    quantity, _, unit = metric.title.removesuffix("]").partition(" [")
    digits = 2 if unit else 3
    unit = unit and f" {unit}"
    text = f"{model}: {quantity} {scores[name]:.{digits}f}{unit}"
    trend = ""
    values = {}
    for other, theirs in baselines:
        if other == f"{model}_trend":  # the model itself without kriging is no baseline
            trend = f" Before kriging ({other}) it is {theirs[name]:.{digits}f}{unit}."
        else:
            values[other] = theirs[name]
    if values:
        best = (max if metric.higher_is_better else min)(values, key=values.__getitem__)
        gap = scores[name] - values[best]
        # A gap that is printed as 0 is neither better nor worse.
        size = f"{abs(gap):.{digits}f}"
        is_better = (gap > 0) == metric.higher_is_better
        side = f"{size}{unit} {'better' if is_better else 'worse'} than"
        text += f", {side if float(size) else 'level with'} {best}, the best baseline"
        test = metrics.get("paired")
        p = None if test is None else test["p"].get(model, {}).get(name)
        if p is not None and float(size):
            text += f" (p = {p:.2g}{'' if p < 0.05 else ', may be chance'})"
    return f"{text}, on split {metrics['split']}.{trend}"
