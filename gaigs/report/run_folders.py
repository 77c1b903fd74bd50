"""Runs read from the folder of a Hydra multirun, or of several."""

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
from gaigs.report.scores import headline


class Run(NamedTuple):
    """One job of a multirun."""

    name: str  # its sub-folder
    folder: Path  # path of this folder
    overrides: dict[str, str]  # values of the command line, by key
    config: dict  # the run's configuration; empty if it is unknown
    # Contents of ``metrics.json``; None where the job failed, was stopped or still runs.
    metrics: dict | None
    failure: str | None  # the error of a failed job; else None
    doubts: list[str]  # sentences on overrides that differ from the run's configuration


def by_seed(runs: Sequence[Run]) -> list[list[Run]]:
    """Groups of runs that differ only in the override ``seed``, in the order of first runs."""
    groups: dict[frozenset, list[Run]] = {}
    for run in runs:
        fixed = frozenset((key, value) for key, value in run.overrides.items() if key != "seed")
        groups.setdefault(fixed, []).append(run)
    return [*groups.values()]


def read_metrics(file: Path) -> dict:
    """Contents of a run's ``metrics.json``; a ``ValueError`` if it is damaged."""
    try:
        metrics = json.loads(file.read_text())
        _check_metrics(metrics)
    # Errors of JSON and of encodings are ValueErrors.
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"cannot read {file} ({type(error).__name__}: {error})\n"
            "move it elsewhere, and start the run again, which does not train a second time"
        ) from error
    return metrics


def _check_metrics(metrics: Any) -> None:
    """Raises an error unless metrics have the entries that tables need, of the right types."""
    task = metrics["task"]
    if not metrics["models"]:
        raise ValueError("no model")
    main_metric, _ = headline(task, metrics["models"])
    for key, kind in (("split", str), ("seed", int), ("device", str)):
        check_type(repr(key), metrics.get(key), kind)
    check_type("'train_seconds'", metrics.get("train_seconds"), float | None)
    receivers = metrics.get("receivers") or {}
    for models in (metrics["models"], metrics.get("validation") or {}, *receivers.values()):
        for scores in models.values():
            check_type(repr(main_metric), scores[main_metric], float)


def read_runs(folder: Path) -> list[Run]:
    """The runs at any depth of a folder, sorted by name; numbers in names by value."""
    places = [file.parents[1] for file in folder.glob("**/.hydra/overrides.yaml")]
    if not places:
        raise FileNotFoundError(
            f"{folder} must hold runs, each with its .hydra/overrides.yaml\n"
            "pass the folder that Hydra made for 'python -m gaigs --multirun ...'"
        )
    runs = [_read_run(place, place.relative_to(folder).as_posix()) for place in places]
    _add_differing_options(runs)
    return sorted(runs, key=_by_number)


def _by_number(run: Run) -> list[str | int]:
    """A key to sort runs by name; numbers in names count by value."""
    # The split alternates text and digits, beginning with text: equal types are compared.
    parts = re.split(r"([0-9]+)", run.name)
    return [int(part) if number % 2 else part for number, part in enumerate(parts)]


def _read_run(folder: Path, name: str) -> Run:
    """The run in a folder; a ``ValueError`` if files are damaged or of two configurations."""
    file = folder / "metrics.json"
    configs = []
    for path in (folder / "config.yaml", folder / ".hydra" / "config.yaml"):
        if path.is_file():
            configs.append(_read_yaml(path, dict))
    # The first belongs to the run, the last to the job that was started there last.
    if configs and differences(configs[0], configs[-1]):
        raise ValueError(
            f"{folder} holds a run of another configuration than the one last started there, "
            "and Hydra has rewritten its overrides\nstart the first multirun again"
        )
    config = configs[0] if configs else {}
    overrides = {}
    for override in _read_yaml(folder / ".hydra" / "overrides.yaml", list):
        key, _, value = override.partition("=")
        overrides[key.lstrip("+")] = re.sub(r"\\(.)", r"\1", value)  # without escapes
    is_done = file.is_file()
    metrics = read_metrics(file) if is_done else None
    failure = None if is_done else _failure(folder)
    return Run(name, folder, overrides, config, metrics, failure, _correct(overrides, config))


