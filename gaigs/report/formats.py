"""File formats of the figures of a command."""

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar

FORMATS = ("png", "pdf", "svg")
"""Endings of files that figures may have."""

chosen: ContextVar[tuple[str, ...]] = ContextVar("chosen", default=("png",))
"""Formats that ``gaigs.report.style.save`` writes."""


@contextlib.contextmanager
def figure_formats(format: str | list[str] = "png") -> Iterator[None]:
    """Figures within the context are written in these formats; a ``ValueError`` for an unknown one."""
    formats = [format] if isinstance(format, str) else format
    if not formats or not {*formats} <= {*FORMATS}:
        raise ValueError(
            f"figures.format must be one or several of {', '.join(FORMATS)}, got {format!r}"
        )
    token = chosen.set(tuple(formats))
    try:
        yield
    finally:
        chosen.reset(token)
