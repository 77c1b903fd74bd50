"""The runs in the folder of a Hydra multirun, or of several."""

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import QuotedString
from hydra.errors import HydraException
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gaigs.configuration import differences, files_of
from gaigs.registry import check_type
from gaigs.report.table import headline

MISSING = object()
"""The value of a key that a configuration lacks."""


class Run(NamedTuple):
    """One job of a multirun.

    Attributes:
        name: Its sub-folder.
        overrides: Values of the command line, by key.
        metrics: Contents of ``metrics.json``; None where the job failed, was stopped or still runs.
        failure: The error of a failed job; else None.
        folder: Of the run.
        doubts: Sentences on overrides that are not those of the run's configuration.
    """

    name: str
    overrides: dict[str, str]
    metrics: dict | None
    failure: str | None
    folder: Path
    doubts: tuple[str, ...] = ()


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
    """Contents of a run's ``metrics.json``; a ValueError for a damaged file or a task that is not
    installed.
    """
    try:
        metrics = json.loads(file.read_text())
        task, models = metrics["task"], metrics["models"]
        if not models:
            raise ValueError("no model")
        first, _ = headline(task, models)
        for key, kind in (
            ("split", str),
            ("seed", int),
            ("device", str),
            ("train_seconds", float | None),
        ):
            check_type(repr(key), metrics.get(key), kind)
        for models in (
            metrics["models"],
            metrics.get("validation") or {},
            *(metrics.get("receivers") or {}).values(),
        ):
            for scores in models.values():
                check_type(repr(first), scores[first], float)
    except (
        AttributeError,
        KeyError,
        TypeError,
        ValueError,
    ) as error:  # JSON and encodings raise a ValueError
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
        raise ValueError(
            f"cannot parse {file}, which Hydra wrote: {' '.join(str(error).split())}"
        ) from error
    return content


def read_runs(folder: Path) -> list[Run]:
    """The runs at any depth of a folder, sorted by name, with numbers in names by value.

    Raises:
        FileNotFoundError: The folder holds no run.
        ValueError: One was started anew with another configuration, or a file is damaged.
    """
    runs, configs = list[Run](), list[dict]()
    for path in folder.glob("**/.hydra/overrides.yaml"):
        own, started = path.parents[1], path.parent / "config.yaml"
        stored, file = own / "config.yaml", own / "metrics.json"
        if (
            stored.is_file()
            and started.is_file()
            and differences(_read_yaml(stored, dict), _read_yaml(started, dict))
        ):
            raise ValueError(
                f"{own} holds a run of another configuration than the one last started there, and Hydra has rewritten "
                "its overrides\nstart the first multirun again"
            )
        typed = (override.partition("=") for override in _read_yaml(path, list))
        overrides = {
            key.lstrip("+"): re.sub(r"\\(.)", r"\1", value) for key, _, value in typed
        }  # without escapes
        config: dict = next(
            (_read_yaml(path, dict) for path in (stored, started) if path.is_file()), {}
        )
        metrics, failure = (read_metrics(file), None) if file.is_file() else (None, _failure(own))
        doubts = _correct(overrides, config)
        runs.append(
            Run(own.relative_to(folder).as_posix(), overrides, metrics, failure, own, doubts)
        )
        configs.append(config)
    if not runs:
        raise FileNotFoundError(
            f"{folder} must hold runs, each with its .hydra/overrides.yaml\n"
            "pass the folder that Hydra made for 'python -m gaigs --multirun ...'"
        )
    runs = _tell_apart(runs, configs)
    # Text and numbers alternate, so that equal types are compared.
    parts = lambda name: [
        int(part) if i % 2 else part for i, part in enumerate(re.split(r"([0-9]+)", name))
    ]
    runs.sort(key=lambda run: parts(run.name))
    return runs


def _correct(overrides: dict[str, str], config: dict) -> tuple[str, ...]:
    """Replaces overrides that differ from the run's configuration by its values; returns a sentence
    for each.

    Presets without a name of their own, such as experiments, are not in the configuration. A
    tokenizer that no part reads becomes ``none``.
    """
    doubts = []
    for key, value in overrides.items():
        there: Any = config
        for part in key.split("."):
            there = there.get(part, MISSING) if isinstance(there, dict) else MISSING
        if isinstance(there, dict):
            there = there.get("name", MISSING)
            known = [value, *(OmegaConf.load(file).get("name") for file in files_of(key, value))]
        else:
            known = [there if "${" in value or isinstance(there, list) else _parsed(value)]
        if there is not MISSING and there not in known:
            overrides[key] = str(there)
            doubts.append(
                f".hydra/overrides.yaml has {key}={value}, and config.yaml {there}, which counts"
            )
    if "tokenizer" in overrides and _is_unread("tokenizer", config):
        overrides["tokenizer"] = "none"
    return tuple(doubts)


def _parsed(value: str) -> Any:
    try:
        parsed = OverridesParser.create().parse_override(f"key={value}").value()
    except HydraException:
        return value
    return str(parsed) if isinstance(parsed, QuotedString | list | dict) else parsed


def _is_unread(key: str, config: Mapping) -> bool:
    """True for the tokenizer of a model whose deformation takes no tokens."""
    return key == "tokenizer" and (config.get("deformation") or {}).get("name") == "none"


def _tell_apart(runs: list[Run], configs: list[dict]) -> list[Run]:
    """Runs with the same overrides, though they differ in more than the seed, with values of their
    configurations.
    """
    own = {}
    for run, config in zip(runs, configs, strict=True):
        parts = {key: value for key, value in config.items() if not _is_unread(key, config)}
        # A model's configuration repeats those of its parts.
        alone = {
            key: value for key, value in (config.get("model") or {}).items() if key not in config
        }
        own[run.folder] = parts | {"model": alone}
    for group in by_seed(runs):
        first, *others = (own[run.folder] for run in group)
        keys = dict.fromkeys(key for other in others for key in differences(first, other))
        for key in (key for key in keys if key.rpartition(".")[2] != "seed"):
            values = {
                run.folder: str(OmegaConf.select(OmegaConf.create(own[run.folder]), key))
                for run in group
            }
            usual = Counter(values.values()).most_common(1)[0][0]
            for run in group:
                run.overrides[key.removesuffix(".name")] = value = values[run.folder]
                if value != usual:
                    doubt = f".hydra/overrides.yaml has no {key.removesuffix('.name')}, and config.yaml {value}"
                    runs[runs.index(run)] = run._replace(doubts=(*run.doubts, doubt))
    return runs


def _failure(folder: Path) -> str | None:
    """The last line of a job's log, if it is the error by which the job ended."""
    logs = [log for log in folder.glob("*.log") if not log.name.startswith("train_ddp")]
    last = "".join(log.read_text(errors="replace") for log in logs).rstrip().rpartition("\n")[2]
    return last.removeprefix("gaigs: ") if last.startswith("gaigs: ") else None
