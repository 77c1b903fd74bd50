"""Benchmarks measure what this machine makes of gaigs's parts: error against time, in one process and one run."""

import logging
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import torch

from gaigs import configuration
from gaigs.benchmark._rows import MEASURED, NOT_MEASURED, UNAVAILABLE, Row, Rows, text_of
from gaigs.evaluation import device_name
from gaigs.io.files import atomic_write, write_text
from gaigs.registry import suggest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

log = logging.getLogger(__name__)

__all__ = ["MEASURED", "NOT_MEASURED", "UNAVAILABLE", "Benchmark", "Context", "Glance", "Measured", "Row", "Rows"]


@dataclass(frozen=True)
class Context:
    """What benchmarks of one command share.

    Attributes:
        overrides: The command line's, without ``command`` and those of ``benchmark``.
        devices: Of torch tensors, each measured by itself: "cpu", "cuda".
        deadline: When no more is begun, by ``time.monotonic`` [s].
    """

    overrides: tuple[str, ...] = ()
    devices: tuple[str, ...] = ("cpu",)
    deadline: float = math.inf

    def compose(self, *overrides: str) -> dict:
        """The configuration of a run with the command line's overrides and then these, as of ``gaigs.compose``."""
        return configuration.compose(*self.overrides, *overrides)

    def seconds_left(self) -> float:
        """Until the deadline, 0 at the least."""
        return max(0.0, self.deadline - time.monotonic())

    def within(self, minutes: float | None = None, device: str | None = None) -> "Context":
        """The same for a part: a deadline that is no later, and one device; None leaves either as it is."""
        deadline = math.inf if minutes is None else time.monotonic() + 60 * minutes
        devices = self.devices if device is None else (device,)
        return replace(self, deadline=min(self.deadline, deadline), devices=devices)


class Glance(NamedTuple):
    """A line of the table at a glance: what a choice costs in error, and what it gives in time.

    Attributes:
        choice: The component, and what it stands beside, e.g. "`opencl` for `torch`".
        where: On what, e.g. "map of 5,000 Gaussians, 90 x 360, forward".
        time: E.g. "3.1 ms, 17 times as fast".
        error: E.g. "7e-7 of the largest value".
        device: Its name.
    """

    choice: str
    where: str
    time: str
    error: str
    device: str


class Benchmark(ABC):
    """The contract of kind ``benchmark``.

    Args:
        minutes: Nothing is begun later than this; what is left is done by the same command in the same folder.
            0: tables and figures of what is measured already; None: no limit.
        device: "cpu", "cuda", or None for each that there is.

    Raises:
        ValueError: ``minutes`` is negative, or there is no such device.
    """

    def __init__(self, minutes: float | None = None, device: str | None = None):
        if minutes is not None and not minutes >= 0:
            raise ValueError(f"benchmark.minutes must be at least 0, or null for no limit, got {minutes}")
        if device not in (None, "cpu", "cuda"):
            raise ValueError(f"benchmark.device must be cpu, cuda, or null for each that there is, got {device!r}")
        if device == "cuda" and not torch.cuda.is_available():
            raise ValueError("benchmark.device=cuda needs a CUDA device, and torch finds none; leave it out")
        self.minutes, self.device = minutes, device

    @abstractmethod
    def run(self, folder: Path, context: Context) -> None:
        """Measures what the folder lacks, as far as time allows, and writes tables and figures.

        Raises:
            ValueError: An option does not suit, or a file of the folder is damaged.
            OSError: A file cannot be written.
        """

    @abstractmethod
    def section(self, folder: Path) -> str:
        """Markdown of what the folder holds, from a heading of the second level on; figures lie beside it."""

    @abstractmethod
    def glance(self, folder: Path) -> Sequence[Glance]:
        """The lines that the first tables of the whole page have of it."""


