"""Tables: values as text, and rows for a terminal, in Markdown and in CSV."""

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from gaigs.io import tables


class Spread(NamedTuple):
    """Mean, standard deviation and lowest value of a score over at least two runs."""

    mean: float
    deviation: float  # standard deviation of the sample
    least: float  # least value

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """The spread of values, one for each run."""
        return cls(statistics.mean(values), statistics.stdev(values), min(values))


def written(value: float | int | str | Spread | None) -> str:
    """A value of a table as text; empty if unknown."""
    if isinstance(value, Spread):
        return f"{written(value.mean)} ± {written(value.deviation)}"
    if isinstance(value, float):
        return f"{value:.3f}" if abs(value) < 10 else f"{value:,.1f}"
    if isinstance(value, int):
        return f"{value:,}"
    return value or ""


def best_in_bold(
    values: Sequence[float | int | Spread | None],
    higher_is_better: bool,
    bold: str = "[bold]{}[/bold]",
) -> list[str]:
    """A column as text; all cells that print like the best value have the format ``bold``."""
    numbers = [value.mean if isinstance(value, Spread) else value for value in values]
    known = [number for number in numbers if number is not None and not math.isnan(number)]
    best = (max if higher_is_better else min)(known, default=None)
    texts = []
    for value, number in zip(values, numbers, strict=True):
        is_best = number in known and written(number) == written(best)
        texts.append(bold.format(written(value)) if is_best else written(value))
    return texts


def columns_of(rows: Iterable[Mapping]) -> list[str]:
    """The keys of all rows, in the order of their first appearance."""
    columns: dict[str, None] = {}
    for row in rows:
        columns |= dict.fromkeys(row)
    return [*columns]


def write_csv(file: Path, rows: Sequence[Mapping], endings: Sequence[str] = ()) -> None:
    """Writes rows as a CSV table; the columns are the keys of all rows.

    A column with a ``Spread`` has its mean; further columns have its deviation and lowest value.

    Args:
        endings: Ends of the names of these further columns. One end means the deviation only.
    """
    spread_columns = set()
    for row in rows:
        spread_columns |= {column for column, value in row.items() if isinstance(value, Spread)}
    columns = []
    for column in columns_of(rows):
        columns.append(column)
        if column in spread_columns:
            columns += [f"{column}{ending}" for ending in endings]
    lines = [columns]
    for row in rows:
        cells = dict(row)
        for column in row.keys() & spread_columns:
            if isinstance(row[column], Spread):
                mean, *further = row[column]
                cells[column] = mean
                for ending, number in zip(endings, further, strict=False):
                    cells[f"{column}{ending}"] = number
        lines.append([cells.get(column, "") for column in columns])
    tables.write_table(file, lines)


def terminal(
    title: str,
    heads: Mapping[str, bool],
    lines: Sequence[Sequence[str]],
    caption: str,
    styles: Sequence = (),
) -> Table:
    """A table of cells in Rich's markup for a terminal.

    A head with True is for a column of numbers, which are not wrapped.
    """
    table = Table(
        title=escape(title),
        caption=escape(caption),
        box=SIMPLE_HEAD,
        pad_edge=False,
        padding=(0, 1, 0, 0),
    )
    for head, is_number in heads.items():
        text = stacked(head) if is_number else escape(head)
        justify = "right" if is_number else "left"
        table.add_column(text, justify=justify, no_wrap=is_number, overflow="fold")
    for line, style in zip(lines, styles or [None] * len(lines), strict=True):
        table.add_row(*line, style=style)
    return table


def markdown(lines: Sequence[Sequence[str]]) -> str:
    """A table in Markdown; the first line is the head."""
    head, *rows = lines
    text = ""
    for line in (head, ["---"] * len(head), *rows):
        cells = [cell.replace("|", r"\|") for cell in line]
        text += f"| {' | '.join(cells)} |\n"
    return text


def tex(text: str) -> str:
    """Plain text with its special characters in LaTeX."""
    signs = {sign: f"\\{sign}" for sign in "&%$#_{}"}
    signs |= {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    signs |= {"±": r"$\pm$", "²": "$^2$", "−": "$-$", "×": r"$\times$"}
    return "".join(signs.get(sign, sign) for sign in text)


def latex(
    lines: Sequence[Sequence[str]], texts: int, caption: str, rules: Sequence[int] = ()
) -> str:
    """A table in LaTeX without packages; the first line is the head.

    Args:
        lines: Cells in LaTeX.
        texts: Number of text columns; all further columns are numbers, aligned right.
        caption: The caption.
        rules: Numbers of the lines after a rule.
    """
    columns = "l" * texts + "r" * (len(lines[0]) - texts)
    rows = ""
    for number, line in enumerate(lines):
        rule = "\\hline\n" if number in (0, 1, *rules) else ""
        # A bracket or a star after the end of a row would be an option of it.
        start = "{}" if line[0][:1] in ("[", "*") else ""
        rows += f"{rule}{start}{' & '.join(line)} \\\\\n"
    body = f"\\begin{{tabular}}{{{columns}}}\n{rows}\\hline\n\\end{{tabular}}"
    head = f"\\begin{{table}}\n\\centering\n\\caption{{{caption}}}\n"
    return f"{head}{body}\n\\end{{table}}\n"


def stacked(title: str) -> str:
    """The head of a narrow column, one word in each line."""
    return escape(title.replace(" ", "\n").replace("_", "_\n"))
