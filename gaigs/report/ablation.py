"""The table of a multirun: runs, baselines, spread over seeds, and speed."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from numpy import ndarray
from rich.console import Console
from rich.markup import escape
from rich.measure import Measurement
from rich.table import Table

from gaigs.core.task import Metric
from gaigs.io.files import write_text
from gaigs.report.curves import speed_against_error
from gaigs.report.run_folders import Run, by_seed
from gaigs.report.scores import COSTS, headline, train_seconds
from gaigs.report.style import save
from gaigs.report.table import (
    Spread,
    best_in_bold,
    columns_of,
    latex,
    markdown,
    terminal,
    tex,
    write_csv,
    written,
)


def ablation(runs: Sequence[Run]) -> tuple[list[dict], dict]:
    """Rows of the table of runs, and the settings that all runs share.

    Each run has a row. Rows of baselines follow, once for equal scores on a split. A shared setting
    has no column; it is an override, or one of split, seed and device.
    """
    overrides = [run.overrides for run in runs]
    all_metrics = [run.metrics for run in runs if run.metrics is not None]
    names = columns_of(overrides)
    shared_overrides = _common(names, overrides)
    facts = ("split", "seed", "device")
    shared_facts = _common(facts, all_metrics)
    varied = [name for name in names if name not in shared_overrides]
    varied_facts = [fact for fact in facts if fact not in shared_facts]
    rows = []
    baselines = {}
    for run in runs:
        rows.append(_row(run, varied, varied_facts))
        for row in _baselines(run.metrics, "split" in varied_facts):
            # As text: two devices give scores that differ in the last bits.
            baselines[tuple(written(value) for value in row.values())] = row
    return [*rows, *baselines.values()], shared_overrides | shared_facts


def _common(keys: Sequence[str], sources: Sequence[Mapping]) -> dict[str, object]:
    """Values that are equal in all sources, by key; a missing key has the value ``""``."""
    common = {}
    for key in keys:
        values = {source.get(key, "") for source in sources}
        if len(values) == 1:
            common[key] = values.pop()
    return common


def _row(run: Run, varied: Sequence[str], facts: Sequence[str]) -> dict:
    """The row of a run: name, overrides ``varied``, ``facts``, scores, p value and costs."""
    row = {"run": run.name, "status": "unfinished", "model": ""}
    row |= {key: run.overrides.get(key, "") for key in varied}
    if run.metrics is None:
        return row
    model, scores = next(iter(run.metrics["models"].items()))  # the run's model is first
    # An override of ``model`` may already have named it.
    row |= {"status": "done", "model": row["model"] or model}
    row |= {fact: run.metrics[fact] for fact in facts}
    row |= scores
    if (p := _p_value(run.metrics)) is not None:
        row["p"] = p
    row["train_seconds"] = train_seconds(run.metrics)
    for cost in ("num_gaussians", "num_parameters", "inference_ms"):
        row[cost] = run.metrics.get(cost)
    return row


def _p_value(metrics: Mapping) -> float | None:
    """p value of the run's main metric against the best baseline; None without a paired test."""
    metric_name, _ = headline(metrics["task"], metrics["models"])
    model = next(iter(metrics["models"]))  # the run's model is first
    test = metrics.get("paired") or {"p": {}}
    return test["p"].get(model, {}).get(metric_name)


def _baselines(metrics: Mapping | None, has_split: bool) -> list[dict]:
    """Rows of a run's baselines, without ``<model>_trend``, the model before its kriging.

    An unfinished run (None) has no rows. ``has_split`` adds a column with the split.
    """
    if metrics is None:
        return []
    model, *baselines = metrics["models"]
    rows = []
    for name in baselines:
        if name != f"{model}_trend":
            row = {"status": "baseline", "model": name} | metrics["models"][name]
            if has_split:
                row["split"] = metrics["split"]
            rows.append(row)
    return rows


def over_seeds(runs: Sequence[Run], shared: Mapping) -> list[dict]:
    """A row of means for each group of at least two runs that differ only in ``seed``.

    Args:
        shared: Settings that all runs share; rows omit them.
    """
    ended = [run for run in runs if run.metrics is not None]
    names = columns_of([run.overrides for run in ended])
    varied = [name for name in names if name != "seed" and name not in shared]
    rows = []
    for group in by_seed(ended):
        metrics = [run.metrics for run in group]
        if len({entry["seed"] for entry in metrics}) < 2:
            continue  # the same seed, run twice
        scores = [next(iter(entry["models"].values())) for entry in metrics]  # of the run's model
        row = {"status": "seeds", "model": next(iter(metrics[0]["models"]))}
        row |= {name: group[0].overrides.get(name, "") for name in varied}
        if "split" not in shared:
            splits = {entry["split"] for entry in metrics}
            row["split"] = splits.pop() if len(splits) == 1 else f"{len(splits)} splits"
        row["runs"] = len(group)
        for name in scores[0]:
            if all(name in score for score in scores):
                row[name] = Spread.of([score[name] for score in scores])
        p_values = [_p_value(entry) for entry in metrics]
        if None not in p_values:
            row["p"] = max(filter(None, p_values))  # the least certain seed
        rows.append(row)
    return rows


