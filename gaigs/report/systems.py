"""Runs of several models as one table: published figures beside ours, times and sizes."""

import math
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import yaml
from matplotlib.figure import Figure
from rich.markup import escape
from rich.table import Table

from gaigs.configuration import conf_dir, plugin_conf_dirs
from gaigs.io.files import write_text
from gaigs.report.curves import learning_curves, read_validations
from gaigs.report.run_figures import figures_of
from gaigs.report.runs import Run, as_baseline, by_seed, train_seconds
from gaigs.report.style import save
from gaigs.report.table import (
    Spread,
    markdown,
    monitor_names,
    task_class,
    terminal,
    write_csv,
    written,
)

COSTS = {
    "train_seconds": "training [s]",
    "inference_ms": "inference [ms]",
    "render_ms": "rendering [ms]",
    "num_parameters": "parameters",
    "num_gaussians": "Gaussians",
    "checkpoint_bytes": "checkpoint [MB]",
}
"""Titles of the costs in ``metrics.json``, in the order of the table."""


class System(NamedTuple):
    """A row of the table.

    Attributes:
        model: Registered name.
        name: Name for a reader.
        runs: Runs that ended, one a seed; empty for a baseline.
        values: Values of each metric and cost, one a run.
        failures: Seed and cause of each run that has not ended.
        varied: True if its runs differ from others in more than model and seed.
    """

    model: str
    name: str
    runs: list[Run]
    values: dict[str, list[float]]
    failures: Sequence[str] = ()
    varied: bool = False


def read_published() -> dict[str, dict]:
    """Contents of ``published.yaml`` of gaigs and of plug-ins; a ValueError for a file of another
    form.

    ``names`` of models are in the order of the rows. ``scores`` and ``costs`` have for each task
    columns with ``title``, ``source``, and ``figures`` by model.
    """
    found: dict[str, dict] = {"names": {}, "scores": {}, "costs": {}}
    for file in (folder / "published.yaml" for folder in (conf_dir(), *plugin_conf_dirs())):
        if not file.is_file():
            continue
        try:
            content = yaml.safe_load(file.read_text())
            found["names"].update(content.get("names", {}))
            for part in ("scores", "costs"):
                for task, columns in content.get(part, {}).items():
                    columns = [
                        {key: column[key] for key in ("title", "source", "figures")}
                        for column in columns
                    ]
                    found[part].setdefault(task, []).extend(columns)
        except (AttributeError, KeyError, TypeError, ValueError, yaml.YAMLError) as error:
            raise ValueError(
                f"{file} must have the form of conf/published.yaml: {error!r}"
            ) from error
    return found


def find_systems(
    runs: Sequence[Run], baselines: Sequence[Mapping], shared: Mapping, names: Mapping
) -> list[System]:
    """Rows of the table. Runs that differ in the seed alone are one row. Baselines that are not
    systems come last.
    """
    rows = []
    for group in by_seed(runs):
        overrides = group[0].overrides
        # A seed that was run twice, in two multiruns, counts once.
        ended = {run.metrics["seed"]: run for run in reversed(group) if run.metrics is not None}
        done = [ended[seed] for seed in sorted(ended)]
        model = overrides.get("model") or (
            next(iter(done[0].metrics["models"])) if done else group[0].name
        )
        varied = [
            f"{key}={overrides[key]}" for key in overrides if key not in ("model", "seed", *shared)
        ]
        values: dict[str, list[float]] = {}
        for run in done:
            for key, value in (
                next(iter(run.metrics["models"].values())) | _costs(run.metrics)
            ).items():
                if value is not None:
                    values.setdefault(key, []).append(value)
        failures = []
        for run in group:
            if run.metrics is None:
                seed = (
                    f"seed {run.overrides['seed']}: "
                    if len(group) > 1 and run.overrides.get("seed")
                    else ""
                )
                failures.append(f"{seed}{run.failure or 'unfinished'}")
        name = " ".join([names.get(model, model), *varied])
        rows.append(System(model, name, done, values, failures, bool(varied)))
    order = [*names]
    rows.sort(
        key=lambda row: (order.index(row.model) if row.model in order else len(order), row.name)
    )
    own = {row.model: row.values for row in rows}
    for row in baselines:
        scores = {key: [value] for key, value in row.items() if isinstance(value, float)}
        same = own.get(row["model"], {})
        if same and all(
            written(same[key][0]) == written(values[0])
            for key, values in scores.items()
            if key in same
        ):
            continue
        name = as_baseline(row["model"]) if row["model"] in own else row["model"]
        rows.append(
            System(row["model"], " ".join(filter(None, (name, row.get("split")))), [], scores)
        )
    return rows


def _costs(metrics: Mapping) -> dict[str, float | None]:
    """Costs of one run; 0 Gaussians become None."""
    costs = {key: metrics.get(key) for key in COSTS} | {"train_seconds": train_seconds(metrics)}
    costs["num_gaussians"] = costs["num_gaussians"] or None
    if costs["checkpoint_bytes"] is not None:
        costs["checkpoint_bytes"] /= 1e6
    return costs


def _cells(
    systems: Sequence[System], published: Sequence[Mapping], titles: Mapping[str, str]
) -> list[dict]:
    """Rows by title: published figures of systems in their usual setting, then ours; empty columns
    are left out.
    """
    rows = []
    for system in systems:
        figures = {
            f"published {column['title']}": column["figures"].get(system.model)
            for column in published
        }
        if not system.runs or system.varied:
            figures = dict.fromkeys(figures)
        ours = {title: system.values.get(key, ()) for key, title in titles.items()}
        rows.append(
            figures
            | {
                title: Spread.of(v) if len(v) > 1 else next(iter(v), None)
                for title, v in ours.items()
            }
        )
    return [
        {
            title: value
            for title, value in row.items()
            if any(other[title] is not None for other in rows)
        }
        for row in rows
    ]


