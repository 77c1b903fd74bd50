"""Runs of several models as one table: published figures next to ours, times and sizes."""

import math
import zipfile
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from rich.markup import escape
from rich.table import Table

from gaigs.core.task import Metric
from gaigs.io.files import write_text
from gaigs.report.curves import learning_curves
from gaigs.report.predictions import as_baseline
from gaigs.report.published import read_published
from gaigs.report.run_figures import figures_of
from gaigs.report.run_folders import Run, by_seed
from gaigs.report.scores import COSTS, monitor_names, task_class, train_seconds
from gaigs.report.style import save
from gaigs.report.table import Spread, best_in_bold, markdown, terminal, write_csv, written
from gaigs.report.training_log import read_validations


class System(NamedTuple):
    """A row of the table of systems: runs that differ only in the seed, or a baseline."""

    model: str  # registered name
    name: str  # name in tables and figures
    runs: Sequence[Run]  # runs that ended, one a seed; empty for a baseline
    values: dict[str, list[float]]  # values of each metric and cost, one a run
    failures: Sequence[str] = ()  # seed and cause of each run that has not ended
    is_varied: bool = False  # True if its runs differ from others in more than model and seed


def find_systems(
    runs: Sequence[Run], baselines: Sequence[Mapping], shared: Mapping, names: Mapping
) -> list[System]:
    """Rows of the comparison table: runs (one row for all seeds), then baselines.

    A baseline is omitted if a run of the same model has the same printed scores.

    Args:
        baselines, shared: Results of ``gaigs.report.ablation``.
        names: Displayed names by registered names, in the order of the rows.
    """
    systems = [_system(group, shared, names) for group in by_seed(runs)]
    order = {model: place for place, model in enumerate(names)}
    systems.sort(key=lambda system: (order.get(system.model, len(order)), system.name))
    values = {system.model: system.values for system in systems}
    for row in baselines:
        model = row["model"]
        scores = {key: [value] for key, value in row.items() if isinstance(value, float)}
        system_scores = values.get(model, {})
        common = system_scores.keys() & scores.keys()
        # A baseline that is a system, too, has one row if all scores are printed alike.
        alike = [written(system_scores[key][0]) == written(scores[key][0]) for key in common]
        if not (system_scores and all(alike)):
            name = as_baseline(model) if model in values else model
            title = " ".join(filter(None, (name, row.get("split"))))
            systems.append(System(model, title, [], scores))
    return systems


def _system(group: Sequence[Run], shared: Mapping, names: Mapping) -> System:
    """The row of runs that differ only in the seed; its name omits ``shared`` settings."""
    overrides = group[0].overrides
    # If a seed was run twice, in two multiruns, the first run counts: in the reversed order it
    # replaces the later one.
    ended = {run.metrics["seed"]: run for run in reversed(group) if run.metrics is not None}
    runs = [ended[seed] for seed in sorted(ended)]
    model = overrides.get("model")
    if not model:
        model = next(iter(runs[0].metrics["models"])) if runs else group[0].name
    usual = ("model", "seed", *shared)
    varied = [f"{key}={value}" for key, value in overrides.items() if key not in usual]
    values: dict[str, list[float]] = {}
    for run in runs:
        scores = next(iter(run.metrics["models"].values()))  # the run's model, before baselines
        for key, value in (scores | _costs(run.metrics)).items():
            if value is not None:
                values.setdefault(key, []).append(value)
    failures = []
    for run in group:
        if run.metrics is None:
            seed = run.overrides.get("seed") if len(group) > 1 else None
            cause = run.failure or "unfinished"
            failures.append(f"seed {seed}: {cause}" if seed else cause)
    name = " ".join([names.get(model, model), *varied])
    return System(model, name, runs, values, failures, is_varied=bool(varied))


