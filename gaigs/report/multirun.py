"""The runs of a Hydra multirun, or of several: one table, their spread over seeds, their speed against their error."""

import csv
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.markup import escape
from rich.table import Table

from gaigs.io.files import atomic_write, write_text
from gaigs.registry import check_type
from gaigs.report.claims import write_claims
from gaigs.report.curves import speed_against_error
from gaigs.report.runs import Run, Spread, read_runs, train_seconds
from gaigs.report.style import DPI
from gaigs.report.systems import write_systems
from gaigs.report.table import markdown, metrics_of, stacked, written

COSTS = {
    "train_seconds": "training [s]",
    "num_gaussians": "Gaussians",
    "num_parameters": "parameters",
    "inference_ms": "inference [ms]",
}
"""What a reader calls the costs of ``metrics.json``."""

WRITTEN_ONLY = "num_gaussians"
"""The cost for which a terminal has no room."""

SEEDS = "Runs that differ in the seed alone: mean ± standard deviation (n - 1), and the least"
"""What the second table shows."""


def ablation(runs: list[Run]) -> tuple[list[dict], dict]:
    """Rows of the table, each a dictionary by column, and what all runs have in common.

    Varied overrides lead, then come scores and costs. An unfinished run has a row without scores. The baselines
    that the runs were held against follow, once for each split.
    """
    shared, varied = {}, []
    for key in dict.fromkeys(key for run in runs for key in run.overrides):
        values = {run.overrides.get(key, "") for run in runs}
        if len(values) == 1:
            shared[key] = values.pop()
        else:
            varied.append(key)
    done = [run.metrics for run in runs if run.metrics is not None]
    facts = []
    for key in ("split", "seed", "device"):
        values = {metrics[key] for metrics in done}
        if len(values) == 1:
            shared[key] = values.pop()
        else:
            facts.append(key)

    rows, baselines = [], {}
    for name, overrides, metrics, *_ in runs:
        row = {"run": name, "status": "unfinished", "model": ""} | {key: overrides.get(key, "") for key in varied}
        if metrics is not None:
            (own, scores), *others = metrics["models"].items()
            row |= {"status": "done", "model": row["model"] or own} | {key: metrics[key] for key in facts}
            row |= scores | {key: metrics.get(key) for key in COSTS} | {"train_seconds": train_seconds(metrics)}
            for model, scores in others:
                if model == f"{own}_trend":  # the run's own model without its kriging
                    continue
                baseline = {"status": "baseline", "model": model} | scores
                if "split" in facts:
                    baseline["split"] = metrics["split"]
                # As written: two devices give scores that differ in the last bits.
                baselines[tuple(written(value) for value in baseline.values())] = baseline
        rows.append(row)
    return rows + list(baselines.values()), shared


def over_seeds(runs: list[Run], shared: Mapping) -> list[dict]:
    """A row for each group of runs that differ in ``seed`` alone, where two seeds or more did not fail.

    Args:
        runs: All runs of the table.
        shared: What they have in common, as ``ablation`` gives it; it is left out.

    Returns:
        Rows with the group's model, its overrides, its split, how many ``runs`` there are, and a ``Spread`` of each
        metric.
    """
    groups: dict[frozenset, list[Run]] = {}
    for run in runs:
        if run.metrics is not None:
            fixed = frozenset((key, value) for key, value in run.overrides.items() if key != "seed")
            groups.setdefault(fixed, []).append(run)
    varied = [key for key in _columns(run.overrides for run in runs) if key != "seed" and key not in shared]
    rows = []
    for group in groups.values():
        done = [run.metrics for run in group]
        if len({metrics["seed"] for metrics in done}) < 2:
            continue
        scores = [next(iter(metrics["models"].values())) for metrics in done]
        row = {"status": "seeds", "model": next(iter(done[0]["models"]))}
        row |= {key: group[0].overrides.get(key, "") for key in varied}
        if "split" not in shared:
            splits = {metrics["split"] for metrics in done}
            row["split"] = splits.pop() if len(splits) == 1 else f"{len(splits)} splits"
        row["runs"] = len(group)
        for name in scores[0]:
            if all(name in score for score in scores):
                row[name] = Spread.of([score[name] for score in scores])
        rows.append(row)
    return rows