def write_ablation(
    folder: Path,
    runs: Sequence[Run],
    rows: Sequence[dict],
    shared: Mapping,
    metrics: Mapping[str, Metric],
) -> list[Table]:
    """Writes ``ablation.csv``, ``.md`` and, after a run has ended, ``.tex`` and a figure of speed.

    Only the CSV file has all columns.

    Args:
        rows, shared: Results of ``ablation``.
        metrics: Metrics of the task by name; empty until a run has ended.

    Returns:
        Tables for a terminal of 80 columns.
    """
    intervals = {
        "p": "p against best",
        "coverage_50": "within 50 %",
        "coverage_90": "within 90 %",
        "width_90": "width of 90 %",
        "crps": "CRPS",
        "nll": "NLL",
        "calibration_links": "calibrating links",
    }
    titles = {name: metric.title for name, metric in metrics.items()} | intervals | COSTS
    groups = over_seeds(runs, shared)
    spread = "Runs that differ in the seed alone: mean ± standard deviation (n - 1), and the least"
    settings = ", ".join(f"{key}={value}" for key, value in shared.items())
    failures = [f"{run.name}: {run.failure}" for run in runs if run.failure is not None]
    doubts = []
    for run in runs:
        doubts += [f"{run.name}: {doubt}" for doubt in run.doubts]

    write_csv(folder / "ablation.csv", [*rows, *groups], ("_sd", "_least"))
    rows = [_without_errors(row) for row in rows]
    groups = [_without_errors(row) for row in groups]
    hidden = set()  # columns that the page or the terminal leaves out
    if not any(row["status"] == "unfinished" for row in rows):
        hidden.add("status")
    varied = [_settings(run, shared) for run in runs]
    if len({*varied}) == len(varied):
        hidden.add("run")  # its name would repeat the varied overrides
    page = f"{_markdown(rows, titles, hidden)}\n{settings}\n"
    page += "".join(f"- without a result: {failure}\n" for failure in failures)
    page += "".join(f"- {doubt}\n" for doubt in doubts)
    if groups:
        page += f"\n{spread}\n\n{_markdown(groups, titles, {'status'})}"
    write_text(folder / "ablation.md", page)
    if metrics:
        save(_speed(runs, rows, shared, titles), folder / "speed_against_error.png")
        text = _latex(groups or rows, rows, metrics, shared)
        write_text(folder / "ablation.tex", text)

    # A terminal has less room.
    hidden |= {name for name, metric in metrics.items() if not metric.is_brief}
    hidden |= {"num_gaussians"} | intervals.keys() - {"coverage_90", "p"}
    caption = "\n".join([*failures, *doubts, f"{settings}; all columns in ablation.csv"])
    tables = [_terminal(f"Runs of {folder}", rows, titles, hidden, caption)]
    if groups:
        about = f"{spread}; all columns in ablation.csv"
        tables.append(_terminal("Over seeds", groups, titles, hidden | {"status"}, about))
    return tables


def _settings(run: Run, shared: Mapping) -> str:
    """The overrides of a run that not all runs share, as one text."""
    pairs = run.overrides.items()
    return " ".join(f"{key}={value}" for key, value in pairs if key not in shared)


def _speed(
    runs: Sequence[Run], rows: Sequence[dict], shared: Mapping, titles: Mapping[str, str]
) -> Figure:
    """A figure of the first metric of each finished run over its times of training and inference.

    ``rows`` are those of all runs, then of baselines. The first of the ``titles`` is the metric's.
    """
    metric = next(iter(titles))
    ended = [run for run in runs if run.metrics is not None]
    done = [row for row in rows if row["status"] == "done"]
    names = [_settings(run, shared) for run in ended]
    if "" in names or len({*names}) < len(names):  # settings do not identify the runs
        names = [run.name for run in ended]
    times = {
        "inference [ms a transmitter]": _numbers(done, "inference_ms"),
        "training [s]": _numbers(done, "train_seconds"),
    }
    baselines = {}
    for row in rows[len(runs) :]:
        baselines[f"{row['model']} {row.get('split', '')}".strip()] = row[metric]
    models = [row["model"] for row in done]
    scores = _numbers(done, metric)
    return speed_against_error(names, scores, times, titles[metric], baselines, models)


