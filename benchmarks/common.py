"""What four benchmarks share: rows that are measured cell by cell and stored at once; their tables.

``accuracy.py``, ``budgets.py``, ``rasterizer.py`` and ``step.py`` write ``<name>.csv`` and
``<name>.md`` into their folder. The same command with ``--folder`` measures the rows that are
missing there.
"""

import argparse
import csv
import logging
import math
import statistics
import time
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

import gaigs
from gaigs import processes
from gaigs.io.files import write_text
from gaigs.io.tables import original, write_table
from gaigs.report.table import markdown
from gaigs.runs.evaluation import device_name

log = logging.getLogger("gaigs.benchmarks")

MEASURED, UNAVAILABLE = "measured", "unavailable: "

Row = dict[str, str]
"""A line of a benchmark's file, by column."""


def command_line(doc: str, takes_overrides: bool = True) -> argparse.ArgumentParser:
    """The options of every benchmark."""
    devices = ("cpu", "cuda") if torch.cuda.is_available() else ("cpu",)
    folder = Path("runs") / time.strftime("%Y-%m-%d_%H-%M-%S")
    shape = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=doc, formatter_class=shape)
    if takes_overrides:
        parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="of a run")
    else:
        parser.set_defaults(overrides=[])
    parser.add_argument("--folder", type=Path, default=folder, help="of the results; goes on there")
    parser.add_argument("--minutes", type=float, default=math.inf, help="0 writes the page alone")
    parser.add_argument("--devices", nargs="+", choices=devices, default=devices)
    return parser


def words(doc: str, metavar: str = "") -> list[str]:
    """The words behind a script's name; ``--help`` prints its docstring."""
    parser = argparse.ArgumentParser(
        description=doc, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    if metavar:
        parser.add_argument("words", nargs="*", metavar=metavar)
    return getattr(parser.parse_args(), "words", [])


def positive(text: str) -> int:
    """A whole number of at least 1, as a type of ``argparse``."""
    if int(text) < 1:
        raise ValueError
    return int(text)


class Benchmark:
    """Rows of measurements, grouped in cells that are measured one by one.

    A subclass has three methods. ``cells(device)`` gives the keys of the rows of each cell without
    "device", cheap cells first. ``measure(cell, device)`` gives the rows: keys, values, and
    ``status`` where it is unavailable. ``tables(rows)`` gives the page of the measured rows.

    Attributes:
        name: Name of its files.
        keys: Columns that identify a row: everything that changes a measurement, "device" among
            them. The last two name an unavailable row.
        values: Columns of measurements. The last column of the file is ``status``: ``MEASURED``, or
            ``UNAVAILABLE`` and the cause.
        config: Configuration of a run with the overrides of the command line.
    """

    name: str
    keys: tuple[str, ...]
    values: tuple[str, ...]

    def __init__(self, options: argparse.Namespace):
        self.options, self.config = options, gaigs.compose(*options.overrides)

    def run(self) -> None:
        """Measures the missing rows of the folder, and writes its page.

        With a limit of minutes no measurement begins that would end later, if it takes as long as
        the longest so far.
        """
        folder = self.options.folder
        logging.basicConfig(level=logging.INFO, format="%(message)s")
        log.info("results: %s; with --folder %s the same command goes on", folder, folder)
        processes.keep_memory()
        folder.mkdir(parents=True, exist_ok=True)
        threads = processes.limited_threads(self.config["threads"])
        with processes.stopping(), threads, processes.only_run(folder):
            rows = self._measure_missing(folder / f"{self.name}.csv")
        measured = [row for row in rows if row["status"] == MEASURED]
        causes: dict[str, dict[str, None]] = {}
        for row in rows:
            if row["status"] != MEASURED:
                name = ", ".join(row[key] for key in self.keys[-2:])
                causes.setdefault(row["status"], {})[name] = None
        remarks = "".join(f"- {'; '.join(names)}: {cause}\n" for cause, names in causes.items())
        write_text(folder / f"{self.name}.md", f"{self.tables(measured)}\n{remarks}")

    def _measure_missing(self, file: Path) -> list[Row]:
        end = time.monotonic() + 60 * self.options.minutes
        columns = (*self.keys, *self.values, "status")

        def identity(row):
            return tuple(row[key] for key in self.keys)

        rows = {identity(row): row for row in read_rows(file, columns)}
        left = []
        for device in self.options.devices:
            name = device_name(torch.device(device))
            for cell in self.cells(device):
                named = [{"device": name} | row for row in cell]
                if not all(identity(row) in rows for row in named):
                    left.append((named, device))
        longest = 0.0
        for number_of_cell, (cell, device) in enumerate(left):
            begin = time.monotonic()
            if begin + longest >= end:
                missing = len(left) - number_of_cell
                log.warning("%s: time is up, %d measurements are missing", self.name, missing)
                break
            for row in self.measure(cell, device):
                texts = {column: text_of(row.get(column)) for column in columns}
                rows[identity(texts)] = texts | {"status": texts["status"] or MEASURED}
            lines = [[row[column] for column in columns] for row in rows.values()]
            write_table(file, [columns, *lines])
            seconds = time.monotonic() - begin
            longest = max(longest, seconds)
            log.info("%s %d/%d: %.1f s", self.name, number_of_cell + 1, len(left), seconds)
        return [*rows.values()]


def read_rows(file: Path, columns: Sequence[str]) -> list[Row]:
    """The rows of a benchmark's file, none of an absent one; a ValueError for other columns."""
    if not file.is_file():
        return []
    with open(file, newline="", encoding="utf-8", errors="replace") as opened:
        reader = csv.DictReader(opened)
        names, rows = reader.fieldnames, [*reader]
    if names != [*columns] or any(None in row or None in row.values() for row in rows):
        raise ValueError(
            f"{file} must be CSV with the columns {', '.join(columns)}; move it elsewhere, or "
            "choose another folder (--folder DIR)"
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
    lines = [[number(row[key]) for key in columns.values()] for row in rows]
    return markdown([[*columns], *lines])


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
    if len(values) == 1:
        return values[0], 0
    low, median, high = statistics.quantiles(values, n=4)
    return median, high - low


def now() -> float:
    """A clock that waits for the accelerator to finish [s]."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()
    return time.perf_counter()
