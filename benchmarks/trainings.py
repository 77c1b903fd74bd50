"""Benchmarks whose rows are whole runs, each in a folder of its own: ``accuracy.py``,
``budgets.py``.
"""

import argparse
import gc
import json
import math
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import common
import yaml
from common import UNAVAILABLE, Benchmark, Row, grouped, log
from omegaconf import OmegaConf

import gaigs
from gaigs.configuration import run_folder
from gaigs.data import load
from gaigs.processes import lacks_memory
from gaigs.registry import listed
from gaigs.report.scores import COSTS, monitor_names, task_class, train_seconds
from gaigs.report.training_log import read_validations


class Axis(NamedTuple):
    """Runs that differ in one key.

    Attributes:
        of: Overrides of the reference.
        key: The key.
        values: Its values; None: multiples of a default of whole numbers; none: no such runs.
    """

    of: list[str]
    key: str
    values: list | None = None


def command_line(doc: str) -> argparse.ArgumentParser:
    """The options of benchmarks of runs."""
    parser = common.command_line(doc)
    text = "values of an axis instead of its own; [] leaves it out"
    add = parser.add_argument
    add(
        "--values",
        action="append",
        type=values_of_axis,
        default=[],
        metavar="AXIS=[...]",
        help=text,
    )
    return parser


def values_of_axis(text: str) -> tuple[str, list]:
    """Name and values of an axis, as a type of ``argparse``."""
    name, _, value = text.partition("=")
    found = yaml.safe_load(value)
    if not isinstance(found, list):
        raise ValueError
    return name, found


class Trainings(Benchmark):
    """Rows are runs that differ from a reference in one key.

    Attributes:
        trainer: Overrides of ``trainer`` for each run; the command line has precedence.
        axes: Axes by name.
        scene: Overrides of the command line but those of ``trainer``.
    """

    keys = ("device", "scene", "trainer", "of", "key", "default", "axis", "value")
    values = ("task", "split", "seed", "steps", "validation", "test", "compared", *COSTS, "curve")
    trainer: tuple[str, ...] = ()
    axes: dict[str, Axis]

    def __init__(self, options: argparse.Namespace):
        super().__init__(options)

        def key_of(word):
            return word.lstrip("+~").partition("=")[0]

        given = {key_of(word): word for word in options.overrides}
        own = {key: word for key, word in given.items() if key.startswith("trainer.")}
        self.scene = [word for word in options.overrides if key_of(word) not in own]
        self.trainer = tuple(({key_of(word): word for word in self.trainer} | own).values())
        self.axes = dict(self.axes)
        for name, values in options.values:
            if name not in self.axes:
                raise ValueError(f"--values: no axis {name!r}; there are: {listed([*self.axes])}")
            self.axes[name] = self.axes[name]._replace(values=values)

    def check_links(self) -> None:
        """Raises an error for data without validation links."""
        config = self.config
        split = load(config["data"], config["split"], config["task"]["name"]).split
        if not len(split.validation):
            raise ValueError(
                f"split {split.name} must have validation links; set split.validation above 0"
            )

    def compose(self, device: str, overrides: Sequence[str]) -> dict:
        """The configuration of a run; look-ups are runs of their own, so it has no baselines."""
        words = (*self.scene, *self.trainer, f"trainer.accelerator={device}", "baselines=[]")
        return gaigs.compose(*words, *overrides)

    def cell(self, of: Sequence[str], **keys: str) -> list[Row]:
        """The cell of one run."""
        row = {"scene": " ".join(self.scene), "trainer": " ".join(self.trainer)}
        return [row | {"of": shlex.join(of), "default": ""} | keys]

    def cells_of_axes(self, device: str) -> Iterator[list[Row]]:
        """Cells of each axis whose key the reference has."""
        for name, axis in self.axes.items():
            if axis.values == []:
                continue
            try:
                config = OmegaConf.create(self.compose(device, axis.of))
            except ValueError as error:
                raise ValueError(
                    f"axis {name} (--values {name}=[] leaves it out): {error}"
                ) from error
            default = OmegaConf.select(config, axis.key)
            if default is None:
                log.info("%s is left out: this configuration has no %s", name, axis.key)
                continue
            if OmegaConf.is_config(default):
                default = [*default] if OmegaConf.is_list(default) else default.get("name")
            values = axis.values or multiples(default, self.options.factors)
            if not values:
                raise ValueError(f"axis {name} needs values, a list for {axis.key}")
            for value in values if default in values else [*values, default]:
                keys = {"key": axis.key, "value": written(value), "default": written(default)}
                yield self.cell(axis.of, axis=name, **keys)

    def measure(self, cell: Sequence[Row], device: str) -> Iterable[dict]:
        """Trains and tests, or reads the run that has ended in its folder."""
        (row,) = cell
        words = overrides_of(row)
        places = row["device"], f"{row['scene']} {row['trainer']}".strip(), ",".join(words)
        folder = self.options.folder.joinpath(self.name, *map(run_folder, places))
        log.info("%s: %s %s", self.name, row["axis"], " ".join(words))
        try:
            metrics = gaigs.run(self.compose(device, words), folder)
        except Exception as error:  # of whatever system; the next one goes on
            if lacks_memory(error) or (
                isinstance(error, OSError) and not isinstance(error, FileNotFoundError)
            ):
                raise
            text = f"{type(error).__name__}: {' '.join(str(error).removeprefix('gaigs: ').split())}"
            log.error("%s: %s", " ".join(words), text)
            return [row | {"status": UNAVAILABLE + text}]
        gc.collect()  # Lightning leaves reference cycles
        return [row | results(metrics, folder)]


