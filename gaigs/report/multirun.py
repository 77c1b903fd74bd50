"""The runs of a Hydra multirun as one table, and their speed against their error."""

import csv
import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from matplotlib.figure import Figure
from omegaconf import OmegaConf
from rich.box import SIMPLE_HEAD
from rich.markup import escape
from rich.table import Table

from gaigs.configuration import differences
from gaigs.report.curves import speed_against_error
from gaigs.report.style import DPI
from gaigs.report.table import METRICS, written

COSTS = {
    "train_seconds": "training [s]",
    "num_gaussians": "Gaussians",
    "num_parameters": "parameters",
    "inference_ms": "inference [ms]",
}
"""What a reader calls the costs of ``metrics.json``."""

WRITTEN_ONLY = ("ssim_mean", "ssim_p10", "ssim_p90", "median_ae_db", "rmse_db", "num_gaussians")
"""Columns for which a terminal has no room."""


class Run(NamedTuple):
    """One job of a multirun.

    Attributes:
        name: Its sub-folder.
        overrides: What was changed on the command line, by key.
        metrics: Contents of ``metrics.json``; None where the job failed.
    """

    name: str
    overrides: dict[str, str]
    metrics: dict | None


def read_runs(folder: Path) -> list[Run]:
    """The jobs of a multirun folder in the order of their numbers.

    Raises:
        FileNotFoundError: The folder holds no run.
    """
    runs = []
    for path in folder.glob("*/.hydra/overrides.yaml"):
        run_config, started = path.parents[1] / "config.yaml", path.parent / "config.yaml"
        if run_config.is_file() and started.is_file() and differences(_resolved(run_config), _resolved(started)):
            raise ValueError(
                f"{run_config.parent} holds a run of another configuration than the one last started there, which was "
                "refused, and Hydra has rewritten its overrides; start the multirun once more as it was at first"
            )
        overrides = (override.partition("=") for override in yaml.safe_load(path.read_text()))
        metrics = path.parents[1] / "metrics.json"
        runs.append(
            Run(
                path.parents[1].name,
                {key.lstrip("+"): value for key, _, value in overrides},
                json.loads(metrics.read_text()) if metrics.is_file() else None,
            )
        )
    if not runs:
        raise FileNotFoundError(
            f"{folder} must hold the runs of a multirun (0/.hydra/overrides.yaml, 1/...), found none; "
            "pass the folder that Hydra made for 'python -m gaigs --multirun ...'"
        )
    return sorted(runs, key=lambda run: (int(run.name) if run.name.isdigit() else len(runs), run.name))


def _resolved(path: Path) -> dict:
    return OmegaConf.to_container(OmegaConf.load(path), resolve=True)


def ablation(runs: list[Run]) -> tuple[list[dict], dict]:
    """Rows of the table, each a dictionary by column, and what all runs have in common.

    Varied overrides lead, then come scores and costs. A failed run has a row without scores. The look-ups that the runs
    were held against follow, once for each split.
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

    rows, lookups = [], {}
    for name, overrides, metrics in runs:
        row = {"run": name, "status": "failed", "model": ""} | {key: overrides.get(key, "") for key in varied}
        if metrics is not None:
            (own, scores), *others = metrics["models"].items()
            row |= {"status": "done", "model": row["model"] or own} | {key: metrics[key] for key in facts}
            row |= scores | {key: metrics.get(key) for key in COSTS}
            for model, scores in others:
                lookup = {"status": "look-up", "model": model} | scores
                if "split" in facts:
                    lookup["split"] = metrics["split"]
                # As written: two devices give scores that differ in the last bits.
                lookups[tuple(written(value) for value in lookup.values())] = lookup
        rows.append(row)
    return rows + list(lookups.values()), shared


def report(folder: Path) -> Table:
    """Writes ``ablation.csv``, ``ablation.md`` and, unless all runs failed, ``speed_against_error.png`` there.

    Args:
        folder: Of a Hydra multirun.

    Returns:
        The table, for a terminal of 80 columns: without ``WRITTEN_ONLY``, and without the status if nothing failed.

    Raises:
        FileNotFoundError: The folder holds no run.
    """
    runs = read_runs(folder)
    rows, shared = ablation(runs)
    columns = list(dict.fromkeys(column for row in rows for column in row))
    heads = [(METRICS | COSTS).get(column, column) for column in columns]
    cells = [[written(row.get(column)) for column in columns] for row in rows]
    caption = ", ".join(f"{key}={value}" for key, value in shared.items())

    with open(folder / "ablation.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows(rows)
    lines = [heads, ["---"] * len(columns), *cells]
    markdown = "".join("| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |\n" for line in lines)
    (folder / "ablation.md").write_text(f"{markdown}\n{caption}\n")
    if any(run.metrics is not None for run in runs):
        _speed(runs, rows, shared).savefig(folder / "speed_against_error.png", dpi=DPI)

    failed = any(row["status"] == "failed" for row in rows)
    shown = [i for i, column in enumerate(columns) if column not in WRITTEN_ONLY and (column != "status" or failed)]
    caption += "; all columns in ablation.md"
    table = Table(title=f"Runs of {escape(str(folder))}", caption=escape(caption), box=SIMPLE_HEAD, pad_edge=False)
    for i in shown:
        justify = "right" if columns[i] in METRICS | COSTS else "left"
        table.add_column(escape(heads[i]), justify=justify, overflow="fold")
    for row, line in zip(rows, cells, strict=True):
        style = {"failed": "red", "look-up": "dim"}.get(row["status"])
        table.add_row(*(escape(line[i]) for i in shown), style=style)
    return table


def _speed(runs: list[Run], rows: list[dict], shared: dict) -> Figure:
    done = [(run, row) for run, row in zip(runs, rows, strict=False) if run.metrics is not None]
    metric = next(iter(next(iter(done[0][0].metrics["models"].values()))))
    names = [
        " ".join(f"{key}={value}" for key, value in run.overrides.items() if key not in shared) or row["model"]
        for run, row in done
    ]
    number = lambda key: np.array([np.nan if row.get(key) is None else row[key] for _, row in done], float)
    times = {"inference [ms a transmitter]": number("inference_ms"), "training [s]": number("train_seconds")}
    lookups = {
        f"{row['model']} {row.get('split', '')}".strip(): row[metric] for row in rows[len(runs) :] if metric in row
    }
    return speed_against_error(names, number(metric), times, METRICS.get(metric, metric), lookups)
