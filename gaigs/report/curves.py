"""Curves: distributions of scores, losses and scores over a training, scores against times."""

import csv
import math
import textwrap
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from numpy import ndarray

from gaigs.core.task import Metric
from gaigs.report.style import COLUMN, LINES, MARKERS, PAGE, STYLE, looks

LABEL = 48
"""Most characters of a line of an axis label, in a figure of one column."""


def cdf(
    values: Mapping[str, Float[ndarray, " t"]],
    quantity: str,
    samples: str,
    split: str,
    limits: tuple[float | None, float | None],
) -> Figure:
    """Share of test samples with at most a given value, one step curve a model, medians marked.

    Args:
        values: Values of every test sample by model, the run's own model first.
        quantity: Name of the values, with their unit.
        samples: Name of the samples, e.g. "links".
        split: Name of the split.
        limits: Ends of the axis of values; None for those of the data.
    """
    with rc_context(STYLE):
        longest = max(map(len, values))
        ncols = (
            3 if longest <= 12 else 2 if longest <= 20 else 1
        )  # letters that fit a part of a column
        figure = Figure(
            figsize=(COLUMN, 2.45 + 0.15 * math.ceil(len(values) / ncols)), layout="constrained"
        )
        ax = figure.subplots()
        ax.axhline(0.5, color="0.75", linewidth=0.6, zorder=0)
        for (name, sample), (colour, dash) in zip(
            values.items(), looks(values).values(), strict=True
        ):
            median = float(np.median(sample))
            ax.ecdf(
                sample,
                color=colour,
                linestyle=dash,
                zorder=2.5 if name == next(iter(values)) else 2,
                label=f"{name} {median:#.3g}",
            )
            ax.plot(
                median,
                0.5,
                "o",
                color=colour,
                markersize=4,
                markeredgecolor="white",
                markeredgewidth=0.6,
            )
        label = textwrap.fill(f"{quantity}, split {split}", LABEL)
        ax.set(xlabel=label, ylabel=f"share of test {samples}", ylim=(0, 1.01))
        ax.set_xlim(*limits)
        key = {"ncols": ncols, "handlelength": 2.4, "columnspacing": 1.2}
        figure.legend(loc="outside upper center", title=f"median {quantity}", **key)
        ax.grid(axis="x")
    return figure


def read_curves(paths: Sequence[Path]) -> dict[str, tuple[ndarray, ndarray]]:
    """Steps and values of every quantity in files of Lightning's CSVLogger; empty cells are left
    out.

    A killed run may leave an empty file or a cut last row. Both are skipped; the next start has
    logged them again.

    Args:
        paths: One file for each start of the run; a later file replaces earlier ones from its first
            step on.
    """
    curves: dict[str, dict[float, float]] = {}
    for path in paths:
        with open(path, newline="", encoding="utf-8") as file:
            reader = csv.DictReader(line for line in file if line.endswith("\n"))
            if reader.fieldnames is None:
                continue
            rows = list(reader)
            begin = min((float(row["step"]) for row in rows), default=math.inf)
            for points in curves.values():
                for step in [step for step in points if step >= begin]:
                    del points[step]
            for row in rows:
                for name in reader.fieldnames:
                    if row[name] and name not in ("step", "epoch"):
                        curves.setdefault(name, {})[float(row["step"])] = float(row[name])
    return {
        name: tuple(np.array(sorted(points.items())).T) for name, points in curves.items() if points
    }


def read_log(folder: Path) -> dict[str, tuple[ndarray, ndarray]]:
    """The curves in the log of a run's folder, of all its starts; empty for a run without a
    training.
    """
    return read_curves(
        sorted(folder.glob("log/*/metrics.csv"), key=lambda file: file.stat().st_mtime)
    )


def read_validations(folder: Path, score: str) -> list[tuple[int, float, float]]:
    """Step, time since the start [s], NaN if unknown, and mean score of each validation in a run's
    log.
    """
    curves = read_log(folder)
    seconds = dict(zip(*curves.get("seconds", ((), ())), strict=True))
    found = zip(*curves.get(f"validation/{score}", ((), ())), strict=True)
    return [(int(step), float(seconds.get(step, math.nan)), float(value)) for step, value in found]


def loss_curves(curves: Mapping[str, tuple[ndarray, ndarray]]) -> Figure:
    """Training loss with its terms (``train/...``), penalties and validation scores against steps,
    a panel each.
    """
    titles = {
        "train": "loss and its terms",
        "penalty": "penalties, unweighted",
        "validation": "validation score",
    }
    panels = {
        group: {
            name.removeprefix(f"{group}/"): curve
            for name, curve in curves.items()
            if name.startswith(f"{group}/")
        }
        for group in titles
    }
    panels = {
        group: dict(sorted(names.items(), key=lambda name: name[0] != "loss"))
        for group, names in panels.items()
    }
    panels = {group: names for group, names in panels.items() if names}
    with rc_context(STYLE):
        figure = Figure(figsize=(min(COLUMN * len(panels), PAGE), 2.6), layout="constrained")
        for ax, (group, names) in zip(
            figure.subplots(1, len(panels), squeeze=False)[0], panels.items(), strict=True
        ):
            for (name, curve), (colour, dash) in zip(names.items(), cycle(LINES), strict=False):
                _draw_smoothed(ax, *curve, color=colour, linestyle=dash, label=name)
            ax.set(xlabel="step", title=titles[group])
            ax.grid()
            ax.legend()
            if group != "validation" and any((values > 0).any() for _, values in names.values()):
                ax.set_yscale("log")
                _round_ticks(ax, (1, 2, 5))
    return figure


