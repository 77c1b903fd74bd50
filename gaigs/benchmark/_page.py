"""What the pages of benchmarks share."""

import os
from collections.abc import Iterable, Sequence

from gaigs.benchmark._rows import NOT_MEASURED, UNAVAILABLE, Row
from gaigs.report.table import markdown


def table(head: Sequence[str], lines: Sequence[Sequence[str]]) -> str:
    """Markdown; nothing for no lines."""
    return markdown([head, *lines]) if lines else ""


def number(text: str) -> str:
    """A number of the file with three digits; nothing where there is none."""
    if not text:
        return ""
    value = float(text)
    if value and not 1e-3 <= abs(value) < 1e5:
        return f"{value:.1e}".replace("e-0", "e-").replace("e+0", "e")
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:#.3g}".removesuffix(".")


def remarks(rows: Sequence[Row], keys: Sequence[str], place: Sequence[str] = ()) -> str:
    """What could not be measured and why, and what there was no time for, as a list.

    Args:
        rows: Of the file.
        keys: What to call a row that could not be measured.
        place: What to call one that there was no time for; nothing: the same.
    """
    causes: dict[str, dict[str, None]] = {}
    for row in rows:
        if row["status"].startswith(UNAVAILABLE):
            cause = row["status"].removeprefix(UNAVAILABLE)
            causes.setdefault(cause, {})[", ".join(row[key] for key in keys[:2] if row[key])] = None
    lines = [f"- unavailable: {'; '.join(where)}: {cause}" for cause, where in causes.items()]
    late = [", ".join(row[key] for key in place or keys if row[key]) for row in rows if row["status"] == NOT_MEASURED]
    if late:
        lines.append(f"- not measured, as time was up: {'; '.join(dict.fromkeys(late))}")
    return "\n".join(lines) + "\n" if lines else ""


def load_now() -> float | None:
    """How many processes want a core, as the system tells; None where it does not."""
    try:
        return os.getloadavg()[0]
    except (AttributeError, OSError):
        return None


def load_of(rows: Iterable[Row]) -> str:
    """The range of the column "load"."""
    loads = [float(row["load"]) for row in rows if row["load"]]
    ends = dict.fromkeys(f"{end:.1f}" for end in (min(loads), max(loads))) if loads else ["unknown"]
    return " to ".join(ends)


def best(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Those that no other beats in time and error both, fastest first."""
    front = []
    for time, error in sorted(points):
        if not front or error < front[-1][1]:
            front.append((time, error))
    return front