def _costs(metrics: Mapping) -> dict[str, float | None]:
    """Costs of one run; 0 Gaussians become None."""
    costs = {key: metrics.get(key) for key in COSTS}
    costs["train_seconds"] = train_seconds(metrics)
    costs["num_gaussians"] = costs["num_gaussians"] or None
    if costs["checkpoint_bytes"] is not None:
        costs["checkpoint_bytes"] /= 1e6
    return costs


def _cells(
    systems: Sequence[System], published: Sequence[Mapping], titles: Mapping[str, str]
) -> list[dict]:
    """Rows by title: published figures, then measured values; titles without values are omitted.

    Published figures apply only to runs in their default setting.

    Args:
        published: Columns from ``read_published``.
        titles: Titles of metrics or costs by name.
    """
    rows = []
    for system in systems:
        row: dict[str, float | Spread | None] = {}
        is_usual = system.runs and not system.is_varied
        for column in published:
            figure = column["figures"].get(system.model) if is_usual else None
            row[f"published {column['title']}"] = figure
        for key, title in titles.items():
            values = system.values.get(key, ())
            row[title] = Spread.of(values) if len(values) > 1 else next(iter(values), None)
        rows.append(row)
    for title in [*rows[0]]:
        if all(row[title] is None for row in rows):
            for row in rows:
                del row[title]
    return rows


def _lines(
    names: Sequence[str],
    rows: Sequence[Mapping],
    metrics: Mapping[str, Metric],
    bold: str = "[bold]{}[/bold]",
) -> list[list[str]]:
    """Lines of a table as text, names first.

    The best value of a metric is bold if at least two systems have the metric.
    """
    known = {metric.title: metric for metric in metrics.values()}
    columns: list[Sequence[str]] = [names]
    for title in rows[0]:
        values = [row[title] for row in rows]
        if title in known and sum(value is not None for value in values) > 1:
            columns.append(best_in_bold(values, known[title].higher_is_better, bold))
        else:
            columns.append([written(value) for value in values])
    return [[*line] for line in zip(*columns, strict=True)]


def write_systems(
    folder: Path,
    runs: Sequence[Run],
    baselines: Sequence[Mapping],
    shared: Mapping,
    metrics: Mapping[str, Metric],
) -> Table | None:
    """Writes ``systems.md``, ``systems.csv`` and the figures that compare the systems.

    Args:
        baselines, shared: Results of ``gaigs.report.ablation``.
        metrics: Metrics of the task by name.

    Returns:
        A table for a terminal. None if fewer than two models have a finished run; no file is then
        written.
    """
    published = read_published()
    systems = find_systems(runs, baselines, shared, published["names"])
    done = [system for system in systems if system.runs]
    if len({system.model for system in done}) < 2:
        return None
    task = done[0].runs[0].metrics["task"]
    failed = []
    for system in systems:
        failed += [f"{system.name}: {failure}" for failure in system.failures]
    systems = [system for system in systems if system.values]
    titles = {name: metric.title for name, metric in metrics.items()}
    published_scores = published["scores"].get(task, [])
    published_costs = published["costs"].get(task, [])
    scores = _cells(systems, published_scores, titles)
    costs = _cells(systems, published_costs, COSTS)
    rows = [row | row_costs for row, row_costs in zip(scores, costs, strict=True)]

    heads = [{"system": system.name, "model": system.model} for system in systems]
    lines = [head | row for head, row in zip(heads, rows, strict=True)]
    write_csv(folder / "systems.csv", lines, (", sd",))
    names = [system.name for system in systems]
    page = ""
    for table in (scores, costs):
        cells = _lines(names, table, metrics, bold="**{}**")
        page += f"{markdown([['system', *table[0]], *cells])}\n"
    page += ", ".join(f"{key}={value}" for key, value in shared.items()) + "\n"
    for column in (*published_scores, *published_costs):
        page += f"- published {column['title']}: {column['source']}\n"
    page += "".join(f"- without a result: {failure}\n" for failure in failed)
    write_text(folder / "systems.md", page)
    for name, figure in _figures(done, task, metrics).items():
        save(figure, folder / f"systems_{name}.png")
    terminal_titles = _brief(scores[0], costs[0], metrics)  # a terminal has less room
    terminal_rows = []
    for row in rows:
        terminal_rows.append({title: row[title] for title in terminal_titles})
    cells = _lines([escape(name) for name in names], terminal_rows, metrics)
    caption = "".join(f"{failure}\n" for failure in failed) + "all columns in systems.md"
    styles = [None if system.runs else "dim" for system in systems]
    heads = {"system": False} | dict.fromkeys(terminal_titles, True)  # True for numbers
    return terminal("Systems", heads, cells, caption, styles)


