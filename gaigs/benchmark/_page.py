"""What the pages of benchmarks share."""

from collections.abc import Sequence

from gaigs.benchmark._rows import NOT_MEASURED, UNAVAILABLE, Row


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


def best(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """Those that no other beats in time and error both, fastest first."""
    front = []
    for time, error in sorted(points):
        if not front or error < front[-1][1]:
            front.append((time, error))
    return front
