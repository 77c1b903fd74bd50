"""The scores of a run, beside those of the look-ups on the same split."""

from collections.abc import Mapping

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


def metrics_table(metrics: Mapping) -> Table:
    """Models down, metrics across, the best of each metric in bold.

    Args:
        metrics: Contents of ``metrics.json``: ``split``, ``seed``, ``device``, and ``models`` with the scores of each.
    """
    models = metrics["models"]
    names = list(next(iter(models.values())))
    best = {
        name: (max if larger_is_better(name) else min)(scores[name] for scores in models.values()) for name in names
    }
    # A split's name may end with a seed of its own.
    caption = escape(f"split {metrics['split']}\nrun with seed {metrics['seed']} on {metrics['device']}")
    table = Table("model", title="Test scores", caption=caption)
    for name in names:
        table.add_column(escape(METRICS.get(name, name)), justify="right")
    for model, scores in models.items():
        cells = [
            f"[bold]{written(scores[name])}[/bold]" if scores[name] == best[name] else written(scores[name])
            for name in names
        ]
        table.add_row(escape(model), *cells)
    return table


def verdict(metrics: Mapping) -> str:
    """A sentence on where the run's own model stands against the look-ups.

    Args:
        metrics: As for ``metrics_table``; the first of ``models`` is the run's own, the first of its metrics counts.
    """
    (model, own), *others = metrics["models"].items()
    metric = next(iter(own))
    stands = []
    for name, scores in others:
        gap = f"{own[metric] - scores[metric]:+.3f}"
        side = {"+": "above", "-": "below"}[gap[0]]
        stands.append(f"level with {name}" if float(gap) == 0 else f"{gap[1:]} {side} {name}")
    stand = " and ".join(stands) or f"at {written(own[metric])}"
    hint = "" if larger_is_better(metric) else " (lower is better)"
    return f"{model} is {stand} in {METRICS.get(metric, metric)}{hint} on split {metrics['split']}."
