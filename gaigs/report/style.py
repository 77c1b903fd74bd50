"""The look of all figures: sizes for a printed page, colours for colour-blind readers and grey
print.
"""

import math
from collections.abc import Iterable
from functools import cache
from pathlib import Path
from zlib import crc32

import yaml
from matplotlib import rc_context
from matplotlib.figure import Figure

from gaigs.configuration import conf_dir
from gaigs.io.files import atomic_write
from gaigs.report.formats import chosen

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
    "pdf.fonttype": 42,  # fonts that editors and publishers can use
}

BLUE, ORANGE, GREEN, PURPLE, SKY, GREY = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#CC79A7",
    "#56B4E9",
    "#6E6E6E",
)

COLOURS = (BLUE, GREY, ORANGE, GREEN, PURPLE, SKY)

DASHES = ("-", "--", "-.", ":", (0, (7, 2)), (0, (4, 1, 1, 1, 1, 1)))

LINES = tuple((COLOURS[i], DASHES[(i + shift) % 6]) for shift in range(6) for i in range(6))
"""Colour and dash of the first, second, ... line, no two of 36 alike."""

PLACED = {
    "gaigs": 0, "mirrored": 26, "mean": 1, "knn": 3, "gaussian_process": 4, "path_loss": 5, "friis": 17,
    "nearest_frequency": 7,
}  # fmt: skip
"""Lines of built-in models, our two predictors unbroken; systems of ``conf/published.yaml`` have
the next free ones.
"""

MARKERS = tuple(
    {"marker": marker, "color": colour, "markeredgecolor": "white", "markeredgewidth": 0.5}
    for marker in "os^Dv"
    for colour in (BLUE, ORANGE, GREEN, PURPLE, SKY)
)
"""Looks of the points of up to 25 runs."""


def save(figure: Figure, file: Path) -> list[Path]:
    """Writes a figure in the formats of ``figure_formats``, with their endings; returns the files."""
    files = [file.with_suffix(f".{ending}") for ending in chosen.get()]
    for file in files:
        with atomic_write(file) as part, rc_context(STYLE):
            figure.savefig(part, dpi=DPI)
    return files


def looks(systems: Iterable[str]) -> dict[str, tuple]:
    """Colour and dash of systems by name, the same in all figures and different in one of 36 or
    fewer.

    A baseline looks as the system of its name. A model without its kriging has the model's colour,
    and dots.
    """
    placed, titles = _places()
    names = {name: name.removesuffix(" (baseline)").removesuffix("_trend") for name in systems}
    models = {name: titles.get(base, base) for name, base in names.items()}
    for (
        name,
        model,
    ) in models.items():  # the first variant of a system, such as "GAI-GS split=blocks"
        own = next(
            (known for title, known in titles.items() if model.startswith(f"{title} ")), model
        )
        models[name] = model if own in models.values() else own
    known = {*placed.values()}
    taken = {placed[model] for model in models.values() if model in placed}
    found = {}
    for name, model in models.items():
        if model not in placed:
            turn = crc32(model.encode()) % len(LINES)
            places = [*range(turn, len(LINES)), *range(turn)]
            places.sort(
                key=lambda place: (place in taken, place in known)
            )  # where no known system is, if possible
            place = places[0]
            taken.add(place)
            placed = placed | {model: place}
        colour, dash = LINES[placed[model]]
        found[name] = colour, ":" if name.endswith("_trend") else dash
    return found


@cache
def _places() -> tuple[dict[str, int], dict[str, str]]:
    """Numbers of known systems in ``LINES``, and the models of titles."""
    titles = yaml.safe_load((conf_dir() / "published.yaml").read_text(encoding="utf-8"))["names"]
    free = (place for place in range(len(LINES)) if place not in PLACED.values())
    return PLACED | {name: next(free) for name in titles if name not in PLACED}, {
        t: name for name, t in titles.items()
    }


def round_step(span: float, most: int) -> float:
    """The smallest step, 1, 2 or 5 times a power of ten, that covers a span above 0 by at most
    ``most`` steps.
    """
    least = span / most
    power = 10.0 ** math.floor(math.log10(least))
    return next((step * power for step in (1, 2, 5) if step * power >= least), 10 * power)
