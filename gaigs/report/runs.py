"""The runs in the folder of a Hydra multirun, or of several."""

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gaigs.configuration import differences
from gaigs.registry import check_type
from gaigs.report.table import headline


class Run(NamedTuple):
    """One job of a multirun.

    Attributes:
        name: Its sub-folder.
        overrides: Values of the command line, by key.
        metrics: Contents of ``metrics.json``; None where the job failed, was stopped or still runs.
        failure: The error of a failed job; else None.
        folder: Of the run.
    """

    name: str
    overrides: dict[str, str]
    metrics: dict | None
    failure: str | None
    folder: Path


def as_baseline(name: str) -> str:
    """The name of a baseline for a reader where a system has the same name."""
    return f"{name} (baseline)"


def train_seconds(metrics: Mapping) -> float | None:
    """Duration of a run's training and kriging [s]; None for a look-up."""
    seconds = metrics.get("train_seconds")
    return None if seconds is None else seconds + metrics.get("kriging", {}).get("seconds", 0.0)


def by_seed(runs: Sequence[Run]) -> list[list[Run]]:
    """Groups of runs that differ in the override ``seed`` alone, in the order of their first runs."""
    groups: dict[frozenset, list[Run]] = {}
    for run in runs:
        fixed = frozenset((key, value) for key, value in run.overrides.items() if key != "seed")
        groups.setdefault(fixed, []).append(run)
    return [*groups.values()]


def read_metrics(file: Path) -> dict:
    """Contents of a run's ``metrics.json``; a ValueError for a damaged file or a task that is not installed."""
    try:
        metrics = json.loads(file.read_text())
        task, models = metrics["task"], metrics["models"]
        if not models:
            raise ValueError("no model")
        first, _ = headline(task, models)
        for key, kind in (("split", str), ("seed", int), ("device", str), ("train_seconds", float | None)):
            check_type(repr(key), metrics.get(key), kind)
        for models in (metrics["models"], metrics.get("validation") or {}, *(metrics.get("receivers") or {}).values()):
            for scores in models.values():
                check_type(repr(first), scores[first], float)
    except (AttributeError, KeyError, TypeError, ValueError) as error:  # JSON and encodings raise a ValueError
        raise ValueError(
            f"cannot read {file} ({type(error).__name__}: {error})\n"
            "move it elsewhere, and start the run again, which does not train a second time"
        ) from error
    return metrics


def _read_yaml(file: Path, kind: type) -> Any:
    try:
        content = OmegaConf.to_container(OmegaConf.load(file), resolve=kind is dict)
        check_type("its content", content, kind)
    except (OmegaConfBaseException, yaml.YAMLError, TypeError, ValueError, OSError) as error:
        raise ValueError(f"cannot parse {file}, which Hydra wrote: {' '.join(str(error).split())}") from error
    return content


def read_runs(folder: Path) -> list[Run]:
    """The runs at any depth of a folder, sorted by name, with numbers in names by value.

    Raises:
        FileNotFoundError: The folder holds no run.
        ValueError: One was started anew with another configuration, or a file is damaged.
    """
    runs = []
    for path in folder.glob("**/.hydra/overrides.yaml"):
        own, started = path.parents[1], path.parent / "config.yaml"
        stored, file = own / "config.yaml", own / "metrics.json"
        if stored.is_file() and started.is_file() and differences(_read_yaml(stored, dict), _read_yaml(started, dict)):
            raise ValueError(
                f"{own} holds a run of another configuration than the one last started there, and Hydra has rewritten "
                "its overrides\nstart the first multirun again"
            )
        typed = (override.partition("=") for override in _read_yaml(path, list))
        overrides = {key.lstrip("+"): re.sub(r"\\(.)", r"\1", value) for key, _, value in typed}  # without escapes
        metrics, failure = (read_metrics(file), None) if file.is_file() else (None, _failure(own))
        runs.append(Run(own.relative_to(folder).as_posix(), overrides, metrics, failure, own))
    if not runs:
        raise FileNotFoundError(
            f"{folder} must hold runs, each with its .hydra/overrides.yaml\n"
            "pass the folder that Hydra made for 'python -m gaigs --multirun ...'"
        )
    # Text and numbers alternate, so that equal types are compared.
    parts = lambda name: [int(part) if i % 2 else part for i, part in enumerate(re.split(r"([0-9]+)", name))]
    runs.sort(key=lambda run: parts(run.name))
    return runs


def _failure(folder: Path) -> str | None:
    """The last line of a job's log, if it is the error by which the job ended."""
    logs = [log for log in folder.glob("*.log") if not log.name.startswith("train_ddp")]
    last = "".join(log.read_text(errors="replace") for log in logs).rstrip().rpartition("\n")[2]
    return last.removeprefix("gaigs: ") if last.startswith("gaigs: ") else None