def _read_yaml(file: Path, kind: type) -> Any:
    """Content of a file that Hydra wrote; a ``ValueError`` unless its type is ``kind``."""
    try:
        content = OmegaConf.to_container(OmegaConf.load(file), resolve=kind is dict)
        check_type("its content", content, kind)
    except (OmegaConfBaseException, yaml.YAMLError, TypeError, ValueError, OSError) as error:
        raise ValueError(
            f"cannot parse {file}, which Hydra wrote: {' '.join(str(error).split())}"
        ) from error
    return content


def _correct(overrides: dict[str, str], config: dict) -> list[str]:
    """Replaces overrides in place by the configuration's values.

    Presets without a name in the configuration, such as experiments, are not replaced. A tokenizer
    that no part uses becomes ``none``.

    Returns:
        A sentence for each override that differed.
    """
    doubts = []
    absent = object()  # None is a value
    for key, text in overrides.items():
        configured: Any = config
        for part in key.split("."):
            configured = configured.get(part, absent) if isinstance(configured, dict) else absent
        if isinstance(configured, dict):
            # A component is configured by its name, or by a preset of another name.
            configured = configured.get("name", absent)
            accepted = [text, *(OmegaConf.load(file).get("name") for file in files_of(key, text))]
        elif "${" in text or isinstance(configured, list):
            accepted = [configured]  # text of a reference or a list has no value to compare
        else:
            accepted = [_parsed(text)]
        if configured is not absent and configured not in accepted:
            overrides[key] = str(configured)
            doubts.append(
                f".hydra/overrides.yaml has {key}={text}, "
                f"and config.yaml {configured}, which counts"
            )
    if "tokenizer" in overrides and _has_unread_tokenizer(config):
        overrides["tokenizer"] = "none"
    return doubts


def _parsed(text: str) -> Any:
    """The value that Hydra reads from the text of an override."""
    try:
        value = OverridesParser.create().parse_override(f"key={text}").value()
    except HydraException:
        return text
    return str(value) if isinstance(value, QuotedString | list | dict) else value


def _has_unread_tokenizer(config: Mapping) -> bool:
    """True for a model whose deformation uses no tokens."""
    return (config.get("deformation") or {}).get("name") == "none"


def _add_differing_options(runs: list[Run]) -> None:
    """Adds options in which runs of a group differ to their ``overrides``.

    The runs of a group have the same overrides except the seed, so such differences come from
    ``config.yaml``. A run whose value differs from most of the group gets a note in ``doubts``.
    """
    for group in by_seed(runs):
        configs = {run.folder: _compared(run.config) for run in group}
        first, *others = configs.values()
        keys: dict[str, None] = {}
        for other in others:
            keys |= dict.fromkeys(differences(first, other))
        for key in keys:
            if key.rpartition(".")[2] == "seed":
                continue
            values = {
                folder: str(OmegaConf.select(OmegaConf.create(config), key))
                for folder, config in configs.items()
            }
            ((usual, _),) = Counter(values.values()).most_common(1)
            option = key.removesuffix(".name")
            for run in group:
                value = values[run.folder]
                run.overrides[option] = value
                if value != usual:
                    run.doubts.append(
                        f".hydra/overrides.yaml has no {option}, and config.yaml {value}"
                    )


def _compared(config: Mapping) -> dict:
    """The configuration as it is compared between runs.

    It lacks a model's copies of other parts, such as of the deformation, and an unused tokenizer.
    """
    parts = {**config}
    if _has_unread_tokenizer(config):
        parts.pop("tokenizer", None)
    # A model's configuration repeats the configurations of its parts.
    model = config.get("model") or {}
    return parts | {"model": {key: value for key, value in model.items() if key not in config}}


def _failure(folder: Path) -> str | None:
    """The error that ended a job, from the last line of its log; None if it is no error."""
    logs = [log for log in folder.glob("*.log") if not log.name.startswith("train_ddp")]
    last = "".join(log.read_text(errors="replace") for log in logs).rstrip().rpartition("\n")[2]
    return last.removeprefix("gaigs: ") if last.startswith("gaigs: ") else None
