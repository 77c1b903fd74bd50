"""The scores of a run, beside those of the look-ups on the same split."""

from collections.abc import Mapping

from rich.console import Group
from rich.markup import escape
from rich.table import Table

METRICS = {
    "ssim_median": "median SSIM",
    "ssim_mean": "mean SSIM",
    "ssim_p10": "p10 SSIM",
    "ssim_p90": "p90 SSIM",
    "mae": "MAE",
    "mae_db": "MAE [dB]",
    "median_ae_db": "median AE [dB]",
    "rmse_db": "RMSE [dB]",
}
"""What a reader calls the metrics of ``metrics.json``."""


def larger_is_better(metric: str) -> bool:
    """Whether a metric is a similarity; the others are errors."""
    return metric.startswith("ssim")


def written(value: float | int | str | None) -> str:
    """A value of a table as text; nothing where it is unknown."""
    if isinstance(value, float):
        return f"{value:.3f}" if abs(value) < 10 else f"{value:,.1f}"
    if isinstance(value, int):
        return f"{value:,}"
    return value or ""


def metrics_table(metrics: Mapping) -> Group:
    """Models down, metrics across, the best of each metric in bold; below it the same models at each receiver.

    Args:
        metrics: Contents of ``metrics.json``: ``split``, ``seed``, ``device``, and ``models`` with the scores of each;
            ``receivers``, where there are several, has those ``models`` for each of them.
    """
    models = metrics["models"]
    names = list(next(iter(models.values())))
    # A split's name may end with a seed of its own.
    caption = escape(f"split {metrics['split']}\nrun with seed {metrics['seed']} on {metrics['device']}")
    table = Table("model", title="Test scores", caption=caption)
    best = _best(models)
    for name in names:
        table.add_column(escape(METRICS.get(name, name)), justify="right")
    for model, scores in models.items():
        table.add_row(escape(model), *(_cell(scores[name], best[name]) for name in names))
    return Group(table, *([_receivers_table(metrics["receivers"])] if metrics.get("receivers") else []))


def _receivers_table(receivers: Mapping) -> Table:
    """Receivers down, models across, and of the metrics the first."""
    models = next(iter(receivers.values()))
    metric = next(iter(next(iter(models.values()))))
    table = Table("receiver", title=f"{escape(METRICS.get(metric, metric))} at each receiver")
    for model in models:
        table.add_column(escape(model), justify="right")
    for receiver, scores in receivers.items():
        best = _best(scores)[metric]
        table.add_row(escape(receiver), *(_cell(scores[model][metric], best) for model in models))
    return table


def _best(models: Mapping) -> dict[str, float]:
    """The best of each metric over the models."""
    return {
        name: (max if larger_is_better(name) else min)(scores[name] for scores in models.values())
        for name in next(iter(models.values()))
    }


def _cell(value: float, best: float) -> str:
    return f"[bold]{written(value)}[/bold]" if value == best else written(value)


def verdict(metrics: Mapping) -> str:
    """A sentence on where the run's own model stands against the look-ups.

    Args:
        metrics: As for ``metrics_table``; the first of ``models`` is the run's own, the first of its metrics counts.
    """
    (model, own), *others = metrics["models"].items()
    metric = next(iter(own))
    quantity, _, unit = METRICS.get(metric, metric).removesuffix("]").partition(" [")
    digits, unit = (2, f" {unit}") if unit else (3, "")
    stands = []
    for name, scores in others:
        gap = f"{own[metric] - scores[metric]:+.{digits}f}"
        side = {"+": "above", "-": "below"}[gap[0]]
        stands.append(f"level with {name}" if float(gap) == 0 else f"{gap[1:]}{unit} {side} {name}")
    stand = " and ".join(filter(None, (", ".join(stands[:-1]), *stands[-1:]))) or f"at {own[metric]:.{digits}f}{unit}"
    hint = "" if larger_is_better(metric) else " (lower is better)"
    return f"{model} is {stand} in {quantity}{hint} on split {metrics['split']}."
