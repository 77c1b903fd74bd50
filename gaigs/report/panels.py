"""One panel a receiver, as many on a page as can be read."""

from collections.abc import Mapping, Sequence
from math import ceil

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gaigs.report.style import PAGE

PANELS = 6
"""Most panels of one figure."""


def pages(count: int) -> list[range]:
    """The panels of each figure."""
    return [range(first, min(first + PANELS, count)) for first in range(0, count, PANELS)]


def panels(count: int, width: float, height: float, xlabel: str, ylabel: str) -> tuple[Figure, list[Axes]]:
    """Panels with common axes, as large as a page allows, and room for a colour bar, titles and a legend.

    Args:
        count: Panels of the figure.
        width, height: Of what a panel shows, in one unit.
        xlabel, ylabel: Of the outer panels.
    """
    bar, title, foot = 1.5, 0.25, 0.65  # inches beside all, above each and below all
    scale = lambda columns: min((PAGE - bar) / (columns * width), 5.6 / (ceil(count / columns) * height), 3 / height)
    columns = max(range(1, count + 1), key=scale)
    rows, inches = ceil(count / columns), scale(columns)
    size = columns * width * inches + bar, rows * (height * inches + title) + foot
    figure = Figure(figsize=size, layout="compressed")
    axes = list(figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat)
    for ax in axes[count:]:
        ax.remove()
    for index, ax in enumerate(axes[:count]):
        if index % columns == 0:
            ax.set_ylabel(ylabel)
        if index + columns >= count:  # nothing below it
            ax.set_xlabel(xlabel)
            ax.tick_params(labelbottom=True)
    return figure, axes[:count]


def numbered(paged: Mapping[str, Sequence[Figure]]) -> dict[str, Figure]:
    """The figures of each name by file name: the name itself for the first, name_2, name_3, ... for the others."""
    return {
        name if page == 1 else f"{name}_{page}": figure
        for name, figures in paged.items()
        for page, figure in enumerate(figures, 1)
    }
