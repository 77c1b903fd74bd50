"""Figures of error against time."""

from collections.abc import Mapping, Sequence

from matplotlib import rc_context
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from gaigs.benchmark._page import best
from gaigs.report.style import MARKERS, PAGE, STYLE

Points = Mapping[str, Sequence[tuple[float, float]]]
"""(time, error) of each setting, by the component's name."""


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
