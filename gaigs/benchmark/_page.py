"""What the pages of benchmarks share: tables, and figures of error against time."""

from collections.abc import Mapping, Sequence

from matplotlib import rc_context
from matplotlib.figure import Figure

from gaigs.benchmark._rows import NOT_MEASURED, UNAVAILABLE, Row
from gaigs.report.style import MARKERS, PAGE, STYLE

Points = Mapping[str, Sequence[tuple[float, float]]]
"""(time, error) of each setting, by the component's name."""


def table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Markdown; nothing for no lines."""
    if not lines:
        return ""
    whole = [head, ["---"] * len(head), *lines]
    return "".join("| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |\n" for line in whole)


def number(text: str) -> str:
    """A number of the file with three digits; nothing where there is none."""
    if not text:
        return ""
    value = float(text)
    if value and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.1e}".replace("e-0", "e-").replace("e+0", "e")
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:#.3g}".removesuffix(".")


def remarks(rows: Sequence[Row], keys: Sequence[str]) -> str:
    """What could not be measured and why, and what there was no time for, as lists."""
    causes: dict[str, dict[str, None]] = {}
    for row in rows:
        if row["status"].startswith(UNAVAILABLE):
            cause = row["status"].removeprefix(UNAVAILABLE)
            causes.setdefault(cause, {})[", ".join(row[key] for key in keys[:2] if row[key])] = None
    lines = [f"- unavailable: {'; '.join(where)}: {cause}" for cause, where in causes.items()]
    late = [", ".join(row[key] for key in keys if row[key]) for row in rows if row["status"] == NOT_MEASURED]
    lines += [f"- not measured, as time was up: {what}" for what in late]
    return "\n".join(lines) + "\n" if lines else ""


def pareto(panels: Mapping[str, Points], time: str, error: str) -> Figure:
    """Error against time, both logarithmic; the settings that none beats in both are joined by a line.

    Args:
        panels: Points by title.
        time, error: Labels of the axes, with units.
    """
    with rc_context(STYLE):
        figure = Figure(figsize=(PAGE, 2.9), layout="constrained")
        axes = figure.subplots(1, len(panels), squeeze=False, sharey=True)[0]
        names = [*dict.fromkeys(name for points in panels.values() for name in points)]
        looks = {name: MARKERS[6 * i % len(MARKERS)] for i, name in enumerate(names)}  # in marker and colour
        for ax, (title, points) in zip(axes, panels.items(), strict=True):
            for name, found in points.items():
                ax.plot(*zip(*found, strict=True), linestyle="", markersize=5, label=name, **looks[name])
            front = best([point for found in points.values() for point in found])
            ax.plot(*zip(*front, strict=True), color="0.45", linewidth=0.9, zorder=0, label="none is better in both")
            ax.set(title=title, xscale="log", yscale="log", xlabel=time)
            ax.grid()
        axes[0].set_ylabel(error)
        labels = {}
        for ax in axes:
            labels |= {label: handle for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)}
        figure.legend(labels.values(), labels.keys(), loc="outside lower center", ncols=min(len(labels), 5))
    return figure


def best(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Those that no other beats in time and error both, fastest first."""
    front = []
    for time, error in sorted(points):
        if not front or error < front[-1][1]:
            front.append((time, error))
    return front
