"""Runs of several models as one table in the form of the paper's: published figures beside ours, times and sizes."""

import csv
import math
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from gaigs.configuration import conf_dir, plugin_conf_dirs
from gaigs.io.files import atomic_write, write_text
from gaigs.registry import registry
from gaigs.report.curves import learning_curves, read_validations
from gaigs.report.runs import Run, Spread, as_baseline, train_seconds
from gaigs.report.style import DPI
from gaigs.report.table import latex, markdown, monitor_names, stacked, tex, written

COSTS = {
    "train_seconds": "training [s]",
    "inference_ms": "inference [ms]",
    "render_ms": "rendering [ms]",
    "num_parameters": "parameters",
    "num_gaussians": "Gaussians",
    "checkpoint_bytes": "checkpoint [MB]",
}
"""What a reader calls the costs of ``metrics.json``, in the order of the table."""

BRIEF = ("train_seconds", "inference_ms", "num_parameters")
"""The costs for which a terminal has room."""


class Published(NamedTuple):
    """What publications report.

    Attributes:
        names: What readers call models, by registered name; in the order of the rows.
        scores, costs: For each task columns with ``title``, ``source``, and ``figures`` by model.
    """

    names: dict[str, str]
    scores: dict[str, list[dict]]
    costs: dict[str, list[dict]]


class System(NamedTuple):
    """A row of the table.

    Attributes:
        model: Registered name.
        name: What a reader calls it.
        runs: Those that ended, one a seed; none of a baseline.
        values: Of each metric and cost, one a run; a baseline has one of each metric.
        failures: Of each run that has not ended, its seed where several vary, and why.
        varied: Whether more than model and seed tell its runs from others.
    """

    model: str
    name: str
    runs: list[Run]
    values: dict[str, list[float]]
    failures: Sequence[str] = ()
    varied: bool = False


class Column(NamedTuple):
    """A column of numbers, one a row, None where there is none; ``higher_is_better`` is None where none is best."""

    title: str
    values: list[float | int | Spread | None]
    higher_is_better: bool | None = None


def read_published() -> Published:
    """What ``published.yaml`` holds in the configuration folder of gaigs and in those of plug-ins.

    Raises:
        ValueError: A file does not have the form of gaigs's own.
    """
    found = Published({}, {}, {})
    for file in (folder / "published.yaml" for folder in (conf_dir(), *plugin_conf_dirs())):
        if not file.is_file():
            continue
        try:
            content = yaml.safe_load(file.read_text())
            found.names.update(content.get("names", {}))
            for there, here in ((found.scores, content.get("scores", {})), (found.costs, content.get("costs", {}))):
                for task, columns in here.items():
                    parts = ({key: column[key] for key in ("title", "source", "figures")} for column in columns)
                    there[task] = [*there.get(task, []), *parts]
        except (AttributeError, KeyError, TypeError, ValueError, yaml.YAMLError) as error:
            raise ValueError(f"{file} must have the form of conf/published.yaml: {error!r}") from error
    return found


def find_systems(runs: Sequence[Run], baselines: Sequence[Mapping], shared: Mapping, names: Mapping) -> list[System]:
    """Rows of the table. Runs that differ in the seed alone are one; baselines that are no system there stand last.

    Args:
        runs: Of the multirun.
        baselines: Rows of ``gaigs.report.multirun.ablation``.
        shared: What the runs have in common.
        names: What readers call models.
    """
    groups: dict[frozenset, list[Run]] = {}
    for run in runs:
        fixed = frozenset((key, value) for key, value in run.overrides.items() if key != "seed")
        groups.setdefault(fixed, []).append(run)
    rows = []
    for group in groups.values():
        overrides = group[0].overrides
        # A seed that was run twice, in two multiruns, counts once.
        ended = {run.metrics["seed"]: run for run in reversed(group) if run.metrics is not None}
        done = [ended[seed] for seed in sorted(ended)]
        model = overrides.get("model") or (next(iter(done[0].metrics["models"])) if done else group[0].name)
        varied = [f"{key}={overrides[key]}" for key in overrides if key not in ("model", "seed", *shared)]
        values: dict[str, list[float]] = {}
        for run in done:
            for key, value in (next(iter(run.metrics["models"].values())) | _costs(run.metrics)).items():
                if value is not None:
                    values.setdefault(key, []).append(value)
        failures = [
            f"{f'seed {seed}: ' if (seed := run.overrides.get('seed')) and len(group) > 1 else ''}"
            f"{run.failure or 'unfinished'}"
            for run in group
            if run.metrics is None
        ]
        name = " ".join([names.get(model, model), *varied])
        rows.append(System(model, name, done, values, failures, bool(varied)))
    order = [*names]
    rows.sort(key=lambda row: (order.index(row.model) if row.model in order else len(order), row.name))
    own = {row.model: row.values for row in rows}
    for row in baselines:
        scores = {key: [value] for key, value in row.items() if isinstance(value, float)}
        same = own.get(row["model"], {})
        if same and all(written(same[key][0]) == written(values[0]) for key, values in scores.items() if key in same):
            continue
        name = as_baseline(row["model"]) if row["model"] in own else row["model"]
        rows.append(System(row["model"], " ".join(filter(None, (name, row.get("split")))), [], scores))
    return rows


