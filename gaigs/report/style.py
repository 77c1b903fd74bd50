"""The look of all figures: sizes for a printed page, colours for colour-blind readers and grey print."""

import math
from pathlib import Path

from matplotlib.figure import Figure

from gaigs.io.files import atomic_write

COLUMN, PAGE = 3.5, 7.16
"""Widths of one column and of a page of two columns [inch]."""

DPI = 200
"""Pixels per inch of the files."""

STYLE = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "legend.frameon": False,
    "axes.linewidth": 0.6,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "0.88",
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.3,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
}

BLUE, ORANGE, GREEN, PURPLE, SKY, GREY = "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#6E6E6E"

COLOURS = (BLUE, GREY, ORANGE, GREEN, PURPLE, SKY)

DASHES = ("-", "--", "-.", ":", (0, (7, 2)), (0, (4, 1, 1, 1, 1, 1)))

LINES = tuple((COLOURS[i], DASHES[(i + shift) % 6]) for shift in range(6) for i in range(6))
"""Colour and dash of the first, second, ... line, no two of 36 alike; the run's own model comes first, and unbroken."""

MARKERS = tuple(
    {"marker": marker, "color": colour, "markeredgecolor": "white", "markeredgewidth": 0.5}
    for marker in "os^Dv"
    for colour in (BLUE, ORANGE, GREEN, PURPLE, SKY)
)
"""Looks of the points of up to 25 runs."""


def save(figure: Figure, file: Path) -> None:
    """Writes a figure as PNG."""
    with atomic_write(file) as part:
        figure.savefig(part, dpi=DPI)


def round_step(span: float, most: int) -> float:
    """The smallest step, 1, 2 or 5 times a power of ten, that covers a span above 0 by at most ``most`` steps."""
    least = span / most
    power = 10.0 ** math.floor(math.log10(least))
    return next((step * power for step in (1, 2, 5) if step * power >= least), 10 * power)