def _texts(rows: Sequence[Mapping], better: Mapping[str, bool], bold: str) -> list[list[str]]:
    """Lines of a table as text, in the format ``bold`` all that print as the best of a column with
    an entry in ``better``."""
    mean = lambda value: value.mean if isinstance(value, Spread) else value
    best = {}
    for title in better.keys() & rows[0].keys():
        means = [mean(row[title]) for row in rows if row[title] is not None]
        best[title] = written((max if better[title] else min)(means)) if len(means) > 1 else None

    def text(title: str, value: Any) -> str:
        is_best = value is not None and written(mean(value)) == best.get(title)
        return bold.format(written(value)) if is_best else written(value)

    return [[text(title, value) for title, value in row.items()] for row in rows]


def write_systems(
    folder: Path, runs: Sequence[Run], baselines: Sequence[Mapping], shared: Mapping, known: Mapping
) -> Table | None:
    """Writes ``systems.md``, ``systems.csv`` and the figures that compare the systems.

    ``baselines`` and ``shared`` are results of ``gaigs.report.multirun.ablation``, ``known`` the
    metrics of the task. The result is None, and there are no files, unless runs of several models
    have ended.
    """
    published = read_published()
    systems = find_systems(runs, baselines, shared, published["names"])
    done = [system for system in systems if system.runs]
    if len({system.model for system in done}) < 2:
        return None
    task = done[0].runs[0].metrics["task"]
    failed = [f"{system.name}: {failure}" for system in systems for failure in system.failures]
    systems = [system for system in systems if system.values]
    columns = [published[part].get(task, []) for part in ("scores", "costs")]
    better = {metric.title: metric.higher_is_better for metric in known.values()}
    titles = {name: metric.title for name, metric in known.items()}
    scores, costs = (
        _cells(systems, *parts) for parts in zip(columns, (titles, COSTS), strict=True)
    )

    lines = [*zip(systems, scores, costs, strict=True)]
    rows = [{"system": system.name, "model": system.model} | a | b for system, a, b in lines]
    write_csv(folder / "systems.csv", rows, (", sd",))
    notes = [", ".join(f"{key}={value}" for key, value in shared.items())]
    notes += [
        f"- published {column['title']}: {column['source']}" for part in columns for column in part
    ]
    notes += [f"- without a result: {failure}" for failure in failed]
    pages = []
    for part in (scores, costs):
        rows = [{"system": system.name} | row for system, row in zip(systems, part, strict=True)]
        pages.append(markdown([[*rows[0]], *_texts(rows, better, "**{}**")]))
    write_text(folder / "systems.md", "\n".join([*pages, *notes]) + "\n")
    for name, figure in _figures(done, task, known).items():
        save(figure, folder / f"systems_{name}.png")

    brief = [title for title in scores[0] if title.startswith("published ")][-1:]
    brief += [
        metric.title for metric in known.values() if metric.is_brief and metric.title in scores[0]
    ]
    brief += [
        COSTS[key]
        for key in ("train_seconds", "inference_ms", "num_parameters")
        if COSTS[key] in costs[0]
    ]
    rows = [
        {"system": escape(system.name)} | {title: (a | b)[title] for title in brief}
        for system, a, b in lines
    ]
    caption = "".join(f"{failure}\n" for failure in failed) + "all columns in systems.md"
    styles = [None if system.runs else "dim" for system in systems]
    heads = {"system": False} | dict.fromkeys(brief, True)
    return terminal("Systems", heads, _texts(rows, better, "[bold]{}[/bold]"), caption, styles)


def _figures(rows: Sequence[System], task: str, known: Mapping) -> dict[str, Figure]:
    """The task's figures of several systems, if they share the test links, and the validation
    scores over time.
    """
    shared = set.intersection(*({run.metrics["seed"] for run in row.runs} for row in rows))
    firsts = {
        row.name: next(
            (run for run in row.runs if run.metrics["seed"] == min(shared, default=None)),
            row.runs[0],
        )
        for row in rows
    }
    splits = {run.metrics["split"] for run in firsts.values()}
    if len(splits) > 1:
        return {}
    figures: dict[str, Figure] = {}
    kind = task_class(task)
    files = {name: run.folder / "predictions.npz" for name, run in firsts.items()}
    files = {name: file for name, file in files.items() if file.is_file()}
    labels = set()  # the same labels: the same test links
    for file in files.values():
        try:
            with (
                file.open("rb") as stream,
                np.load(stream) as run,
            ):  # numpy would not close a damaged file
                labels.add(hash(run["labels"].tobytes()))
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            labels.add(file)  # like no other: no figure
    if len(labels) == 1:
        figures |= figures_of(kind).of_systems(kind, files, *splits)
    monitor, mean = monitor_names(task)
    curves = {}
    for name, run in firsts.items():
        if points := [
            point for _, *point in read_validations(run.folder, monitor) if math.isfinite(point[0])
        ]:
            curves[name] = tuple(zip(*points, strict=True))
    if curves and mean is not None:
        own = {next(iter(firsts[name].metrics["models"])) for name in curves}
        own |= {f"{name}_trend" for name in own}  # a run's own model without its kriging
        validations = (run.metrics.get("validation") for run in firsts.values())
        validation: dict[str, dict] = next(filter(None, validations), {})
        lines = {name: scores[mean] for name, scores in validation.items() if name not in own}
        figures["curves"] = learning_curves(curves, lines, known[mean])
    return figures
