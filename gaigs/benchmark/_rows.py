"""The rows of a benchmark, in a CSV file that a stopped run goes on with."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path

from gaigs.io.files import atomic_write

MEASURED, NOT_MEASURED = "measured", "not measured"
"""What ``status`` says of a row."""

UNAVAILABLE = "unavailable: "
"""What ``status`` begins with where a thing cannot be measured here; a sentence says why."""

Row = dict[str, str]
"""A line of the file by column, as text."""


class Rows:
    """Rows by their keys; of two with the same the later one counts.

    Args:
        file: Read where it is there; what it holds is kept.
        keys: Columns that tell rows apart.
        values: The other columns but ``status``.

    Raises:
        ValueError: The file has other columns, or is damaged.
    """

    def __init__(self, file: Path, keys: Sequence[str], values: Sequence[str]):
        self.file, self.keys, self.columns = file, keys, (*keys, *values, "status")
        self._rows: dict[tuple, Row] = {}
        if file.is_file():
            self._rows = {self._key(row): row for row in read(file, self.columns)}
        self.write()  # without what a killed run left half written

    def has(self, row: Row) -> bool:
        """Whether a row with these keys is measured, or known to be unavailable."""
        found = self._rows.get(self._key(row))
        return found is not None and found["status"] != NOT_MEASURED

    def lack(self, cell: Iterable[Row]) -> bool:
        """Whether a row of a cell is still to be measured."""
        return not all(map(self.has, cell))

    def add(self, rows: Iterable[Row]) -> None:
        """Appends rows to the file.

        Raises:
            OSError: The file cannot be written.
        """
        new = [{column: text_of(row.get(column)) for column in self.columns} for row in rows]
        for row in new:
            row["status"] = row["status"] or MEASURED
            self._rows[self._key(row)] = row
        with open(self.file, "a", newline="", encoding="utf-8") as opened:
            csv.DictWriter(opened, self.columns).writerows(new)

    def mark(self, rows: Iterable[Row]) -> None:
        """Notes rows that there was no time for."""
        for row in rows:
            if not self.has(row):
                self._rows[self._key(row)] = dict.fromkeys(self.columns, "") | row | {"status": NOT_MEASURED}

    def all(self) -> list[Row]:
        """Each once, in the order in which their keys came."""
        return [*self._rows.values()]

    def write(self) -> None:
        """Writes the file anew, each row once."""
        with atomic_write(self.file) as part, open(part, "w", newline="", encoding="utf-8") as opened:
            writer = csv.DictWriter(opened, self.columns)
            writer.writeheader()
            writer.writerows(self.all())

    def _key(self, row: Row) -> tuple[str, ...]:
        return tuple(row[key] for key in self.keys)


def read(file: Path, columns: Sequence[str]) -> list[Row]:
    """The rows of a file; a last line that a killed run has left half written is left out.

    Raises:
        ValueError: It has other columns, or a damaged line before the last.
    """
    told = "; move it elsewhere, or choose another folder (hydra.run.dir=DIR)"
    try:
        text = file.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{file} must be a CSV file of a benchmark, and is no text{told}") from error
    ends = text.endswith("\n")
    lines = [*csv.reader(text.splitlines())]
    if not lines or lines[0] != [*columns]:
        found = ", ".join(lines[0]) if lines else "nothing"
        raise ValueError(f"{file} must have the columns {', '.join(columns)}, got {found}{told}")
    rows = lines[1:] if ends else lines[1:-1]
    for number, row in enumerate(rows, 2):
        if len(row) != len(columns) or not row[-1]:
            raise ValueError(f"{file}, line {number}, must have {len(columns)} values, got {row}{told}")
    return [dict(zip(columns, row, strict=True)) for row in rows]


def text_of(value: object) -> str:
    """A value as the file has it: numbers with six digits, nothing for None."""
    if value is None:
        return ""
    return f"{value:.6g}" if isinstance(value, float) else str(value)
