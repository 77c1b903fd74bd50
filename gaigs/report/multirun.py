"""All tables and figures of a Hydra multirun, or of several."""

from pathlib import Path

from rich.console import Group

from gaigs.report.ablation import ablation, write_ablation
from gaigs.report.run_folders import read_runs
from gaigs.report.scores import task_class
from gaigs.report.systems import write_systems


def report(folder: str | Path) -> Group:
    """Writes the files of ``gaigs.report.ablation`` into a folder.

    Runs of several models also get the files of ``gaigs.report.systems``.

    Args:
        folder: Folder of a Hydra multirun, or a parent folder of several.

    Raises:
        FileNotFoundError: The folder contains no run.
        ValueError: A file is damaged, or the runs are of several tasks.
    """
    folder = Path(folder)
    runs = read_runs(folder)
    tasks = {run.metrics["task"]: run.name for run in runs if run.metrics is not None}
    if len(tasks) > 1:
        listed = ", ".join(f"{task} in {name}" for task, name in tasks.items())
        raise ValueError(
            f"the runs of a table must be of one task, got {listed}; pass a folder with runs of one"
        )
    metrics = task_class(next(iter(tasks))).metrics() if tasks else {}
    rows, shared = ablation(runs)
    tables = write_ablation(folder, runs, rows, shared, metrics)
    baselines = [row for row in rows if row["status"] == "baseline"]
    systems = write_systems(folder, runs, baselines, shared, metrics)
    return Group(*tables, *([] if systems is None else [systems]))
