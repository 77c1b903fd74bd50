"""What accuracy costs: errors against times or sizes on logarithmic axes, and who is beaten by nobody."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from math import ceil

import numpy as np
from jaxtyping import Float
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter, NullLocator
from numpy import ndarray
from scipy.optimize import isotonic_regression

from gaigs.benchmark._page import best
from gaigs.report.style import LINES, MARKERS, PAGE, STYLE

Curve = tuple[Float[ndarray, "k"], Float[ndarray, "k"]]
"""Costs and errors in the order of the costs."""

Points = Mapping[str, Sequence[tuple[float, float]]]
"""(time, error) of each setting, by the component's name."""

FRONT = {"color": "0.8", "linewidth": 5, "solid_capstyle": "butt", "zorder": 0}
"""The look of a front: a wide band below everything else."""

KEY = {"markersize": 5, "markerfacecolor": "white", "markeredgecolor": "0.15", "markeredgewidth": 0.7}
"""The look of a point in the key."""

SHAPES = {"circle": "o", "square": "s", "diamond": "D", "triangle": "^"}
"""Markers of groups, by what a reader calls them."""

COLUMNS = 3
"""Most panels beside each other."""


def best_so_far(curve: Curve) -> Curve:
    """A curve of which each error is the least up to there: what a training that keeps its best has reached."""
    costs, errors = (np.asarray(values, float) for values in curve)
    order = np.argsort(costs, kind="stable")
    return costs[order], np.minimum.accumulate(errors[order])


def errors_over_time(panels: Mapping[str, Mapping[str, Curve]], error: str, references: Mapping[str, float]) -> Figure:
    """Least validation error so far against seconds of training, one line a variant, its name at its end.

    The band below the lines is the front of all variants of a panel: the least error that any of them had reached by
    then.

    Args:
        panels: Curves by variant, by the panel's title; a panel alone takes the page.
        error: What an error is, with its unit.
        references: Errors without a training, drawn as dotted lines over all times.
    """
    columns = min(len(panels), COLUMNS)
    rows = ceil(len(panels) / columns)
    longest = max(map(len, panels.values()))
    height = max(2.3, 0.4 + 0.155 * (longest + len(references)))
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, rows * height), layout="constrained")
        axes = list(figure.subplots(rows, columns, squeeze=False).flat)
        for ax in axes[len(panels) :]:
            ax.remove()
        for number, (ax, (title, curves)) in enumerate(zip(axes, panels.items(), strict=False)):
            _draw_curves(ax, {name: best_so_far(curve) for name, curve in curves.items()}, references)
            ax.set(title=title, xlabel="training [s]" if number + columns >= len(panels) else "")
            if number % columns == 0:
                ax.set_ylabel(f"{error}, validation")
    return figure


def _draw_curves(ax: Axes, curves: Mapping[str, Curve], references: Mapping[str, float]) -> None:
    ax.set(xscale="log", yscale="log")
    costs, errors = (np.concatenate(parts) for parts in zip(*curves.values(), strict=True))
    front = best([*zip(costs, errors, strict=True)])
    ax.plot(*zip(*front, (costs.max(), front[-1][1]), strict=True), drawstyle="steps-post", **FRONT)
    ends = {}
    for (name, (x, y)), (colour, dash) in zip(curves.items(), cycle(LINES), strict=False):
        ax.plot(x, y, color=colour, linestyle=dash, marker=".", markersize=3, label=name)
        ends[name] = x[-1], y[-1], colour
    for name, level in references.items():
        ax.axhline(level, color="0.45", linestyle=(0, (1, 2)), linewidth=0.9, zorder=1, label=name)
        ends[name] = costs.max(), level, "0.35"
    _round_ticks(ax)
    _name_ends(ax, ends)
    ax.grid()


def _name_ends(ax: Axes, ends: Mapping[str, tuple[float, float, str]]) -> None:
    """Writes names to the right of an axis, each as near to the end of its line as the others leave room."""
    bottom, top = np.log(ax.get_ylim())
    names = sorted(ends, key=lambda name: ends[name][1])
    heights = (np.log([ends[name][1] for name in names]) - bottom) / (top - bottom)
    inches = ax.figure.get_size_inches()[1] / ax.get_subplotspec().get_gridspec().nrows - 0.6
    for name, height in zip(names, _apart(heights, 0.125 / inches), strict=True):
        x, y, colour = ends[name]
        look = {"arrowstyle": "-", "color": colour, "linewidth": 0.5, "relpos": (0, 0.5), "shrinkA": 0, "shrinkB": 1}
        place = {"xytext": (1.04, height), "textcoords": "axes fraction", "va": "center"}
        ax.annotate(name, (x, y), **place, fontsize=6.5, arrowprops=look)