def _brief(scores: Mapping, costs: Mapping, metrics: Mapping[str, Metric]) -> list[str]:
    """Titles of the columns on a terminal: a published score, brief metrics and three costs."""
    published = [title for title in scores if title.startswith("published ")]
    measured = [metric.title for metric in metrics.values() if metric.is_brief]
    spent = [COSTS[key] for key in ("train_seconds", "inference_ms", "num_parameters")]
    columns = published[-1:]
    columns += [title for title in measured if title in scores]
    return columns + [title for title in spent if title in costs]


def _figures(
    systems: Sequence[System], task: str, metrics: Mapping[str, Metric]
) -> dict[str, Figure]:
    """Figures that compare one run of each system, by name; none if the splits differ.

    The task's figures are drawn if all runs have the same test links. Validation scores over time
    are drawn for runs whose log has times.
    """
    runs = _first_seeds(systems)  # one for each system
    splits = {run.metrics["split"] for run in runs.values()}
    if len(splits) > 1:
        return {}
    figures: dict[str, Figure] = {}
    kind = task_class(task)
    files = {name: run.folder / "predictions.npz" for name, run in runs.items()}
    files = {name: file for name, file in files.items() if file.is_file()}
    if _have_same_labels([*files.values()]):
        figures |= figures_of(kind).of_systems(kind, files, *splits)
    monitor, mean = monitor_names(task)
    curves = {}
    for name, run in runs.items():
        validations = read_validations(run.folder, monitor)
        timed = [validation for validation in validations if math.isfinite(validation.seconds)]
        if timed:
            times = tuple(validation.seconds for validation in timed)
            curves[name] = times, tuple(validation.score for validation in timed)
    if curves and mean is not None:
        scores = _baseline_scores(runs, [*curves], mean)
        figures["curves"] = learning_curves(curves, scores, metrics[mean])
    return figures


def _first_seeds(systems: Sequence[System]) -> dict[str, Run]:
    """One run of each system by name: of the lowest seed of all systems, or else the first."""
    counts: Counter[int] = Counter()
    for system in systems:
        counts.update({run.metrics["seed"] for run in system.runs})
    seed = min((seed for seed in counts if counts[seed] == len(systems)), default=None)
    runs = {}
    for system in systems:
        same = (run for run in system.runs if run.metrics["seed"] == seed)
        runs[system.name] = next(same, system.runs[0])
    return runs


def _have_same_labels(files: Sequence[Path]) -> bool:
    """True if all ``predictions.npz`` have the same labels, thus the same test links."""
    labels = set()
    for file in files:
        try:
            # Numpy would not close a damaged file.
            with file.open("rb") as stream, np.load(stream) as arrays:
                labels.add(hash(arrays["labels"].tobytes()))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return False
    return len(labels) == 1


def _baseline_scores(
    runs: Mapping[str, Run], drawn: Sequence[str], metric: str
) -> dict[str, float]:
    """Validation scores of the baselines by name, from the first run that has any.

    Models that have a curve are left out.

    Args:
        drawn: Names of the systems with a curve.
    """
    models = {next(iter(runs[name].metrics["models"])) for name in drawn}
    models |= {f"{model}_trend" for model in models}  # a run's model without its kriging
    validations = (run.metrics.get("validation") for run in runs.values())
    validation: dict[str, dict] = next(filter(None, validations), {})
    return {name: scores[metric] for name, scores in validation.items() if name not in models}
