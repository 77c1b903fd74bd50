"""File formats of the figures of a command."""

import contextlib
from collections.abc import Iterator
from contextvars import ContextVar

chosen: ContextVar[tuple[str, ...]] = ContextVar("chosen", default=("png",))
"""Formats that ``gaigs.report.style.save`` writes."""


@contextlib.contextmanager
def figure_formats(format: str | list[str] = "png") -> Iterator[None]:
    """Sets the formats of figures within the context: ``png``, ``pdf`` or ``svg``."""
    formats = [format] if isinstance(format, str) else format
    known = ("png", "pdf", "svg")
    if not formats or not {*formats} <= {*known}:
        raise ValueError(
            f"figures.format must be one or several of {', '.join(known)}, got {format!r}"
        )
    token = chosen.set(tuple(formats))
    try:
        yield
    finally:
        chosen.reset(token)
