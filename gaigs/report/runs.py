"""The runs of a Hydra multirun, or of several, as they lie in its folder."""

import json
import re
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gaigs.configuration import differences
from gaigs.registry import check_type
from gaigs.report.table import metrics_of

NEEDED = {"task": str, "split": str, "seed": int, "device": str} | dict.fromkeys(
    ("train_seconds", "inference_ms", "render_ms", "num_gaussians", "num_parameters", "checkpoint_bytes"), float | None
)
"""What tables need of ``metrics.json``, beside scores; of costs there may be none."""

FAILED = "gaigs: "
"""How the line of a job's log begins that says why it failed."""


class Run(NamedTuple):
    """One job of a multirun.

    Attributes:
        name: Its sub-folder.
        overrides: What was changed on the command line, by key.
        metrics: Contents of ``metrics.json``; None where the job failed, was stopped or is still at work.
        failure: What the job said when it failed; None where it did not.
        folder: Where it lies.
    """

    name: str
    overrides: dict[str, str]
    metrics: dict | None
    failure: str | None
    folder: Path


def as_baseline(name: str) -> str:
    """What a reader calls a baseline where a system has the same name."""
    return f"{name} (baseline)"


def train_seconds(metrics: Mapping) -> float | None:
    """How long a run trained, and what its kriging took on top [s]; None of a look-up."""
    seconds = metrics.get("train_seconds")
    return None if seconds is None else seconds + metrics.get("kriging", {}).get("seconds", 0.0)


class Spread(NamedTuple):
    """A metric of several runs: mean, standard deviation of a sample, least value."""

    mean: float
    deviation: float
    least: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Spread":
        """That of two values or more."""
        return cls(statistics.mean(values), statistics.stdev(values), min(values))


def read_metrics(file: Path) -> dict:
    """What a run has left in its ``metrics.json``, with all that tables need.

    Raises:
        ValueError: It is damaged, lacks something, or is of a task that is not installed here.
    """
    try:
        metrics = json.loads(file.read_text())
        if not isinstance(metrics, dict):
            raise TypeError(f"it must be a mapping, got {metrics!r:.60}")
        first, *_ = metrics_of(metrics)
        for key, kind in NEEDED.items():
            check_type(repr(key), metrics.get(key), kind)
        _check_scores("models", metrics.get("models"), first)
        if metrics.get("validation"):
            _check_scores("validation", metrics["validation"], first)
        for receiver, models in (metrics.get("receivers") or {}).items():
            _check_scores(f"receiver {receiver}", models, first)
    except (AttributeError, TypeError, ValueError, RecursionError) as error:  # JSON and encodings raise a ValueError
        raise ValueError(
            f"{file} must hold what a run writes, and does not: {error}; move the file elsewhere, and the run's "
            "command writes it anew without another training"
        ) from error
    return metrics


def _check_scores(place: str, models: object, first: str) -> None:
    """Sees to it that models have scores, all of them the one that runs are compared by."""
    if not isinstance(models, dict) or not models:
        raise TypeError(f"{place!r} must be the scores of models, got {models!r:.60}")
    for model, scores in models.items():
        for name in {first: None, **scores}:
            check_type(f"{name!r} of {model!r} in {place!r}", scores.get(name), float)


def _read_yaml(file: Path, kind: type) -> object:
    """What one of a job's configuration files holds.

    Raises:
        ValueError: It is damaged.
    """
    try:
        content = OmegaConf.to_container(OmegaConf.load(file), resolve=kind is dict)
    except (OmegaConfBaseException, yaml.YAMLError, ValueError, OSError) as error:
        raise ValueError(
            f"{file} must be YAML that Hydra wrote, and is damaged: {' '.join(str(error).split())}"
        ) from error
    if not isinstance(content, kind):
        raise ValueError(f"{file} must be YAML that Hydra wrote, a {kind.__name__}, got {content!r:.60}")
    return content


def read_runs(folder: Path) -> list[Run]:
    """The runs at any depth of a folder, in the order of their names, the numbers in these by their size.

    Raises:
        FileNotFoundError: The folder holds no run.
        ValueError: One was started anew with another configuration, or a file is damaged.
    """
    runs = []
    for path in folder.glob("**/.hydra/overrides.yaml"):
        run_config, started = path.parents[1] / "config.yaml", path.parent / "config.yaml"
        if (
            run_config.is_file()
            and started.is_file()
            and differences(_read_yaml(run_config, dict), _read_yaml(started, dict))
        ):
            raise ValueError(
                f"{run_config.parent} holds a run of another configuration than the one last started there, which was "
                "refused, and Hydra has rewritten its overrides; start the multirun once more as it was at first"
            )
        overrides = (override.partition("=") for override in _read_yaml(path, list))
        own = path.parents[1]
        metrics = own / "metrics.json"
        runs.append(
            Run(
                own.relative_to(folder).as_posix(),
                {key.lstrip("+"): re.sub(r"\\(.)", r"\1", value) for key, _, value in overrides},  # as it was typed
                read_metrics(metrics) if metrics.is_file() else None,
                None if metrics.is_file() else _failure(own),
                own,
            )
        )
    if not runs:
        raise FileNotFoundError(
            f"{folder} must hold runs, each with its .hydra/overrides.yaml, found none; "
            "pass the folder that Hydra made for 'python -m gaigs --multirun ...'"
        )
    # Text and numbers take turns, so that like is compared with like.
    parts = lambda name: [int(part) if i % 2 else part for i, part in enumerate(re.split(r"([0-9]+)", name))]
    runs.sort(key=lambda run: parts(run.name))
    return runs


def _failure(folder: Path) -> str | None:
    """What a job said last, if that was why it failed."""
    logs = [log for log in folder.glob("*.log") if not log.name.startswith("train_ddp")]
    last = "".join(log.read_text(errors="replace") for log in logs).rstrip().rpartition("\n")[2]
    return last.removeprefix(FAILED) if last.startswith(FAILED) else None