def report(folder: str | Path) -> Group:
    """Writes ``ablation.csv``, ``ablation.md`` and, unless none has ended, ``speed_against_error.png`` there. Runs of
    several models are also set side by side, by ``gaigs.report.systems.write_systems``. Runs of variants are also held
    against the paper's claims, by ``gaigs.report.claims.write_claims``; that is all where they are of several tasks.

    Args:
        folder: Of a Hydra multirun, or one above several.

    Returns:
        The tables, for a terminal of 80 columns: the runs and, if there are any, the groups of runs that differ in the
        seed alone; the systems, where there are several; and the claims, where variants were run. Metrics that are not
        brief are in the files only, and so is what tells no run from another.

    Raises:
        TypeError: The folder is none.
        FileNotFoundError: The folder holds no run.
        ValueError: The runs make no table.
    """
    if not isinstance(folder, os.PathLike):
        check_type("folder", folder, Path)
    folder = Path(folder)
    runs = read_runs(folder)
    claims = write_claims(folder, runs)
    tasks = {run.metrics["task"]: run.name for run in runs if run.metrics is not None}
    if len(tasks) > 1:
        if claims is not None:
            return Group(claims)
        listed = ", ".join(f"{task} in {name}" for task, name in tasks.items())
        raise ValueError(f"the runs of a table must be of one task, got {listed}; pass a folder with runs of one")
    known = next((metrics_of(run.metrics) for run in runs if run.metrics is not None), {})
    titles = {name: metric.title for name, metric in known.items()} | COSTS
    rows, shared = ablation(runs)
    groups = over_seeds(runs, shared)
    caption = ", ".join(f"{key}={value}" for key, value in shared.items())

    written_rows = rows + [_flat(row) for row in groups]
    with atomic_write(folder / "ablation.csv") as part, open(part, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, _columns(written_rows))
        writer.writeheader()
        writer.writerows(written_rows)
    failures = [f"{run.name}: {run.failure}" for run in runs if run.failure is not None]
    page = f"{_markdown(rows, titles)}\n{caption}\n" + "".join(f"- without a result: {why}\n" for why in failures)
    if groups:
        page += f"\n{SEEDS}\n\n{_markdown(groups, titles)}"
    write_text(folder / "ablation.md", page)
    if any(run.metrics is not None for run in runs):
        with atomic_write(folder / "speed_against_error.png") as part:
            _speed(runs, rows, shared, titles).savefig(part, dpi=DPI)

    hidden = {name for name, metric in known.items() if not metric.is_brief} | {WRITTEN_ONLY}
    if not any(row["status"] == "unfinished" for row in rows):
        hidden.add("status")
    varied = [[value for key, value in run.overrides.items() if key not in shared] for run in runs]
    if all(varied.count(values) == 1 for values in varied):
        hidden.add("run")  # whose name would repeat the varied overrides
    caption = "\n".join([*failures, f"{caption}; all columns in ablation.md"])
    tables = [_table(f"Runs of {folder}", rows, titles, hidden, caption)]
    if groups:
        tables.append(_table("Over seeds", groups, titles, hidden | {"status"}, f"{SEEDS}; all columns in ablation.md"))
    baselines = [row for row in rows if row["status"] == "baseline"]
    systems = write_systems(folder, runs, baselines, shared, known)
    if systems is not None:
        tables.append(systems)
    if claims is not None:
        tables.append(claims)
    return Group(*tables)


def _columns(rows: Iterable[Mapping]) -> list[str]:
    return list(dict.fromkeys(column for row in rows for column in row))


def _flat(row: dict) -> dict:
    """A row with a spread in three columns: the metric's own for the mean, and two that say what they are."""
    flat = {}
    for key, value in row.items():
        if isinstance(value, Spread):
            flat |= {key: value.mean, f"{key}_sd": value.deviation, f"{key}_least": value.least}
        else:
            flat[key] = value
    return flat


def _text(value: float | int | str | Spread | None, between: str) -> str:
    if isinstance(value, Spread):
        return f"{written(value.mean)} ± {written(value.deviation)}{between}least {written(value.least)}"
    return written(value)


def _markdown(rows: list[dict], titles: Mapping[str, str]) -> str:
    columns = _columns(rows)
    cells = [[_text(row.get(column), ", ") for column in columns] for row in rows]
    return markdown([[titles.get(column, column) for column in columns], *cells])


def _table(title: str, rows: list[dict], titles: Mapping[str, str], hidden: set[str], caption: str) -> Table:
    columns = [column for column in _columns(rows) if column not in hidden]
    table = Table(title=escape(title), caption=escape(caption), box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for column in columns:
        is_number = column in titles  # which stays whole; where room lacks, words are folded
        table.add_column(
            stacked(titles[column]) if is_number else escape(column.replace(".", ".\n")),
            justify="right" if is_number else "left",
            no_wrap=is_number,
            overflow="fold",
        )
    for row in rows:
        style = {"unfinished": "red", "baseline": "dim"}.get(row["status"])
        table.add_row(*(escape(_text(row.get(column), "\n")) for column in columns), style=style)
    return table


def _speed(runs: list[Run], rows: list[dict], shared: Mapping, titles: Mapping[str, str]) -> Figure:
    done = [(run, row) for run, row in zip(runs, rows, strict=False) if run.metrics is not None]
    metric = next(iter(titles))
    names = [
        " ".join(f"{key}={value}" for key, value in run.overrides.items() if key not in shared) or row["model"]
        for run, row in done
    ]
    if len(set(names)) < len(names):
        names = [run.name for run, _ in done]
    number = lambda key: np.array([np.nan if row.get(key) is None else row[key] for _, row in done], float)
    times = {"inference [ms a transmitter]": number("inference_ms"), "training [s]": number("train_seconds")}
    baselines = {f"{row['model']} {row.get('split', '')}".strip(): row[metric] for row in rows[len(runs) :]}
    return speed_against_error(names, number(metric), times, titles[metric], baselines)