def _costs(metrics: Mapping) -> dict[str, float | None]:
    """Those of one run; no Gaussians are none."""
    costs = {key: metrics.get(key) for key in COSTS} | {"train_seconds": train_seconds(metrics)}
    costs["num_gaussians"] = costs["num_gaussians"] or None
    if costs["checkpoint_bytes"] is not None:
        costs["checkpoint_bytes"] /= 1e6
    return costs


def _columns(rows: Sequence[System], titles: Mapping[str, str], better: Mapping[str, bool]) -> list[Column]:
    """Ours, of metrics or of costs; one that no row has is left out."""
    columns = []
    for key, title in titles.items():
        found = [row.values.get(key) for row in rows]
        if any(found):
            columns.append(Column(title, [values and _value(values) for values in found], better.get(key)))
    return columns


def _value(values: list[float]) -> float | Spread:
    return Spread.of(values) if len(values) > 1 else values[0]


def _published(rows: Sequence[System], columns: Sequence[Mapping]) -> list[Column]:
    """Those of publications, of systems as they are, not of ones that were varied; a title stands for what it is of."""
    found = []
    for column in columns:
        figures = [column["figures"].get(row.model) if row.runs and not row.varied else None for row in rows]
        if any(figure is not None for figure in figures):
            found.append(Column(f"published {column['title']}", figures))
    return found


def _texts(column: Column) -> list[tuple[str, bool]]:
    """The cells of a column, and whether each is the best."""
    means = [value.mean if isinstance(value, Spread) else value for value in column.values]
    known = [mean for mean in means if mean is not None]
    best = None
    if column.higher_is_better is not None and len(known) > 1:
        best = (max if column.higher_is_better else min)(known)
    texts = []
    for value, mean in zip(column.values, means, strict=True):
        spread = f" ± {written(value.deviation)}" if isinstance(value, Spread) else ""
        texts.append(("" if mean is None else f"{written(mean)}{spread}", mean is not None and mean == best))
    return texts


def _markdown(rows: Sequence[System], columns: Sequence[Column]) -> str:
    cells = [[f"**{text}**" if best else text for text, best in _texts(column)] for column in columns]
    lines = ([row.name, *texts] for row, *texts in zip(rows, *cells, strict=True))
    return markdown([["system", *(column.title for column in columns)], *lines])


def _tex(rows: Sequence[System], columns: Sequence[Column]) -> str:
    cells = []
    for column in columns:
        texts = ((tex(text), best) for text, best in _texts(column))
        cells.append([rf"\textbf{{{text}}}" if best else text or "--" for text, best in texts])
    lines = ([tex(row.name), *texts] for row, *texts in zip(rows, *cells, strict=True))
    return latex([["Method", *(tex(column.title) for column in columns)], *lines])


def _csv(file: Path, rows: Sequence[System], columns: Sequence[Column]) -> None:
    with atomic_write(file) as part, open(part, "w", newline="", encoding="utf-8") as opened:
        writer = csv.writer(opened)
        spread = [any(isinstance(value, Spread) for value in column.values) for column in columns]
        head = ([c.title, f"{c.title}, sd"] if wide else [c.title] for c, wide in zip(columns, spread, strict=True))
        writer.writerow(["system", "model", *(title for titles in head for title in titles)])
        for number, row in enumerate(rows):
            line = [row.name, row.model]
            for column, wide in zip(columns, spread, strict=True):
                value = column.values[number]
                pair = (value.mean, value.deviation) if isinstance(value, Spread) else (value, None)
                line += pair if wide else pair[:1]
            writer.writerow(line)


