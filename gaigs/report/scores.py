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
    """The score of a link that chooses the best checkpoint, and the metric that is its mean.

    The metric is None if the task has no such metric.
    """
    kind = task_class(task)
    known = kind.metrics()
    # For some tasks the monitor is a property of the instance.
    monitor = kind.monitor if isinstance(kind.monitor, str) else next(iter(known))
    for metric in (f"{monitor}_mean", monitor):
        if metric in known:
            return monitor, metric
    return monitor, None


def metrics_table(metrics: Mapping) -> Group:
    """Tables of a ``metrics.json``: scores of the models, then the main metric at each receiver.

    The best value of each metric is bold.
    """
    known = task_class(metrics["task"]).metrics()
    models = metrics["models"]
    main_name, main_metric = headline(metrics["task"], models)
    # "run with seed", as a split's name may end with a seed of its own.
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
        p_values = {model: p[main_name] for model, p in test["p"].items() if main_name in p}
        columns.append({model: f"{p:.2g}" for model, p in p_values.items()})
    if validation := metrics.get("validation"):
        table.add_column(stacked(f"{main_metric.title}, validation"), justify="right")
        columns.append(_texts(validation, main_name, main_metric))
    for model in models:
        table.add_row(escape(model), *(texts.get(model, "") for texts in columns))
    if receivers := metrics.get("receivers"):
        return Group(table, _receivers_table(receivers, main_name, main_metric))
    return Group(table)


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
    """The values of one metric as text, by model; the best has the format ``bold``."""
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
    """A sentence: the model's main score, its distance to the best baseline, and before kriging."""
    (model, scores), *baselines = metrics["models"].items()
    name, metric = headline(metrics["task"], metrics["models"])
    quantity, _, unit = metric.title.removesuffix("]").partition(" [")
    digits = 2 if unit else 3
    unit = f" {unit}" if unit else ""
    text = f"{model}: {quantity} {scores[name]:.{digits}f}{unit}"
    trend = ""
    values = {}
    for baseline, baseline_scores in baselines:
        value = baseline_scores[name]
        if baseline == f"{model}_trend":  # the model itself without kriging is no baseline
            trend = f" Before kriging ({baseline}) it is {value:.{digits}f}{unit}."
        else:
            values[baseline] = value
    if values:
        best = (max if metric.higher_is_better else min)(values, key=values.__getitem__)
        gap = scores[name] - values[best]
        # A gap that is printed as 0 is neither better nor worse.
        printed_gap = f"{abs(gap):.{digits}f}"
        is_level = float(printed_gap) == 0
        is_better = (gap > 0) == metric.higher_is_better
        relation = f"{printed_gap}{unit} {'better' if is_better else 'worse'} than"
        text += f", {'level with' if is_level else relation} {best}, the best baseline"
        test = metrics.get("paired")
        p = None if test is None else test["p"].get(model, {}).get(name)
        if p is not None and not is_level:
            text += f" (p = {p:.2g}{'' if p < 0.05 else ', may be chance'})"
    return f"{text}, on split {metrics['split']}.{trend}"