class Score(NamedTuple):
    """Names of a task's first metric and mean validation score; title, unit (or "") and direction
    of the latter.
    """

    first: str
    mean: str
    title: str
    unit: str
    higher_is_better: bool

    @classmethod
    def of(cls, task: str) -> "Score":
        known = task_class(task).metrics()
        first = next(iter(known))
        mean = monitor_names(task)[1] or first
        title, is_better, _ = known[mean]
        return cls(first, mean, title, title.partition("[")[2].rstrip("]"), is_better)

    def loss(self, score: str | float) -> float:
        """A validation score as a number that is lower if the score is better; infinite for an
        empty text.
        """
        return math.inf if score == "" else (-1 if self.higher_is_better else 1) * float(score)


def sections(name: str, rows: Sequence[Row]) -> Iterator[tuple[str, Score, list[Row]]]:
    """Rows that can be compared with each other: a heading with their conditions and command,
    score, and rows.
    """
    groups = grouped(rows, "scene", "trainer", "device", "task", "split")
    for (scene, trainer, device, task, split), own in groups.items():
        scene = re.sub(r"=[/~.]\S*/", "=", scene)  # a page shows the last part of a path
        title = ", ".join(filter(None, (task, scene, f"split {split}")))
        command = " ".join(filter(None, (f"python benchmarks/{name}.py", scene, trainer)))
        conditions = "; ".join(filter(None, (device, trainer)))
        yield f"## {title}\n\n{conditions}\n\n```\n{command}\n```\n", Score.of(task), own


def overrides_of(row: Row) -> list[str]:
    """Overrides of a row's run beside those of the command line."""
    of = shlex.split(row["of"])
    if row["value"] == row["default"]:
        return of
    return [
        *(word for word in of if word.partition("=")[0] != row["key"]),
        f"{row['key']}={row['value']}",
    ]


def results(metrics: Mapping, folder: Path) -> dict:
    """Values of a run's row, from its ``metrics.json`` and its log; kriging is the last point of
    the curve.
    """
    task, own = metrics["task"], next(iter(metrics["models"]))
    score, test = Score.of(task), metrics["models"][own]
    validation = (metrics["validation"] or {}).get(own, {}).get(score.mean)
    points = read_validations(folder, monitor_names(task)[0])
    curve = [(seconds, value) for _, seconds, value in points if math.isfinite(seconds)]
    if metrics.get("kriging") and curve and validation is not None:
        curve.append((train_seconds(metrics) or 0.0, validation))
    found = {key: metrics[key] for key in ("task", "split", "seed", *COSTS)} | {
        "train_seconds": train_seconds(metrics)
    }
    found |= {"validation": validation, "test": test[score.mean], "compared": test.get(score.first)}
    found["steps"] = points[-1][0] + 1 if points else None
    return found | {"curve": " ".join(f"{time:.1f}:{value:.5g}" for time, value in curve)}


def multiples(default: object, factors: Sequence[float]) -> list:
    """Multiples of a whole number or of a list of them, each at least 1; none of other values."""
    entries = default if isinstance(default, list) else [default]
    if not all(type(entry) is int for entry in entries):
        return []
    found = dict.fromkeys(
        tuple(max(1, round(entry * factor)) for entry in entries) for factor in factors
    )
    return [[*value] if isinstance(default, list) else value[0] for value in found]


def written(value: object) -> str:
    """A value in the syntax of Hydra's command line."""
    if isinstance(value, Mapping):
        return "{" + ",".join(f"{key}: {written(entry)}" for key, entry in value.items()) + "}"
    if isinstance(value, list | tuple):
        return f"[{','.join(map(written, value))}]"
    if isinstance(value, str):
        return value if re.fullmatch(r"[\w.:+-]+", value) else f"'{value}'"
    return json.dumps(value)
