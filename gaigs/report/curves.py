"""Curves: distributions of scores, losses and scores over a training, scores against times."""

import math
from collections.abc import Mapping, Sequence
from itertools import cycle

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from numpy import ndarray

from gaigs.core.task import Metric
from gaigs.report.style import COLUMN, LINES, MARKERS, PAGE, STYLE, looks, wrapped
from gaigs.report.training_log import Curve


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
        limits: Ends of the axis of values; None for the ends of the data.
    """
    # Columns of the legend by the letters of the longest name.
    longest = max(map(len, values))
    columns = 3 if longest <= 12 else 2 if longest <= 20 else 1
    height = 2.45 + 0.15 * math.ceil(len(values) / columns)
    with rc_context(STYLE):
        figure = Figure(figsize=(COLUMN, height), layout="constrained")
        ax = figure.subplots()
        ax.axhline(0.5, color="0.75", linewidth=0.6, zorder=0)
        for name, (colour, dash) in looks(values).items():
            median = float(np.median(values[name]))
            ax.ecdf(
                values[name],
                color=colour,
                linestyle=dash,
                zorder=2.5 if name == next(iter(values)) else 2,
                label=f"{name} {median:#.3g}",
            )
            edge = {"markeredgecolor": "white", "markeredgewidth": 0.6}
            ax.plot(median, 0.5, "o", color=colour, markersize=4, **edge)
        ax.set(
            xlabel=wrapped(f"{quantity}, split {split}"),
            ylabel=f"share of test {samples}",
            ylim=(0, 1.01),
        )
        ax.set_xlim(*limits)
        key = {"ncols": columns, "handlelength": 2.4, "columnspacing": 1.2}
        figure.legend(loc="outside upper center", title=f"median {quantity}", **key)
        ax.grid(axis="x")
    return figure


def loss_curves(curves: Mapping[str, Curve]) -> Figure:
    """Loss with its terms, penalties and validation scores against steps, a panel each.

    Names of curves begin with ``train/``, ``penalty/`` or ``validation/``.
    """
    titles = {
        "train": "loss and its terms",
        "penalty": "penalties, unweighted",
        "validation": "validation score",
    }
    panels = {group: _of_group(curves, group) for group in titles}
    panels = {group: names for group, names in panels.items() if names}
    with rc_context(STYLE):
        figure = Figure(figsize=(min(COLUMN * len(panels), PAGE), 2.6), layout="constrained")
        axes = figure.subplots(1, len(panels), squeeze=False)[0]
        for ax, (group, names) in zip(axes, panels.items(), strict=True):
            for (name, curve), (colour, dash) in zip(names.items(), cycle(LINES), strict=False):
                _draw_smoothed(ax, *curve, color=colour, linestyle=dash, label=name)
            ax.set(xlabel="step", title=titles[group])
            ax.grid()
            ax.legend()
            if group != "validation" and any((values > 0).any() for _, values in names.values()):
                ax.set_yscale("log")
                _round_ticks(ax.yaxis, (1, 2, 5))
    return figure


def _of_group(curves: Mapping[str, Curve], group: str) -> dict[str, Curve]:
    """Curves whose names begin with a group, without it; the loss comes first."""
    start = f"{group}/"
    names = [name.removeprefix(start) for name in curves if name.startswith(start)]
    names.sort(key=lambda name: name != "loss")
    return {name: curves[f"{start}{name}"] for name in names}


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
    key_columns = 1 if max(map(len, names)) > 55 else 2  # letters that fit half a page
    key_rows = (len(names) + len(baselines) + 1) // key_columns
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, 2.4 + 0.15 * key_rows), layout="constrained")
        axes = figure.subplots(1, len(times), sharey=True, squeeze=False)[0]
        for ax, (label, values) in zip(axes, times.items(), strict=True):
            for run, (name, look) in enumerate(zip(names, cycle(MARKERS), strict=False)):
                if len({*models}) > 1:
                    colour, _ = systems[models[run]]
                    look = look | {"color": colour, "marker": "os^DvP*X"[run % 8]}
                ax.plot(values[run], scores[run], linestyle="", markersize=5, label=name, **look)
            for name, score in baselines.items():
                colour, dash = systems[name.partition(" ")[0]]
                ax.axhline(score, color=colour, linestyle=dash, linewidth=0.9, zorder=0, label=name)
            ax.set_xlabel(label)
            ax.grid()
            known = values[np.isfinite(values)]
            if len(known) and 0 < 10 * known.min() < known.max():
                ax.set_xscale("log")
                _round_ticks(ax.xaxis, (1, 2, 5))
        axes[0].set_ylabel(score_label)
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=key_columns)
    return figure


def learning_curves(
    curves: Mapping[str, Sequence], baselines: Mapping[str, float], score: Metric
) -> Figure:
    """Validation scores over the time of training [s], both by system; baselines are horizontal
    lines.

    Errors have a logarithmic axis, so that large ones at the start leave space for small ones.
    """
    key_rows = (len(curves) + len(baselines) + 3) // 4
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, 3.0 + 0.15 * key_rows), layout="constrained")
        ax = figure.subplots()
        systems = looks([*curves, *baselines])
        for name, (times, scores) in curves.items():
            colour, dash = systems[name]
            look = {"marker": ".", "markersize": 4, "color": colour, "linestyle": dash}
            ax.plot(times, scores, label=name, **look)
        for name, value in baselines.items():
            colour, dash = systems[name]
            ax.axhline(value, color=colour, linestyle=dash, linewidth=0.7, zorder=0, label=name)
        ax.set(xlabel="training [s]", ylabel=f"{score.title}, validation")
        is_positive = [np.all(np.greater(line.get_ydata(), 0)) for line in ax.lines]
        if not score.higher_is_better and all(is_positive):
            ax.set_yscale("log")
            _round_ticks(ax.yaxis, (1, 2, 3, 4, 5, 6, 8))
        ax.grid()
        figure.legend(loc="outside lower center", ncols=4)
    return figure


def _round_ticks(axis: Axis, steps: Sequence[int]) -> None:
    """Ticks of a logarithmic axis at these multiples of powers of ten, as plain numbers."""
    axis.set(
        major_locator=LogLocator(subs=steps), major_formatter="{x:g}", minor_locator=NullLocator()
    )


def _draw_smoothed(ax: Axes, steps: ndarray, values: ndarray, **line) -> None:
    """A running mean over a fiftieth of the points, drawn over the points."""
    window = max(1, len(values) // 50)
    if window > 1:
        ax.plot(steps, values, color=line["color"], alpha=0.2, linewidth=0.5)
    mean = np.convolve(values, np.full(window, 1 / window), "valid")
    if len(values) <= 30:
        line["marker"] = "."
    # The mean over a window stands at the window's middle.
    ax.plot(steps[(window - 1) // 2 :][: len(mean)], mean, **line)