def speed_against_error(
    names: Sequence[str],
    scores: Float[ndarray, " runs"],
    times: Mapping[str, Float[ndarray, " runs"]],
    score_label: str,
    baselines: Mapping[str, float],
    models: Sequence[str] = (),
) -> Figure:
    """Score of each run against each kind of time, one panel a kind; NaN if a time is unknown.

    The baselines' scores are horizontal lines, named by their model first. Runs of several models,
    one a run, have the models' colours.
    """
    systems = looks(dict.fromkeys([*models, *(name.partition(" ")[0] for name in baselines)]))
    with rc_context(STYLE):
        key_columns = 1 if max(map(len, names)) > 55 else 2  # letters that fit half a page
        key_rows = (len(names) + len(baselines) + 1) // key_columns
        figure = Figure(figsize=(PAGE, 2.4 + 0.15 * key_rows), layout="constrained")
        axes = figure.subplots(1, len(times), sharey=True, squeeze=False)[0]
        for ax, (label, values) in zip(axes, times.items(), strict=True):
            for run, (name, look) in enumerate(zip(names, cycle(MARKERS), strict=False)):
                if len({*models}) > 1:
                    look = look | {"color": systems[models[run]][0], "marker": "os^DvP*X"[run % 8]}
                ax.plot(values[run], scores[run], linestyle="", markersize=5, label=name, **look)
            for name, score in baselines.items():
                colour, dash = systems[name.partition(" ")[0]]
                ax.axhline(score, color=colour, linestyle=dash, linewidth=0.9, zorder=0, label=name)
            ax.set_xlabel(label)
            ax.grid()
            known = values[np.isfinite(values)]
            if len(known) and 0 < 10 * known.min() < known.max():
                ax.set_xscale("log")
                ticks = LogLocator(subs=(1, 2, 5))
                ax.xaxis.set(
                    major_locator=ticks, major_formatter="{x:g}", minor_locator=NullLocator()
                )
        axes[0].set_ylabel(score_label)
        figure.legend(
            *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=key_columns
        )
    return figure


def learning_curves(
    curves: Mapping[str, Sequence], baselines: Mapping[str, float], score: Metric
) -> Figure:
    """Validation scores over the time of training [s], both by system; baselines are horizontal
    lines.

    Errors have a logarithmic axis, so that large ones at the start leave space for small ones.
    """
    with rc_context(STYLE):
        key_rows = (len(curves) + len(baselines) + 3) // 4
        figure = Figure(figsize=(PAGE, 3.0 + 0.15 * key_rows), layout="constrained")
        ax = figure.subplots()
        systems = looks([*curves, *baselines])
        for name, (times, scores) in curves.items():
            colour, dash = systems[name]
            ax.plot(
                times, scores, marker=".", markersize=4, color=colour, linestyle=dash, label=name
            )
        for name, value in baselines.items():
            colour, dash = systems[name]
            ax.axhline(value, color=colour, linestyle=dash, linewidth=0.7, zorder=0, label=name)
        ax.set(xlabel="training [s]", ylabel=f"{score.title}, validation")
        if not score.higher_is_better and all(
            value > 0 for line in ax.lines for value in line.get_ydata()
        ):
            ax.set_yscale("log")
            _round_ticks(ax, (1, 2, 3, 4, 5, 6, 8))
        ax.grid()
        figure.legend(loc="outside lower center", ncols=4)
    return figure


def _round_ticks(ax: Axes, steps: Sequence[int]) -> None:
    """Ticks of a logarithmic axis at these multiples of powers of ten, as plain numbers."""
    ax.yaxis.set(
        major_locator=LogLocator(subs=steps), major_formatter="{x:g}", minor_locator=NullLocator()
    )


def _draw_smoothed(ax: Axes, steps, values, **line) -> None:
    """A running mean over a fiftieth of the points, drawn over the points."""
    window = max(1, len(values) // 50)
    if window > 1:
        ax.plot(steps, values, color=line["color"], alpha=0.2, linewidth=0.5)
    mean = np.convolve(values, np.full(window, 1 / window), "valid")
    if len(values) <= 30:
        line["marker"] = "."
    ax.plot(steps[(window - 1) // 2 :][: len(mean)], mean, **line)
