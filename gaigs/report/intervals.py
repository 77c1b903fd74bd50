"""Figure of a run's intervals: how often they hold, and errors against the deviations that the
model states.
"""

from pathlib import Path

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from gaigs.core.task import Task
from gaigs.report.figures import own_scores
from gaigs.report.style import PAGE, STYLE, looks

BINS = 12
"""Points of the second panel, each of as many test links."""


def intervals(folder: Path, task: Task, split: str) -> Figure | None:
    """Shares of labels within intervals of each level, and the error of test links by their
    deviation; None without.
    """
    shares = own_scores(folder / "predictions.npz", "shares")
    with np.load(folder / "predictions.npz") as run:
        if not shares or "deviation" not in run.files:
            return None
        labels, predictions, deviations = (
            run[name] for name in ("labels", "prediction", "deviation")
        )
    labels = task.align(torch.from_numpy(labels), torch.from_numpy(predictions)).numpy()
    flat = lambda numbers: np.abs(numbers).astype(float).reshape(len(labels), -1)
    exists = ~np.isnan(flat(deviations))  # elements of the array
    errors, stated = (
        np.sqrt(np.mean(flat(part) ** 2, 1, where=exists))
        for part in (predictions - labels, deviations)
    )
    parts = [part for part in np.array_split(np.argsort(stated), BINS) if len(part)]
    levels = np.linspace(0, 1, len(next(iter(shares.values()))) + 2)[1:-1]
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, 0.46 * PAGE), layout="compressed")
        left, right = figure.subplots(1, 2)
        for (name, share), (colour, dash) in zip(
            shares.items(), looks(shares).values(), strict=True
        ):
            left.plot(levels, share, color=colour, linestyle=dash, label=name)
        left.axline((0, 0), slope=1, color="0.3", linewidth=0.7)
        left.set(
            xlim=(0, 1),
            ylim=(0, 1),
            aspect="equal",
            xlabel="level of the interval",
            ylabel="share of labels inside",
        )
        left.set_title(f"split {split}")
        left.legend()
        across, up = (
            np.array([np.sqrt((part[rows] ** 2).mean()) for rows in parts])
            for part in (stated, errors)
        )
        right.plot(across, up, "o", color=looks(shares)[next(iter(shares))][0], markersize=4)
        furthest = 1.08 * max(across.max(), up.max()) or 1.0
        right.axline((0, 0), slope=1, color="0.3", linewidth=0.7)
        unit = f" [{task.error_unit}]" if task.error_unit else ""
        right.set(xlim=(0, furthest), ylim=(0, furthest), aspect="equal")
        for axis in (right.xaxis, right.yaxis):
            axis.set_major_locator(MaxNLocator(5))
        right.ticklabel_format(scilimits=(-3, 4))
        right.set(xlabel=f"stated standard deviation{unit}", ylabel=f"root mean square error{unit}")
        right.set_title(f"{next(iter(shares))}, {len(errors):,} test links in {len(parts)} groups")
        for ax in (left, right):
            ax.grid()
            ax.set_axisbelow(True)
    return figure
