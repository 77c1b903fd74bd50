"""Curves: distributions of scores, losses and scores during training, scores over times."""

import math
from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator
from numpy import ndarray

from gaigs.core.task import Metric
from gaigs.report.style import (
    COLUMN,
    LINES,
    MARKERS,
    OTHERS,
    PAGE,
    STYLE,
    ask,
    distinct_looks,
    looks,
    named_ones,
    new_figure,
    wrapped,
)
from gaigs.report.training_log import Curve


def cdf(
    values: Mapping[str, Float[ndarray, " t"]],
    quantity: str,
    samples: str,
    split: str,
    limits: tuple[float | None, float | None],
    higher_is_better: bool = False,
) -> Figure:
    """A figure of the cumulative distribution of a score, see ``draw_cdf``, with a legend."""
    with rc_context(STYLE):
        figure = new_figure(COLUMN, COLUMN)
        ax = figure.subplots()
        draw_cdf(ax, values, quantity, samples, limits, higher_is_better)
        _, labels = ax.get_legend_handles_labels()
        # Columns of the legend by the letters of the longest label.
        longest = max(map(len, labels))
        columns = 3 if longest <= 17 else 2 if longest <= 25 else 1
        figure.set_figheight(2.75 + 0.15 * math.ceil(len(labels) / columns))
        key = {"ncols": columns, "handlelength": 2.4, "columnspacing": 1.2}
        figure.legend(loc="outside lower center", title=f"median {quantity}, best first", **key)
        question = "How good are predictions?" if higher_is_better else "How large are errors?"
        ask(figure, question, wrapped(f"split {split}", 70))
    return figure


def draw_cdf(
    ax: Axes,
    values: Mapping[str, Float[ndarray, " t"]],
    quantity: str,
    samples: str,
    limits: tuple[float | None, float | None],
    higher_is_better: bool = False,
) -> None:
    """Draws the cumulative distribution of a score, a curve for each model with its median.

    The run's model and the best others are coloured, see ``named_ones``; the others are grey.

    Args:
        ax: Axes for the curves.
        values: Values of every test sample by model, the run's model first.
        quantity: Name of the values, with their unit.
        samples: Name of the samples, e.g. "links".
        limits: Ends of the axis of values; None: the range of the data.
        higher_is_better: True for similarities.
    """
    medians = {name: float(np.median(scores)) for name, scores in values.items()}
    own = next(iter(values))
    named = named_ones(medians, higher_is_better, own)
    systems = distinct_looks(named, values)
    ax.axhline(0.5, color="0.75", linewidth=0.6, zorder=0)
    for name in named:
        colour, dash = systems[name]
        look = {"color": colour, "linestyle": dash, "zorder": 2.5 if name == own else 2}
        ax.ecdf(values[name], label=f"{name} {medians[name]:#.3g}", **look)
        edge = {"markeredgecolor": "white", "markeredgewidth": 0.6}
        ax.plot(medians[name], 0.5, "o", color=colour, markersize=4, **edge)
    others = sorted({medians[name] for name in medians if name not in named})
    for name in values:
        if name not in named:
            ax.ecdf(values[name], **OTHERS)
    if others:
        span = f"{others[0]:#.3g} to {others[-1]:#.3g}"
        ax.plot([], [], label=f"{len(values) - len(named)} others {span}", **OTHERS)
    count = len(values[own])
    ax.set(xlabel=quantity, ylabel=f"share of {count:,} test {samples}", ylim=(0, 1.01))
    ax.set_xlim(*limits)
    ax.grid(axis="x")


def plot_scores(result: Any, ax: Any = None, metric: str | None = None) -> Any:
    """Draws the distribution of a score over the test links, by model.

    Args:
        result: An ``Evaluation``.
        ax: Axes; None: a new figure.
        metric: Name of the score, a key of ``result.scores``; None: the main one.
    """
    name = result.task.compared_by if metric is None else metric
    values = {model: scores.get(name) for model, scores in result.scores.items()}
    known = {model: scores.numpy() for model, scores in values.items() if scores is not None}
    if not known:
        names = ", ".join(next(iter(result.scores.values())))
        raise ValueError(f"metric must be a score of the links, got {name!r}\nthere are {names}")
    arguments = known, _score_title(name), "links"
    limits = (None, None)
    if ax is None:
        return cdf(*arguments, result.split, limits, result.task.higher_is_better).axes
    draw_cdf(ax, *arguments, limits, result.task.higher_is_better)
    ax.legend()
    return ax