def _apart(places: Float[ndarray, "k"], gap: float) -> Float[ndarray, "k"]:
    """Rising places moved as little as need be for them to be at least so far apart, about within 0..1."""
    # Less the gaps before them they have to rise only.
    steps = gap * np.arange(len(places))
    moved = isotonic_regression(places - steps).x + steps
    return moved + max(0.0, -moved[0]) - max(0.0, moved[-1] - 1)


def errors_against_costs(
    groups: Mapping[str, Sequence[str]],
    errors: Mapping[str, float],
    costs: Mapping[str, Mapping[str, float]],
    error: str,
) -> Figure:
    """Test error against what it costs, one numbered point a variant, one panel a cost; the key is below.

    Points on the front, beaten by no other in both, are filled and joined by a band.

    Args:
        groups: Variants by what they are, each group with a marker of its own: at most four.
        errors: By variant.
        costs: By variant, by the label of the axis; a variant without that cost is left out of its panel.
        error: What an error is, with its unit.
    """
    names = list(dict.fromkeys(name for group in groups.values() for name in group))
    looks = {name: marker for group, marker in zip(groups.values(), SHAPES.values(), strict=False) for name in group}
    told = "; ".join(f"{shape}: {group}" for group, shape in zip(groups, SHAPES, strict=False))
    rows = ceil(len(names) / 4)
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, 3.2 + 0.14 * rows + 0.2), layout="constrained")
        axes = figure.subplots(1, len(costs), sharey=True, squeeze=False)[0]
        for ax, (label, known) in zip(axes, costs.items(), strict=True):
            ax.set(xscale="log", yscale="log", xlabel=label)
            shown = [name for name in names if name in known]
            front = best([(known[name], errors[name]) for name in shown])
            ax.plot(*zip(*front, strict=True), drawstyle="steps-post", **FRONT)
            for name in shown:
                point = known[name], errors[name]
                is_best = point in front
                face, ink = ("0.15", "white") if is_best else ("white", "0.15")
                look = {"marker": looks[name], "markersize": 9, "markerfacecolor": face, "markeredgecolor": "0.15"}
                ax.plot(*point, linestyle="", markeredgewidth=0.7, zorder=4 if is_best else 3, **look)
                number = str(names.index(name) + 1)
                place = {"ha": "center", "va": "center_baseline", "fontsize": 5.5, "zorder": 5 if is_best else 3}
                ax.annotate(number, point, color=ink, **place)
            _round_ticks(ax)
            ax.grid()
        axes[0].set_ylabel(f"{error}, test")
        handles = [axes[0].plot([], [], linestyle="", marker=looks[name], **KEY)[0] for name in names]
        numbered = [f"{number} {name}" for number, name in enumerate(names, 1)]
        key = {"ncols": 4, "handletextpad": 0.2, "title": f"{told}; filled: none is better in both"}
        figure.legend(handles, numbered, loc="outside lower center", **key)
    return figure


def _round_ticks(ax: Axes) -> None:
    """Ticks at round numbers, written plainly; more of them at errors, which seldom span a decade."""
    for axis, subs in ((ax.xaxis, (1, 2, 5)), (ax.yaxis, (1, 2, 3, 5, 7))):
        axis.set(major_locator=LogLocator(subs=subs), minor_locator=NullLocator())
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def pareto(panels: Mapping[str, Points], time: str, error: str) -> Figure:
    """Error against time, both logarithmic; the settings that none beats in both are joined by a line.

    Args:
        panels: Points by title.
        time, error: Labels of the axes, with units.
    """
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, 2.5), layout="constrained")
        axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
        names = [*dict.fromkeys(name for points in panels.values() for name in points)]
        looks = {name: MARKERS[6 * i % len(MARKERS)] for i, name in enumerate(names)}  # in marker and colour
        for ax, (title, points) in zip(axes, panels.items(), strict=True):
            for name, found in points.items():
                ax.plot(*zip(*found, strict=True), linestyle="", markersize=5, label=name, **looks[name])
            front = best([point for found in points.values() for point in found])
            ax.plot(*zip(*front, strict=True), color="0.45", linewidth=0.9, zorder=0, label="none is better in both")
            ax.set(title=title, xscale="log", yscale="log")
            times = [time for found in points.values() for time, _ in found]
            subs = (1, 2, 5) if max(times) < 30 * min(times) else (1,)
            ax.xaxis.set(major_locator=LogLocator(subs=subs), major_formatter="{x:g}", minor_formatter=NullFormatter())
            ax.grid()
        axes[0].set_ylabel(error)
        figure.supxlabel(time, fontsize=8)
        labels = {}
        for ax in axes:
            labels |= {label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
        figure.legend(labels.values(), labels.keys(), loc="outside upper center", ncols=min(len(labels), 5))
    return figure