def write_systems(
    folder: Path, runs: Sequence[Run], baselines: Sequence[Mapping], shared: Mapping, known: Mapping
) -> Table | None:
    """Writes ``systems.md``, ``systems.csv``, ``systems.tex`` and the figures that set the systems side by side.

    Args:
        folder: Gets the files.
        runs: Of the multirun.
        baselines: Rows of ``gaigs.report.multirun.ablation``.
        shared: What the runs have in common.
        known: Metrics of the task.

    Returns:
        A table for a terminal; None, and no files, where the runs that ended are not of several models.
    """
    published = read_published()
    rows = find_systems(runs, baselines, shared, published.names)
    done = [row for row in rows if row.runs]
    if len({row.model for row in done}) < 2:
        return None
    task = done[0].runs[0].metrics["task"]
    failed = [f"{row.name}: {failure}" for row in rows for failure in row.failures]
    rows = [row for row in rows if row.values]
    better = {name: metric.higher_is_better for name, metric in known.items()}
    scores = _columns(rows, {name: metric.title for name, metric in known.items()}, better)
    costs = _columns(rows, COSTS, {})
    told, taken = (_published(rows, part.get(task, ())) for part in (published.scores, published.costs))

    _csv(folder / "systems.csv", rows, [*told, *scores, *taken, *costs])
    tables = [told + scores, taken + costs]
    notes = [", ".join(f"{key}={value}" for key, value in shared.items())]
    notes += [
        f"- published {column['title']}: {column['source']}"
        for part in (published.scores, published.costs)
        for column in part.get(task, ())
    ]
    notes += [f"- without a result: {failure}" for failure in failed]
    pages = [*(_markdown(rows, table) for table in tables), "\n".join(notes) + "\n"]
    texts = {"systems.md": pages, "systems.tex": [_tex(rows, table) for table in tables]}
    for name, parts in texts.items():
        write_text(folder / name, "\n".join(parts))
    for name, figure in _figures(done, task, known).items():
        with atomic_write(folder / f"systems_{name}.png") as part:
            figure.savefig(part, dpi=DPI)

    brief = [column for column in scores if any(column.title == m.title for m in known.values() if m.is_brief)]
    brief += [column for column in costs if column.title in {COSTS[key] for key in BRIEF}]
    return _terminal(rows, told[-1:] + brief, failed)


def _terminal(rows: Sequence[System], columns: Sequence[Column], failed: Sequence[str]) -> Table:
    missing = "".join(f"{failure}\n" for failure in failed)
    caption = f"{missing}all columns in systems.md"
    table = Table(title="Systems", caption=escape(caption), box=SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    table.add_column("system", overflow="fold")
    for column in columns:
        table.add_column(stacked(column.title), justify="right")
    cells = [[f"[bold]{text}[/bold]" if best else text for text, best in _texts(column)] for column in columns]
    for row, *texts in zip(rows, *cells, strict=True):
        table.add_row(escape(row.name), *texts, style=None if row.runs else "dim")
    return table


def _are_of_the_same_links(files: Iterable[Path]) -> bool:
    """Whether predictions are of the same test links, told by their labels; not where a file cannot be read."""
    first = None
    for file in files:
        try:
            with file.open("rb") as stream, np.load(stream) as run:  # numpy would not close what it cannot read
                labels = run["labels"]
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return False
        first = labels if first is None else first
        if not np.array_equal(first, labels):
            return False
    return first is not None


def _figures(rows: Sequence[System], task: str, known: Mapping) -> dict:
    """What the task draws of all systems' predictions, where these are of the same split; and how they were learnt."""
    figures, kind = {}, registry("task").get(task)
    shared = set.intersection(*({run.metrics["seed"] for run in row.runs} for row in rows))
    firsts = {
        row.name: next((run for run in row.runs if run.metrics["seed"] == min(shared, default=None)), row.runs[0])
        for row in rows
    }
    splits = {run.metrics["split"] for run in firsts.values()}
    files = {name: run.folder / "predictions.npz" for name, run in firsts.items()}
    files = {name: file for name, file in files.items() if file.is_file()}
    if len(splits) == 1 and _are_of_the_same_links(files.values()):
        figures |= kind.compared(files, *splits)
    monitor, mean = monitor_names(task)
    curves = {}
    for name, run in firsts.items():
        if points := [(p.seconds, p.score) for p in read_validations(run.folder, monitor) if math.isfinite(p.seconds)]:
            curves[name] = tuple(zip(*points, strict=True))
    if curves and mean is not None and len(splits) == 1:
        own = {next(iter(firsts[name].metrics["models"])) for name in curves}
        own |= {f"{name}_trend" for name in own}  # a run's own model without its kriging
        validation = next((run.metrics["validation"] for run in firsts.values() if run.metrics.get("validation")), {})
        lines = {name: scores[mean] for name, scores in validation.items() if name not in own}
        score = known[mean]
        figures["curves"] = learning_curves(curves, f"{score.title}, validation", lines, score.higher_is_better)
    return figures
