"""The scores of a run, beside those of its baselines on the same split."""

from collections.abc import Mapping, Sequence

from rich.console import Group
from rich.markup import escape
from rich.table import Table

from gaigs.registry import registry

FITTING = 5
"""Most metrics that a terminal has room for; of more, only the brief ones are shown."""

TEX = str.maketrans(
    {sign: f"\\{sign}" for sign in "&%_#${}"}
    | {"±": r"$\pm$", "–": "--", "²": r"\textsuperscript{2}"}
    | {"~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "\\": r"\textbackslash{}"}
)


def metrics_of(metrics: Mapping) -> dict:
    """What a reader calls the metrics of a run, and which way they are better: those of its task, in their order.

    Args:
        metrics: Contents of ``metrics.json``, of which ``task`` counts.

    Raises:
        ValueError: They do not say the task, or it is not installed here.
    """
    if "task" not in metrics:
        raise ValueError(
            f"metrics.json must have the key 'task', got {', '.join(metrics)}; one without is of an earlier version of "
            "gaigs: do the run anew, in another folder"
        )
    return registry("task").get(metrics["task"]).metrics()


def monitor_names(task: str) -> tuple[str, str | None]:
    """The score by which a task's best checkpoints are chosen, and which of its metrics is the mean of that, if any."""
    kind = registry("task").get(task)
    known = kind.metrics()
    monitor = kind.monitor if isinstance(kind.monitor, str) else next(iter(known))  # a property of the instance
    return monitor, next((name for name in (f"{monitor}_mean", monitor) if name in known), None)


def written(value: float | int | str | None) -> str:
    """A value of a table as text; nothing where it is unknown."""
    if isinstance(value, float):
        return f"{value:.3f}" if abs(value) < 10 else f"{value:,.1f}"
    if isinstance(value, int):
        return f"{value:,}"
    return value or ""


def tex(text: str) -> str:
    """A text as LaTeX sets it."""
    return text.translate(TEX)


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, of which the first line is the head."""
    head, *rows = lines
    ruled = [head, ["---"] * len(head), *rows]
    return "".join("| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |\n" for line in ruled)


def latex(lines: Sequence[Sequence[str]]) -> str:
    """A ``tabular`` with the rules of the package booktabs, of cells in LaTeX; the first line is the head."""
    head, *rows = (" & ".join(line) + r" \\" for line in lines)
    start = rf"\begin{{tabular}}{{l{'c' * (len(lines[0]) - 1)}}}"
    return "\n".join([start, r"\toprule", head, r"\midrule", *rows, r"\bottomrule", r"\end{tabular}"]) + "\n"


def stacked(title: str) -> str:
    """The head of a column, a word a line, so that the column is no wider than its numbers need."""
    return escape(title.replace(" ", "\n"))


def metrics_table(metrics: Mapping) -> Group:
    """Models down, metrics across, the best of each metric in bold; below it the same models at each receiver.

    Args:
        metrics: Contents of ``metrics.json``: ``task``, ``split``, ``device``, of a run ``seed``, and ``models`` with
            the test scores of each. Where links were held out, ``validation`` has the same models' scores on those, of
            which the first metric is shown too; where there are several receivers, ``receivers`` has ``models`` for
            each of them.
    """
    known, models, validation = metrics_of(metrics), metrics["models"], metrics.get("validation") or {}
    has = lambda name: all(name in scores for scores in models.values())
    names = [name for name, metric in known.items() if has(name) and (metric.is_brief or len(known) <= FITTING)]
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
        first, metric = next(iter(known.items()))
        table.add_column(stacked(f"{metric.title}, validation"), justify="right")
        columns.append(_cells(validation, first, metric.higher_is_better))
    for model in models:
        table.add_row(escape(model), *(cells.get(model, "") for cells in columns))
    return Group(table, *([_receivers_table(metrics["receivers"], known)] if metrics.get("receivers") else []))


def _receivers_table(receivers: Mapping, known: dict) -> Table:
    """Receivers down, models across, and of the metrics the first."""
    name, metric = next(iter(known.items()))
    table = Table("receiver", title=f"{escape(metric.title)} at each receiver")
    for model in next(iter(receivers.values())):
        table.add_column(escape(model), justify="right")
    for receiver, models in receivers.items():
        table.add_row(escape(receiver), *_cells(models, name, metric.higher_is_better).values())
    return table


def _cells(models: Mapping, name: str, higher_is_better: bool) -> dict[str, str]:
    """One metric of each model as text, the best in bold."""
    best = (max if higher_is_better else min)(scores[name] for scores in models.values())
    texts = {model: written(scores[name]) for model, scores in models.items()}
    return {model: f"[bold]{text}[/bold]" if models[model][name] == best else text for model, text in texts.items()}


def verdict(metrics: Mapping) -> str:
    """A sentence on where the run's own model stands against the baselines.

    Args:
        metrics: As for ``metrics_table``; the first of ``models`` is the run's own, the first of the task's metrics
            counts.
    """
    (model, own), *others = metrics["models"].items()
    name, metric = next(iter(metrics_of(metrics).items()))
    quantity, _, unit = metric.title.removesuffix("]").partition(" [")
    digits, unit = (2, f" {unit}") if unit else (3, "")
    stands = []
    for other, scores in others:
        gap = f"{own[name] - scores[name]:+.{digits}f}"
        side = {"+": "above", "-": "below"}[gap[0]]
        stands.append(f"level with {other}" if float(gap) == 0 else f"{gap[1:]}{unit} {side} {other}")
    stand = " and ".join(filter(None, (", ".join(stands[:-1]), *stands[-1:]))) or f"at {own[name]:.{digits}f}{unit}"
    hint = "" if metric.higher_is_better else " (lower is better)"
    return f"{model} is {stand} in {quantity}{hint} on split {metrics['split']}."
