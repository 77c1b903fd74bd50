"""The look of all figures: sizes for print, colours for colour-blind readers and grey print."""

import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from pathlib import Path
from zlib import crc32

import yaml
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gaigs.configuration import conf_dir
from gaigs.io.files import atomic_write
from gaigs.report.formats import chosen

COLUMN = 3.5
"""Width of one column [inch]."""

PAGE = 7.16
"""Width of a page of two columns [inch]."""

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

BLUE = "#0072B2"
ORANGE = "#D55E00"
GREEN = "#009E73"
PURPLE = "#CC79A7"
SKY = "#56B4E9"
GREY = "#4D4D4D"  # a paler one is green to readers without green cones

OTHERS: dict = {"color": "0.75", "linewidth": 0.7, "linestyle": "-", "zorder": 1}
"""Look of lines without a colour of their own."""

_is_shown: ContextVar[bool] = ContextVar("is_shown", default=False)


def _line(number: int) -> tuple:
    """Colour and dash of a line; every six lines the dash changes."""
    colours = (BLUE, GREY, ORANGE, GREEN, PURPLE, SKY)
    dashes = ("-", "--", "-.", ":", (0, (7, 2)), (0, (4, 1, 1, 1, 1, 1)))
    return colours[number % 6], dashes[(number + number // 6) % 6]


LINES = [_line(number) for number in range(36)]
"""Colour and dash of the first, second, ... line, no two of 36 alike."""


def _marker(number: int) -> dict:
    """Matplotlib's options for a point by its number; every five points the shape changes."""
    colour = (BLUE, ORANGE, GREEN, PURPLE, SKY)[number % 5]
    edge = {"markeredgecolor": "white", "markeredgewidth": 0.5}
    return {"marker": "os^Dv"[number // 5], "color": colour} | edge


MARKERS = [_marker(number) for number in range(25)]
"""Looks of the points of up to 25 runs."""


@contextmanager
def shown() -> Iterator[None]:
    """Figures within this context have the style, and ``new_figure`` makes them by pyplot."""
    token = _is_shown.set(True)
    try:
        with rc_context(STYLE):
            yield
    finally:
        _is_shown.reset(token)


def new_figure(width: float, height: float, layout: str = "constrained") -> Figure:
    """An empty figure; width and height [inch]."""
    if not _is_shown.get():
        return Figure(figsize=(width, height), layout=layout)
    from matplotlib import pyplot  # of a window or a notebook

    return pyplot.figure(figsize=(width, height), layout=layout)


def ask(figure: Figure, question: str, note: str = "") -> None:
    """Gives a figure a title, which is the question that it answers, and a note at the bottom.

    If the figure has a legend, the note is part of it, since the legend could cover the note.
    """
    figure.suptitle(question, size=8, weight="bold")
    if note and figure.legends:
        head = figure.legends[0].get_title().get_text()
        texts = [text for text in (head, note) if text]
        figure.legends[0].set_title("\n".join(texts), {"size": 6.5})
    elif note:
        figure.supxlabel(note, size=6.5, color=GREY)


def save(figure: Figure, file: Path) -> list[Path]:
    """Writes a figure in the formats of ``figure_formats``; returns the files."""
    files = [file.with_suffix(f".{ending}") for ending in chosen.get()]
    for file in files:
        with atomic_write(file) as part, rc_context(STYLE):
            figure.savefig(part, dpi=DPI)
            figure.set_layout_engine("none")  # the next format has the same layout
    return files


def panels(figure: Figure, count: int, columns: int, xlabel: str, ylabel: str) -> list[Axes]:
    """Adds panels with common axes, row by row; only outer ones have labels and numbers."""
    rows = math.ceil(count / columns)
    axes = [*figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat]
    for ax in axes[count:]:
        ax.remove()
    for index, ax in enumerate(axes[:count]):
        if index % columns == 0:
            ax.set_ylabel(ylabel)
        if index + columns >= count:  # the lowest panel of its column
            ax.set_xlabel(xlabel)
            ax.tick_params(labelbottom=True)
    return axes[:count]


def numbered(name: str, pages: Sequence[Figure]) -> dict[str, Figure]:
    """Pages by file name: ``name``, ``name_2``, ``name_3`` ..."""
    return {f"{name}_{page}" if page > 1 else name: figure for page, figure in enumerate(pages, 1)}


def even_pages(items: Sequence, most: int) -> list[Sequence]:
    """Items in pages of nearly equal numbers, at most ``most`` a page."""
    pages = math.ceil(len(items) / most) or 1
    size = math.ceil(len(items) / pages) or 1
    return [items[first : first + size] for first in range(0, len(items), size)]


def scaled_panels(
    count: int, width: float, height: float, xlabel: str, ylabel: str
) -> tuple[Figure, list[Axes]]:
    """A figure of panels to one scale with common axes, as large as a page allows.

    Args:
        width, height: Extent of a panel, in the unit of its axes.
    """
    bar = 1.5  # inches beside all panels
    title = 0.25  # inches above each panel
    foot = 1.0  # inches above and below all panels

    def scale(columns: int) -> float:
        """Inches for one unit, with this number of columns."""
        rows = math.ceil(count / columns)
        return min((PAGE - bar) / (columns * width), 5.6 / (rows * height), 3 / height)

    columns = max(range(1, count + 1), key=scale)
    rows = math.ceil(count / columns)
    inches = scale(columns)
    size = columns * width * inches + bar, rows * (height * inches + title) + foot
    figure = new_figure(*size, "compressed")
    return figure, panels(figure, count, columns, xlabel, ylabel)


def wrapped(label: str, width: int = 48) -> str:
    """A text in lines of ``width`` letters, by default as wide as a figure of one column."""
    return textwrap.fill(label, width=width)


def named_ones(
    scores: Mapping[str, float], higher_is_better: bool, own: str | None = None, most: int = 6
) -> list[str]:
    """Names of the lines that get a colour and a label, best score first; others are grey.

    There are at most ``most``, since more colours are hard to distinguish. Line ``own`` is always
    one of them.
    """
    ranked = sorted(scores, key=lambda name: scores[name], reverse=higher_is_better)
    first = [] if own is None else [own]
    named = [*first, *(name for name in ranked if name != own)][:most]
    return sorted(named, key=ranked.index)


def looks(systems: Iterable[str]) -> dict[str, tuple]:
    """Colour and dash pattern of systems by name, equal in all figures.

    Up to 36 systems look different. A baseline has the look of the system with its name. A model
    without its kriging has the colour of the model, and a dotted line.
    """
    models = _models([*systems])
    places = {**_places()}  # index into ``LINES`` by model
    known = {*places.values()}
    taken = {places[model] for model in models.values() if model in places}
    looks_by_name = {}
    for name, model in models.items():
        if model not in places:
            # An unknown model's place follows from its name, so that it looks alike in all figures.
            # A place of another line in the figure, or of a known system, is passed over.
            start = crc32(model.encode()) % len(LINES)
            order = [*range(start, len(LINES)), *range(start)]
            places[model] = min(order, key=lambda place: (place in taken, place in known))
            taken.add(places[model])
        colour, dash = LINES[places[model]]
        looks_by_name[name] = colour, ":" if name.endswith("_trend") else dash
    return looks_by_name


def distinct_looks(named: Sequence[str], systems: Iterable[str]) -> dict[str, tuple]:
    """``looks`` of the lines in one figure, with at most six colours.

    If a known model and another system share a colour, the system takes a free colour.
    """
    looks_by_name = looks(systems)
    models = _models(named)
    known = _places()
    taken = set()
    for name in sorted(named, key=lambda name: models[name] not in known):
        colour, dash = looks_by_name[name]
        if colour in taken and not name.endswith("_trend"):
            free = [colour for colour, _ in LINES[:6] if colour not in taken]
            colour = next(iter(free), colour)
        taken.add(colour)
        looks_by_name[name] = colour, dash
    return looks_by_name


def _models(systems: Iterable[str]) -> dict[str, str]:
    """The model of each system by the system's name; systems of a model look alike.

    A variant such as "GAI-GS split=a" counts as its model, unless the model is also a system.
    """
    registered_names = {title: name for name, title in _titles().items()}
    models = {}
    for system in systems:
        base = system.removesuffix(" (baseline)").removesuffix("_trend")
        models[system] = registered_names.get(base, base)
    for system, model in models.items():
        originals = [
            name for title, name in registered_names.items() if model.startswith(f"{title} ")
        ]
        original = originals[0] if originals else model
        if original not in models.values():
            models[system] = original
    return models


@cache
def _titles() -> dict[str, str]:
    """Titles of models by their registered names."""
    content = yaml.safe_load((conf_dir() / "published.yaml").read_text(encoding="utf-8"))
    return content["names"]


@cache
def _places() -> dict[str, int]:
    """Index into ``LINES`` of each known model; the two predictors of gaigs get solid lines."""
    places = {
        "gaigs": 0,
        "mirrored": 26,
        "mean": 1,
        "knn": 3,
        "gaussian_process": 4,
        "path_loss": 5,
        "friis": 17,
        "nearest_frequency": 7,
    }
    free = [place for place in range(len(LINES)) if place not in places.values()]
    others = [name for name in _titles() if name not in places]
    return places | dict(zip(others, free, strict=False))


def round_step(span: float, most: int) -> float:
    """The smallest step, 1, 2 or 5 times a power of ten, with at most ``most`` steps in a span."""
    least = span / most
    power = 10.0 ** math.floor(math.log10(least))
    return next((step * power for step in (1, 2, 5) if step * power >= least), 10 * power)
