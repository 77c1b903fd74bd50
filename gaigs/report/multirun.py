"""The runs of a Hydra multirun, or of several: one table, their spread over seeds, their speed
against their error.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.console import Group
from rich.markup import escape
from rich.table import Table

from gaigs.io.files import write_text
from gaigs.report import systems
from gaigs.report.claims import write_claims
from gaigs.report.curves import speed_against_error
from gaigs.report.runs import Run, by_seed, read_runs, train_seconds
from gaigs.report.style import save
from gaigs.report.table import (
    Spread,
    columns_of,
    markdown,
    task_class,
    terminal,
    write_csv,
    written,
)

COSTS = {
    key: systems.COSTS[key]
    for key in ("train_seconds", "num_gaussians", "num_parameters", "inference_ms")
}
"""Titles of the costs in a table of runs."""

INTERVALS = {
    "coverage_50": "within 50 %",
    "coverage_50_error": "standard error of it",
    "coverage_90": "within 90 %",
    "coverage_90_error": "standard error of it",
    "width_90": "width of 90 %",
    "crps": "CRPS",
    "nll": "NLL",
    "calibration_links": "calibrating links",
}
"""Titles of the scores of intervals."""

SEEDS = "Runs that differ in the seed alone: mean ± standard deviation (n - 1), and the least"


def ablation(runs: list[Run]) -> tuple[list[dict], dict]:
    """Rows of the table: runs, then their baselines, once for each split; and the settings that all
    runs share.
    """
    shared: dict[str, object] = {}

    def differing(keys: Sequence[str], sources: Sequence[Mapping]) -> list[str]:
        values = {key: {source.get(key, "") for source in sources} for key in keys}
        shared.update({key: next(iter(found)) for key, found in values.items() if len(found) == 1})
        return [key for key, found in values.items() if len(found) != 1]

    typed = [run.overrides for run in runs]
    varied = differing(columns_of(typed), typed)
    facts = differing(
        ("split", "seed", "device"), [run.metrics for run in runs if run.metrics is not None]
    )

    rows, baselines = [], {}
    for name, overrides, metrics, *_ in runs:
        row = {"run": name, "status": "unfinished", "model": ""} | {
            key: overrides.get(key, "") for key in varied
        }
        if metrics is not None:
            (own, scores), *others = metrics["models"].items()
            row |= {"status": "done", "model": row["model"] or own} | {
                key: metrics[key] for key in facts
            }
            row |= (
                scores
                | {key: metrics.get(key) for key in COSTS}
                | {"train_seconds": train_seconds(metrics)}
            )
            for model, scores in others:
                if model == f"{own}_trend":  # the run's own model without its kriging
                    continue
                baseline = {"status": "baseline", "model": model} | scores
                if "split" in facts:
                    baseline["split"] = metrics["split"]
                # As text: two devices give scores that differ in the last bits.
                baselines[tuple(written(value) for value in baseline.values())] = baseline
        rows.append(row)
    return rows + list(baselines.values()), shared


def over_seeds(runs: list[Run], shared: Mapping) -> list[dict]:
    """Rows of groups of runs that differ in ``seed`` alone, where two seeds or more have ended."""
    done = [run for run in runs if run.metrics is not None]
    varied = [
        key
        for key in columns_of([run.overrides for run in done])
        if key != "seed" and key not in shared
    ]
    rows = []
    for group in by_seed(done):
        found = [run.metrics for run in group]
        if len({metrics["seed"] for metrics in found}) < 2:
            continue
        scores = [next(iter(metrics["models"].values())) for metrics in found]
        row = {"status": "seeds", "model": next(iter(found[0]["models"]))}
        row |= {key: group[0].overrides.get(key, "") for key in varied}
        if "split" not in shared:
            splits = {metrics["split"] for metrics in found}
            row["split"] = splits.pop() if len(splits) == 1 else f"{len(splits)} splits"
        row["runs"] = len(group)
        common = [name for name in scores[0] if all(name in score for score in scores)]
        rows.append(row | {name: Spread.of([score[name] for score in scores]) for name in common})
    return rows


def report(folder: str | Path) -> Group:
    """Writes ``ablation.csv``, ``ablation.md`` and, if a run has ended, ``speed_against_error.png``
    into a folder.

    Runs of several models also get the files of ``gaigs.report.systems``, and runs of variants
    those of ``gaigs.report.claims``. Runs of several tasks get the latter only.

    Args:
        folder: Folder of a Hydra multirun, or one above several.

    Returns:
        The tables, for a terminal of 80 columns. Metrics that are not brief are in the files only.

    Raises:
        FileNotFoundError: The folder holds no run.
        ValueError: A file is damaged, or the runs are of several tasks.
    """
    folder = Path(folder)
    runs = read_runs(folder)
    claims = write_claims(folder, runs)
    tasks = {run.metrics["task"]: run.name for run in runs if run.metrics is not None}
    if len(tasks) > 1:
        if claims is not None:
            return Group(claims)
        listed = ", ".join(f"{task} in {name}" for task, name in tasks.items())
        raise ValueError(
            f"the runs of a table must be of one task, got {listed}; pass a folder with runs of one"
        )
    known = task_class(next(iter(tasks))).metrics() if tasks else {}
    titles = {name: metric.title for name, metric in known.items()} | INTERVALS | COSTS
    rows, shared = ablation(runs)
    groups = over_seeds(runs, shared)
    caption = ", ".join(f"{key}={value}" for key, value in shared.items())
    failures = [f"{run.name}: {run.failure}" for run in runs if run.failure is not None]
    doubts = [f"{run.name}: {doubt}" for run in runs for doubt in run.doubts]

    write_csv(folder / "ablation.csv", rows + groups, ("_sd", "_least"))
    page = f"{_markdown(rows, titles)}\n{caption}\n" + "".join(
        f"- without a result: {why}\n" for why in failures
    )
    page += "".join(f"- {doubt}\n" for doubt in doubts)
    if groups:
        page += f"\n{SEEDS}\n\n{_markdown(groups, titles)}"
    write_text(folder / "ablation.md", page)
    if known:
        save(_speed(runs, rows, shared, titles), folder / "speed_against_error.png")

    hidden = {name for name, metric in known.items() if not metric.is_brief} | {"num_gaussians"}
    hidden |= INTERVALS.keys() - {"coverage_90"}
    if not any(row["status"] == "unfinished" for row in rows):
        hidden.add("status")
    varied = [[value for key, value in run.overrides.items() if key not in shared] for run in runs]
    if all(varied.count(values) == 1 for values in varied):
        hidden.add("run")  # its name would repeat the varied overrides
    caption = "\n".join([*failures, *doubts, f"{caption}; all columns in ablation.md"])
    tables = [_terminal(f"Runs of {folder}", rows, titles, hidden, caption)]
    if groups:
        about = f"{SEEDS}; all columns in ablation.md"
        tables.append(_terminal("Over seeds", groups, titles, hidden | {"status"}, about))
    baselines = [row for row in rows if row["status"] == "baseline"]
    of_systems = systems.write_systems(folder, runs, baselines, shared, known)
    return Group(*tables, *(table for table in (of_systems, claims) if table is not None))


def _speed(runs: list[Run], rows: list[dict], shared: Mapping, titles: Mapping[str, str]) -> Figure:
    metric = next(iter(titles))
    done = [(run, row) for run, row in zip(runs, rows, strict=False) if run.metrics is not None]
    varied = [
        {key: value for key, value in run.overrides.items() if key not in shared} for run, _ in done
    ]
    names = [" ".join(f"{key}={value}" for key, value in overrides.items()) for overrides in varied]
    if "" in names or len(set(names)) < len(names):
        names = [run.name for run, _ in done]
    numbers = lambda key: np.array(
        [np.nan if row.get(key) is None else row[key] for _, row in done], float
    )
    times = {
        "inference [ms a transmitter]": numbers("inference_ms"),
        "training [s]": numbers("train_seconds"),
    }
    baselines = {
        f"{row['model']} {row.get('split', '')}".strip(): row[metric] for row in rows[len(runs) :]
    }
    models = [row["model"] for _, row in done]
    return speed_against_error(names, numbers(metric), times, titles[metric], baselines, models)


def _text(value: float | int | str | Spread | None, between: str) -> str:
    return written(value) + (
        f"{between}least {written(value.least)}" if isinstance(value, Spread) else ""
    )


def _markdown(rows: list[dict], titles: Mapping[str, str]) -> str:
    columns = columns_of(rows)
    cells = [[_text(row.get(column), ", ") for column in columns] for row in rows]
    return markdown([[titles.get(column, column) for column in columns], *cells])


def _terminal(
    title: str, rows: list[dict], titles: Mapping[str, str], hidden: set[str], caption: str
) -> Table:
    columns = [column for column in columns_of(rows) if column not in hidden]
    heads = {titles.get(column, column.replace(".", ".\n")): column in titles for column in columns}
    lines = [[escape(_text(row.get(column), "\n")) for column in columns] for row in rows]
    styles = [{"unfinished": "red", "baseline": "dim"}.get(row["status"]) for row in rows]
    return terminal(title, heads, lines, caption, styles)