def loss_curves(curves: Mapping[str, Curve]) -> Figure:
    """Loss with its terms, penalties, and each validation score over steps, a panel each.

    Names of curves start with ``train/``, ``penalty/`` or ``validation/``.
    """
    panels = {}
    for group, title in (("train", "loss and its terms"), ("penalty", "penalties, unweighted")):
        if of_group := _of_group(curves, group):
            panels[title] = of_group
    # Scores have units of their own.
    for name, curve in _of_group(curves, "validation").items():
        panels[f"validation {_score_title(name)}"] = {name: curve}
    columns = min(len(panels), 3)
    rows = math.ceil(len(panels) / columns)
    with rc_context(STYLE):
        figure = new_figure(min(COLUMN * columns, PAGE), 2.4 * rows + 0.3)
        axes = [*figure.subplots(rows, columns, squeeze=False).flat]
        for ax in axes[len(panels) :]:
            ax.remove()
        for ax, (title, curves_here) in zip(axes, panels.items(), strict=False):
            # The largest terms have a colour and a name.
            sizes = {name: float(abs(values).mean()) for name, (_, values) in curves_here.items()}
            named = named_ones(sizes, True, next(iter(curves_here)))
            for name, curve in curves_here.items():
                look = OTHERS
                if name in named:
                    colour, dash = LINES[named.index(name)]
                    look = {"color": colour, "linestyle": dash, "label": name}
                _draw_smoothed(ax, *curve, **look)
            ax.set(xlabel="step", title=title)
            ax.grid()
            if len(curves_here) > 1:
                ax.legend()
            is_score = title.startswith("validation")
            if not is_score and any((values > 0).any() for _, values in curves_here.values()):
                ax.set_yscale("log")
                _round_ticks(ax.yaxis, (1, 2, 5))
        ask(figure, "Has the training settled?")
    return figure


def _score_title(name: str) -> str:
    """The title of a logged score, such as "MAE [dB]" for ``mae_db``."""
    first, *others = name.removesuffix("_db").split("_")
    return " ".join([first.upper(), *others]) + " [dB]" * name.endswith("_db")


def _of_group(curves: Mapping[str, Curve], group: str) -> dict[str, Curve]:
    """Curves whose names start with ``<group>/``, by the rest of the name, the loss first."""
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
    """Score of each run against its times, a panel for each kind of time.

    Args:
        names: Name of each run.
        scores: Score of each run.
        times: Times of the runs by kind, NaN if unknown. A kind without values, such as the
            training of look-ups, has no panel.
        score_label: Name of the score with its unit.
        baselines: Scores of baselines, drawn as horizontal lines; each name starts with its model's
            name.
        models: Model of each run, for colours; empty for a single colour.
    """
    known_times = {kind: values for kind, values in times.items() if np.isfinite(values).any()}
    times = known_times or times
    systems = looks(dict.fromkeys([*models, *(name.partition(" ")[0] for name in baselines)]))
    key_columns = 1 if max(map(len, names)) > 55 else 2  # letters that fit half a page
    key_rows = (len(names) + len(baselines) + 1) // key_columns
    with rc_context(STYLE):
        figure = new_figure(PAGE, 2.6 + 0.15 * key_rows)
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
        ask(figure, "Which run is good for its time?")
    return figure


def learning_curves(
    curves: Mapping[str, Sequence], baselines: Mapping[str, float], score: Metric
) -> Figure:
    """Validation scores over the time of training [s], by system; baselines are horizontal.

    The axis of errors is logarithmic, so that large errors at the start do not hide small ones.
    """
    last = {name: float(scores[-1]) for name, (_, scores) in curves.items()}
    named = named_ones(last, score.higher_is_better)
    key_rows = (len(named) + len(baselines) + 4) // 4
    with rc_context(STYLE):
        figure = new_figure(PAGE, 3.2 + 0.15 * key_rows)
        ax = figure.subplots()
        systems = distinct_looks(named, [*curves, *baselines])
        for name in named:
            times, scores = curves[name]
            colour, dash = systems[name]
            look = {"marker": ".", "markersize": 4, "color": colour, "linestyle": dash}
            ax.plot(times, scores, label=name, **look)
        for name, (times, scores) in curves.items():
            if name not in named:
                ax.plot(times, scores, **OTHERS)
        if len(named) < len(curves):
            ax.plot([], [], label=f"{len(curves) - len(named)} others", **OTHERS)
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
        ask(figure, "How fast does each system learn?")
    return figure


def _round_ticks(axis: Axis, steps: Sequence[int]) -> None:
    """Sets ticks of a logarithmic axis to ``steps`` times powers of ten, as plain numbers."""
    axis.set(
        major_locator=LogLocator(subs=steps), major_formatter="{x:g}", minor_locator=NullLocator()
    )


def _draw_smoothed(ax: Axes, steps: ndarray, values: ndarray, **line) -> None:
    """Draws points and their running mean over a fiftieth of the points."""
    window = max(1, len(values) // 50)
    if window > 1:
        ax.plot(steps, values, color=line["color"], alpha=0.2, linewidth=0.5)
    mean = np.convolve(values, np.full(window, 1 / window), "valid")
    if len(values) <= 30:
        line["marker"] = "."
    # The mean over a window is drawn at the window's middle.
    middle = (window - 1) // 2
    ax.plot(steps[middle : middle + len(mean)], mean, **line)
