"""Benchmarks: error against time of the parts of gaigs and of whole systems, on this machine."""

import csv
import logging
import math
import statistics
import time
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from gaigs import configuration
from gaigs.io.files import write_text
from gaigs.io.tables import original, write_csv
from gaigs.registry import check_type
from gaigs.report.table import markdown
from gaigs.runs.evaluation import device_name

log = logging.getLogger(__name__)

MEASURED, UNAVAILABLE = "measured", "unavailable: "

Row = dict[str, str]
"""A line of a benchmark's file, by column."""


class Context(NamedTuple):
    """The run folder, overrides of the command line without those of the benchmark, and the torch device."""

    folder: Path
    overrides: tuple[str, ...] = ()
    device: str = "cpu"

    def compose(self, *overrides: str) -> dict:
        """The configuration of a run with the overrides of the command line, then these; see ``gaigs.compose``."""
        return configuration.compose(*self.overrides, *overrides)


class Benchmark(ABC):
    """The contract of kind ``benchmark``: rows of measurements, grouped in cells that are measured one by one.

    ``<name>.csv`` gets the rows of each cell as soon as it is measured; the same command in the same folder measures
    the rest. ``<name>.md`` is made from that file.

    Attributes:
        name: Registered name.
        keys: Columns that identify a row: everything that changes a measurement, "device" among them. The last two name
            an unavailable row.
        values: Columns of measurements. The last column of the file is ``status``: ``MEASURED``, or ``UNAVAILABLE`` and
            the cause.
    """

    name: str
    keys: tuple[str, ...]
    values: tuple[str, ...]

    @abstractmethod
    def cells(self, context: Context) -> Iterable[Sequence[Row]]:
        """Keys of the rows of each cell without "device", cheap cells first."""

    @abstractmethod
    def measure(self, cell: Sequence[Row], context: Context) -> Iterable[Mapping]:
        """The rows of a cell: keys, values, and ``status`` where it is unavailable."""

    @abstractmethod
    def tables(self, rows: Sequence[Row]) -> str:
        """The page of the measured rows in Markdown."""

    def run(
        self, folder: Path, overrides: Sequence[str] = (), minutes: float | None = None, device: str | None = None
    ) -> None:
        """Measures the missing rows of a folder, and writes its page.

        Args:
            folder: Run folder.
            overrides: Overrides of the command line, without those of the benchmark.
            minutes: No measurement begins that would end later, if it takes as long as the longest so far. 0 writes the
                page of existing rows; None sets no limit.
            device: "cpu", "cuda", or None for all devices of this machine, one after the other.
        """
        check_type("benchmark.minutes", minutes, float | None)
        if minutes is not None and minutes < 0:
            raise ValueError(f"benchmark.minutes must be at least 0, or null for no limit, got {minutes}")
        known = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
        if device not in (None, *known):
            raise ValueError(f"benchmark.device must be null or one of {', '.join(known)}, got {device!r}")
        end = math.inf if minutes is None else time.monotonic() + 60 * minutes
        file, columns = folder / f"{self.name}.csv", (*self.keys, *self.values, "status")
        identity = lambda row: tuple(row[key] for key in self.keys)
        rows = {identity(row): row for row in read_rows(file, columns)}
        left = []
        for place in known if device is None else (device,):
            context = Context(folder, tuple(overrides), place)
            for cell in self.cells(context):
                named = [{"device": device_name(torch.device(place))} | row for row in cell]
                if not all(identity(row) in rows for row in named):
                    left.append((named, context))
        longest = 0.0
        for number_of_cell, (cell, context) in enumerate(left):
            begin = time.monotonic()
            if begin + longest >= end:
                log.warning("%s: time is up, %d measurements are missing", self.name, len(left) - number_of_cell)
                break
            for row in self.measure(cell, context):
                texts = {column: text_of(row.get(column)) for column in columns}
                rows[identity(texts)] = texts | {"status": texts["status"] or MEASURED}
            write_csv(file, [columns, *([row[column] for column in columns] for row in rows.values())])
            longest = max(longest, time.monotonic() - begin)
            log.info("%s %d/%d: %.1f s", self.name, number_of_cell + 1, len(left), time.monotonic() - begin)
        measured = [row for row in rows.values() if row["status"] == MEASURED]
        causes: dict[str, dict[str, None]] = {}
        for row in rows.values():
            if row["status"] != MEASURED:
                causes.setdefault(row["status"], {})[", ".join(row[key] for key in self.keys[-2:])] = None
        remarks = "".join(f"- {'; '.join(names)}: {cause}\n" for cause, names in causes.items())
        write_text(folder / f"{self.name}.md", f"{self.tables(measured)}\n{remarks}")


def read_rows(file: Path, columns: Sequence[str]) -> list[Row]:
    """The rows of a benchmark's file, none of an absent one; raises a ValueError for a file with other columns."""
    if not file.is_file():
        return []
    with open(file, newline="", encoding="utf-8", errors="replace") as opened:
        reader = csv.DictReader(opened)
        names, rows = reader.fieldnames, [*reader]
    if names != [*columns] or any(None in row or None in row.values() for row in rows):
        raise ValueError(
            f"{file} must be CSV with the columns {', '.join(columns)}; move it elsewhere, or choose another folder "
            "(hydra.run.dir=DIR)"
        )
    return [{column: original(text) for column, text in row.items()} for row in rows]


def text_of(value: object) -> str:
    """A value as the file stores it: numbers with six digits, nothing for None."""
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def grouped(rows: Sequence[Row], *keys: str) -> dict[tuple[str, ...], list[Row]]:
    """Rows by their values of some keys."""
    found: dict[tuple[str, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row[key] for key in keys), []).append(row)
    return found


def table(rows: Sequence[Mapping], columns: Mapping[str, str]) -> str:
    """Rows in Markdown, numbers with three digits; columns are keys of the rows by title."""
    return markdown([[*columns], *([number(row[key]) for key in columns.values()] for row in rows)])


def number(value: str | float) -> str:
    """A number with three digits, a whole number with all; any other text stays as it is."""
    try:
        found = float(value)
    except ValueError:
        return str(value)
    if found.is_integer() and "e" not in str(value):
        return f"{found:,.0f}"
    if not 1e-3 <= abs(found) < 1e5:
        return f"{found:.1e}".replace("e-0", "e-").replace("e+0", "e")
    return f"{found:,.0f}" if abs(found) >= 100 else f"{found:#.3g}".removesuffix(".")


def median_and_spread(values: Sequence[float]) -> tuple[float, float]:
    """Median, and the range of the middle half."""
    low, median, high = statistics.quantiles(values, n=4) if len(values) > 1 else (*values, *values, *values)
    return median, high - low


def now() -> float:
    """A clock that waits for the accelerator to finish [s]."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()