def _numbers(rows: Sequence[Mapping], key: str) -> Float[ndarray, " rows"]:
    """A column as numbers; NaN for unknown ones."""
    return np.array([np.nan if row.get(key) is None else row[key] for row in rows], float)


def _text(value: float | int | str | Spread | None, separator: str) -> str:
    """A cell of a table; the lowest value of a ``Spread`` follows after a separator."""
    if isinstance(value, Spread):
        return f"{written(value)}{separator}least {written(value.least)}"
    return written(value)


def _without_errors(row: Mapping) -> dict:
    """A row with standard errors only in cells of coverages, such as "0.902 ± 0.013"."""
    shown = {key: value for key, value in row.items() if not key.endswith("_error")}
    for key in row.keys() & {"coverage_50", "coverage_90"}:
        error = row.get(f"{key}_error")
        if isinstance(error, float) and isinstance(row[key], float):
            shown[key] = f"{written(row[key])} ± {written(error)}"
    return shown


def _markdown(rows: Sequence[Mapping], titles: Mapping[str, str], hidden: set[str]) -> str:
    """A Markdown table of the columns that are not hidden, with their titles."""
    columns = [column for column in columns_of(rows) if column not in hidden]
    lines = [[titles.get(column, column) for column in columns]]
    for row in rows:
        lines.append([_text(row.get(column), ", ") for column in columns])
    return markdown(lines)


def _latex(
    results: Sequence[Mapping],
    rows: Sequence[Mapping],
    metrics: Mapping[str, Metric],
    shared: Mapping,
) -> str:
    """A LaTeX table: settings and metrics of runs, or of their means over seeds, then of baselines.

    Args:
        results: Rows of runs, or of groups of seeds, without baselines.
        rows: All rows, which include the baselines.
        shared: Settings that all runs share, for the caption.
    """
    run_rows = [row for row in results if row["status"] in ("done", "seeds")]
    baseline_rows = [row for row in rows if row["status"] == "baseline"]
    known = columns_of([*run_rows, *baseline_rows])
    metric_names = [name for name in metrics if name in known]
    # Columns of settings come before the first metric.
    settings_end = known.index(metric_names[0])
    hidden = ("run", "status", "seed", "runs")
    setting_names = [name for name in known[:settings_end] if name not in hidden]
    if setting_names == ["model"]:  # a run of a baseline's model is this baseline
        run_models = {row["model"] for row in run_rows}
        baseline_rows = [row for row in baseline_rows if row["model"] not in run_models]
    shown = [*run_rows, *baseline_rows]
    columns = []
    for name in setting_names:
        cells = [tex(_text(row.get(name), "")) for row in shown]
        columns.append([tex(name), *cells])
    for name in metric_names:
        values = [row.get(name) for row in shown]
        bold = r"\textbf{{{}}}"
        cells = best_in_bold(values, metrics[name].higher_is_better, bold)
        if name == metric_names[0]:
            for number, row in enumerate(shown):
                is_known = row.get("p") is not None
                cells[number] += "$^*$" if is_known and row["p"] < 0.05 else ""
        columns.append([tex(metrics[name].title), *(cell.replace("±", r"$\pm$") for cell in cells)])
    settings = ", ".join(f"{key}={value}" for key, value in shared.items())
    split = f" on split {tex(shared['split'])}" if "split" in shared else ""
    caption = f"Test scores{split}. Bold: the best, and all that print alike."
    if results[0]["status"] == "seeds":
        caption += r" $\pm$: standard deviation over seeds."
    if any("$^*$" in cell for cell in columns[len(setting_names)]):
        caption += " $^*$: differs from the best baseline ($p<0.05$, paired bootstrap over places)."
    lines = [[*line] for line in zip(*columns, strict=True)]  # the head is line 0
    first_baseline = len(run_rows) + 1
    return f"% {settings}\n{latex(lines, len(setting_names), caption, [first_baseline])}"


def _terminal(
    title: str, rows: Sequence[Mapping], titles: Mapping[str, str], hidden: set[str], caption: str
) -> Table:
    """A table for the terminal; columns of costs are dropped until it is at most 80 wide."""
    columns = [column for column in columns_of(rows) if column not in hidden]
    styles = [{"unfinished": "red", "baseline": "dim"}.get(row["status"]) for row in rows]
    console = Console(width=1000)  # wide enough to measure any table
    while True:
        heads = {}  # True for a column of numbers
        for column in columns:
            is_number = column in titles
            heads[titles.get(column, column.replace(".", ".\n"))] = is_number
        lines = []
        for row in rows:
            lines.append([escape(_text(row.get(column), "\n")) for column in columns])
        table = terminal(title, heads, lines, caption, styles)
        width = Measurement.get(console, console.options, table).maximum
        if width <= 80 or columns[-1] not in COSTS:
            return table
        columns.pop()  # a cost, which is in the files