class Measured(Benchmark):
    """A benchmark that measures rows, in cells.

    It says which cells there are. Each is measured in one go and gives some rows. A row is told from others by its
    ``keys``: whatever changes what is measured is one of them, overrides of the command line too. Rows go into
    ``<name>.csv`` as soon as their cell is measured, so that a run that was stopped goes on behind them. ``<name>.md``
    and ``<name>*.png`` are made of that file alone.

    Attributes:
        name: As registered.
        keys: Columns that tell a row from others; "device", the name of what computes, is among them.
        values: Columns of what is measured. Behind keys and values stands ``status``: ``MEASURED``,
            ``NOT_MEASURED``, or ``UNAVAILABLE`` and a sentence.
    """

    name: str
    keys: tuple[str, ...]
    values: tuple[str, ...]

    @abstractmethod
    def cells(self, context: Context) -> Iterable[Sequence[Row]]:
        """The keys of the rows of each cell, cheap cells first."""

    @abstractmethod
    def measure(self, cell: Sequence[Row], context: Context) -> Iterable[Row]:
        """The rows of a cell: keys, values, and ``status`` where it is not ``MEASURED``; numbers may be numbers."""

    @abstractmethod
    def tables(self, rows: Sequence[Row]) -> str:
        """Markdown of rows, from a heading of the second level on."""

    @abstractmethod
    def highlights(self, rows: Sequence[Row]) -> Sequence[Glance]:
        """What ``glance`` tells of rows."""

    def figures(self, rows: Sequence[Row]) -> Mapping[str, "Figure"]:
        """Figures by file name without the ending; names begin with the benchmark's."""
        return {}

    def run(self, folder: Path, context: Context) -> None:
        from gaigs.report.style import DPI

        context = context.within(self.minutes, self.device)
        rows = self._rows(folder)
        try:
            self._measure_cells(rows, context)
        finally:
            rows.write()
        for name, figure in self.figures(rows.all()).items():
            with atomic_write(folder / f"{name}.png") as part:
                figure.savefig(part, dpi=DPI)
        write_text(folder / f"{self.name}.md", self.tables(rows.all()))

    def section(self, folder: Path) -> str:
        return self.tables(self._rows(folder).all())

    def glance(self, folder: Path) -> Sequence[Glance]:
        return self.highlights(self._rows(folder).all())

    def _rows(self, folder: Path) -> Rows:
        return Rows(folder / f"{self.name}.csv", self.keys, self.values)

    def _measure_cells(self, rows: Rows, context: Context) -> None:
        cells = [[{key: text_of(row[key]) for key in self.keys} for row in cell] for cell in self.cells(context)]
        left = [cell for cell in cells if rows.lack(cell)]  # `all` is a module here
        if len(left) < len(cells):
            log.info("%s: %d of %d cells are measured already", self.name, len(cells) - len(left), len(cells))
        started, longest = time.monotonic(), 0.0
        for number, cell in enumerate(left):
            if context.seconds_left() <= longest:
                log.info("%s: time is up, %d cells are left", self.name, len(left) - number)
                rows.mark(row for late in left[number:] for row in late)
                return
            begun = time.monotonic()
            rows.add(self.measure(cell, context))
            if context.deadline < math.inf:
                longest = max(longest, time.monotonic() - begun)
            shared = {key: cell[0][key] for key in self.keys if len({row[key] for row in cell}) == 1}
            told = ", ".join(text for key, text in shared.items() if text and key != "device")
            minutes = (time.monotonic() - started) / 60
            log.info("%s %d/%d, %.1f min %s", self.name, number + 1, len(left), minutes, told)


def devices() -> tuple[str, ...]:
    """Devices that torch tensors may be on here."""
    return ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)


def device_of(row: Row, context: Context) -> str:
    """The torch device that a row's name stands for."""
    return next(device for device in context.devices if named(device) == row["device"])


def check_names(option: str, words: Sequence[str], known: Sequence[str]) -> None:
    """Sees to it that a list of an option names at least one thing, and only such as there are.

    Raises:
        ValueError: It does not.
    """
    if not words:
        raise ValueError(f"benchmark.{option} must have at least one of {', '.join(known)}, got none")
    for word in words:
        if word not in known:
            raise ValueError(f"benchmark.{option} has {suggest(word, known)}, and there are: {', '.join(known)}")


def named(device: str) -> str:
    """The name of a device, as the key "device" has it."""
    return device_name(torch.device(device))


def clock(device: str = "cpu") -> Callable[[], float]:
    """A clock that waits for a device to be done [s]."""

    def now() -> float:
        if device == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    return now
