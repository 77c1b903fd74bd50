"""Tables for terminals, Markdown and CSV; the scores of a run beside those of its baselines."""

import itertools
import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from gaigs.core.task import Metric, Task
from gaigs.io import tables
from gaigs.registry import registry

ROWS = 20
"""Most receivers in the table of a run."""


class Spread(NamedTuple):
    """A number of two runs or more: mean, standard deviation of the sample, least value."""

    mean: float
    deviation: float
    least: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        return cls(statistics.mean(values), statistics.stdev(values), min(values))


def task_class(name: str) -> type[Task]:
    """The class of a task; a ValueError if the task is not installed."""
    kind: type[Task] = registry("task").get(name)
    return kind


def headline(task: str, models: Mapping[str, Mapping]) -> tuple[str, Metric]:
    """The first of a task's metrics that the first model has: channels of unknown phase have no
    plain SNR.
    """
    known, scores = task_class(task).metrics(), next(iter(models.values()))
    name = next((name for name in known if name in scores), next(iter(known)))
    return name, known[name]


def monitor_names(task: str) -> tuple[str, str | None]:
    """The score that picks a task's best checkpoints, and the metric that is its mean, if there is
    one.
    """
    kind = task_class(task)
    known = kind.metrics()
    monitor = (
        kind.monitor if isinstance(kind.monitor, str) else next(iter(known))
    )  # a property of the instance
    return monitor, next((name for name in (f"{monitor}_mean", monitor) if name in known), None)


def written(value: float | int | str | Spread | None) -> str:
    """A value of a table as text; empty where it is unknown."""
    if isinstance(value, Spread):
        return f"{written(value.mean)} ± {written(value.deviation)}"
    if isinstance(value, float):
        return f"{value:.3f}" if abs(value) < 10 else f"{value:,.1f}"
    if isinstance(value, int):
        return f"{value:,}"
    return value or ""


def columns_of(rows: Iterable[Mapping]) -> list[str]:
    """The keys of all rows, in the order of their first appearance."""
    return list(dict.fromkeys(column for row in rows for column in row))


def write_csv(file: Path, rows: Sequence[Mapping], spread: Sequence[str] = ()) -> None:
    """Writes a line for each row; a column is there if a row has it.

    A ``Spread`` takes several columns: mean, deviation and least value, named with the ends
    ``spread``.
    """
    wide = {column for row in rows for column, value in row.items() if isinstance(value, Spread)}
    ends = lambda column: ["", *spread] if column in wide else [""]
    columns = [f"{column}{end}" for column in columns_of(rows) for end in ends(column)]
    lines = [columns]
    for row in rows:
        cells = {
            column: value if isinstance(value, Spread) else (value,)
            for column, value in row.items()
        }
        parts = {
            f"{c}{end}": v
            for c, values in cells.items()
            for end, v in zip(ends(c), values, strict=False)
        }
        lines.append([parts.get(column, "") for column in columns])
    tables.write_csv(file, lines)


def terminal(
    title: str,
    heads: Mapping[str, bool],
    lines: Sequence[Sequence[str]],
    caption: str,
    styles: Sequence = (),
) -> Table:
    """A table of cells in Rich's markup for a terminal.

    A head with True is of a column of numbers, which are not broken into lines.
    """
    table = Table(
        title=escape(title),
        caption=escape(caption),
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    for head, is_number in heads.items():
        head, justify = (stacked(head), "right") if is_number else (escape(head), "left")
        table.add_column(head, justify=justify, no_wrap=is_number, overflow="fold")
    for line, style in zip(lines, styles or [None] * len(lines), strict=True):
        table.add_row(*line, style=style)
    return table


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; the first line is the head."""
    head, *rows = lines
    ruled = [head, ["---"] * len(head), *rows]
    return "".join(
        "| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |\n" for line in ruled
    )


def stacked(title: str) -> str:
    """The head of a narrow column, a word a line."""
    return escape(title.replace(" ", "\n"))


def metrics_table(metrics: Mapping) -> Group:
    """Models down, metrics across, the best of each metric in bold; below it the same models at
    each receiver.
    """
    known, models = task_class(metrics["task"]).metrics(), metrics["models"]
    validation = metrics.get("validation") or {}
    first, metric = headline(metrics["task"], models)
    has = lambda name: all(name in scores for scores in models.values())
    # A terminal has room for five metrics; of more, only the brief ones are shown.
    names = [
        name for name, metric in known.items() if has(name) and (metric.is_brief or len(known) <= 5)
    ]
    # A split's name may end with a seed of its own.
    run = f"run with seed {metrics['seed']} on" if "seed" in metrics else "evaluated on"
    caption = escape(f"split {metrics['split']}\n{run} {metrics['device']}")
    table = Table(title="Test scores", caption=caption)
    table.add_column("model", no_wrap=True)
    columns = []
    for name in names:
        table.add_column(stacked(known[name].title), justify="right")
        columns.append(_cells(models, name, known[name].higher_is_better))
    if validation:
        table.add_column(stacked(f"{metric.title}, validation"), justify="right")
        columns.append(_cells(validation, first, metric.higher_is_better))
    for model in models:
        table.add_row(escape(model), *(cells.get(model, "") for cells in columns))
    return Group(
        table,
        *(
            [_receivers_table(metrics["receivers"], first, metric)]
            if metrics.get("receivers")
            else []
        ),
    )


def _receivers_table(receivers: Mapping, name: str, metric: Metric) -> Table:
    """Receivers down, models across: one metric; of many receivers the first ``ROWS``."""
    table = Table("receiver", title=f"{escape(metric.title)} at each receiver")
    if len(receivers) > ROWS:
        table.caption = f"the first {ROWS} of {len(receivers)} receivers; all are in metrics.json"
    for model in next(iter(receivers.values())):
        table.add_column(escape(model), justify="right")
    for receiver, models in itertools.islice(receivers.items(), ROWS):
        # Markup would make emojis of addresses such as 00:cd:11.
        table.add_row(Text(receiver), *_cells(models, name, metric.higher_is_better).values())
    return table


def _cells(models: Mapping, name: str, higher_is_better: bool) -> dict[str, str]:
    """One metric of each model as text, in bold all that print as the best."""
    best = written((max if higher_is_better else min)(scores[name] for scores in models.values()))
    texts = {model: written(scores[name]) for model, scores in models.items()}
    return {
        model: f"[bold]{text}[/bold]" if text == best else text for model, text in texts.items()
    }


def verdict(metrics: Mapping) -> str:
    """A sentence that compares the run's own model, the first of ``models``, with the baselines by
    the first metric.
    """
    (model, own), *others = metrics["models"].items()
    name, metric = headline(metrics["task"], metrics["models"])
    quantity, _, unit = metric.title.removesuffix("]").partition(" [")
    digits, unit = (2, f" {unit}") if unit else (3, "")
    stands = []
    for other, scores in others:
        gap = f"{own[name] - scores[name]:+.{digits}f}"
        side = {"+": "above", "-": "below"}[gap[0]]
        stands.append(
            f"level with {other}" if float(gap) == 0 else f"{gap[1:]}{unit} {side} {other}"
        )
    stand = (
        " and ".join(filter(None, (", ".join(stands[:-1]), *stands[-1:])))
        or f"at {own[name]:.{digits}f}{unit}"
    )
    hint = "" if metric.higher_is_better else " (lower is better)"
    return f"{model} is {stand} in {quantity}{hint} on split {metrics['split']}."
