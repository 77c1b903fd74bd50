"""Figure of a run's intervals: their coverage, and errors against predicted deviations."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Shaped
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy import ndarray

from gaigs.core.task import Task
from gaigs.report.predictions import own_scores
from gaigs.report.style import PAGE, STYLE, ask, looks, new_figure


def intervals(folder: Path, task: Task, split: str) -> Figure | None:
    """A figure of the coverage of intervals, and of errors against predicted deviations.

    None for a run without intervals.
    """
    file = folder / "predictions.npz"
    coverages = own_scores(file, "shares")  # by model, of intervals with levels between 0 and 1
    with np.load(file) as run:
        if not coverages or "deviation" not in run.files:
            return None
        labels = run["labels"]
        predictions = run["prediction"]
        deviations = run["deviation"]
    labels = task.align(torch.from_numpy(labels), torch.from_numpy(predictions)).numpy()
    exists = ~np.isnan(_magnitudes(deviations))  # elements that the array has, (k, numbers)
    squared_errors = _magnitudes(predictions - labels) ** 2
    errors = np.sqrt(np.mean(squared_errors, 1, where=exists))  # (k,)
    stated = np.sqrt(np.mean(_magnitudes(deviations) ** 2, 1, where=exists))
    with rc_context(STYLE):
        figure = new_figure(PAGE, 0.52 * PAGE, "compressed")
        left, right = figure.subplots(1, 2)
        _draw_coverages(left, coverages)
        left.set_title("how often intervals hold")
        left.legend()
        name = next(iter(coverages))
        (colour, _) = looks(coverages)[name]
        count = _draw_errors(right, stated, errors, colour)
        unit = task.error_unit
        label = f" [{unit}]" if unit else ""
        right.set(
            xlabel=f"stated standard deviation{label}", ylabel=f"root mean square error{label}"
        )
        right.set_title(f"{name}, {len(errors):,} test links in {count} groups")
        for ax in (left, right):
            ax.axline((0, 0), slope=1, color="0.3", linewidth=0.7)
            ax.grid()
            ax.set_axisbelow(True)
        ask(figure, "Can the stated uncertainty be trusted?", f"split {split}")
    return figure


def _magnitudes(numbers: Shaped[ndarray, "..."]) -> Float[ndarray, "k numbers"]:
    """Absolute values of k labels of any shape, one row for each label."""
    return np.abs(numbers).astype(float).reshape(len(numbers), -1)


def _draw_coverages(ax: Axes, coverages: Mapping[str, Float[ndarray, " levels"]]) -> None:
    """Draws the coverage of intervals over their level, a line for each model."""
    count = len(next(iter(coverages.values())))
    levels = np.linspace(0, 1, count + 2)[1:-1]  # without 0 and 1
    for name, (colour, dash) in looks(coverages).items():
        ax.plot(levels, coverages[name], color=colour, linestyle=dash, label=name)
    ax.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    ax.set(xlabel="level of the interval", ylabel="share of labels inside")


def _draw_errors(
    ax: Axes,
    stated: Float[ndarray, " k"],
    errors: Float[ndarray, " k"],
    colour: str,
    groups: int = 12,
) -> int:
    """Draws root mean square errors of groups of links; returns the number of groups.

    Links of a group have similar deviations.

    Args:
        stated: Stated standard deviation of each link.
        errors: Root mean square error of each link.
        groups: Largest number of groups.
    """
    rows = [group for group in np.array_split(np.argsort(stated), groups) if len(group)]
    x = np.array([np.sqrt((stated[group] ** 2).mean()) for group in rows])
    y = np.array([np.sqrt((errors[group] ** 2).mean()) for group in rows])
    ax.plot(x, y, "o", color=colour, markersize=4)
    furthest = 1.08 * max(x.max(), y.max()) or 1.0
    ax.set(xlim=(0, furthest), ylim=(0, furthest), aspect="equal")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_locator(MaxNLocator(5))
    ax.ticklabel_format(scilimits=(-3, 4))
    return len(rows)
