"""Benchmarks whose cells are whole runs: each in a folder of its own, one after the other, in this process."""

import gc
import hashlib
import logging
import math
import re
import shlex
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gaigs import runs
from gaigs.benchmark import MEASURED, NOT_MEASURED, UNAVAILABLE, Context, Measured, Row, device_of, named
from gaigs.configuration import run_folder
from gaigs.data import load
from gaigs.processes import lacks_memory
from gaigs.registry import check_type
from gaigs.report.curves import read_validations
from gaigs.report.runs import read_metrics, train_seconds
from gaigs.report.table import metrics_of, monitor_names
from gaigs.training.budget import seconds

log = logging.getLogger(__name__)

COSTS = ("train_seconds", "inference_ms", "render_ms", "num_parameters", "num_gaussians", "checkpoint_bytes")
"""What a row takes over from ``metrics.json`` as it is, but for the training, to which kriging is added."""

BAD = (OmegaConfBaseException, ValueError, TypeError, FileNotFoundError, ImportError, RuntimeError)
"""What says in a sentence why a run cannot be."""


class Trainings(Measured):
    """Rows are runs that differ from a reference in one key.

    Args:
        trainer: Options of ``trainer`` for each run, where the command line does not say otherwise.
        axes: By what a reader calls them: ``key``, the ``values`` that it takes and the reference, a list of overrides,
            as ``of``.
        minutes, device: As for every benchmark.

    Raises:
        TypeError, ValueError: An axis does not have this form.
    """

    keys = ("scene", "trainer", "of", "axis", "key", "value", "default", "device")
    values = ("task", "split", "seed", "steps", "validation", "test", "compared", *COSTS, "curve")

    def __init__(self, trainer: dict, axes: dict, minutes: float | None = None, device: str | None = None):
        super().__init__(minutes, device)
        self.trainer, self.axes = trainer, axes
        for name, axis in axes.items():
            check_type(f"benchmark.axes.{name}", axis, dict)
            if axis.keys() | {"values"} != {"key", "of", "values"}:
                raise ValueError(f"benchmark.axes.{name} must have key, of and values, got {', '.join(axis)}")
            check_type(f"benchmark.axes.{name}.key", axis["key"], str)
            check_type(f"benchmark.axes.{name}.of", axis["of"], list[str])
            check_type(f"benchmark.axes.{name}.values", axis.get("values"), list | None)

    def run(self, folder: Path, context: Context) -> None:
        """As for every benchmark; runs lie in the folder of its name.

        Raises:
            ValueError: An option does not suit, or a folder holds another run.
            OSError: A file cannot be written.
        """
        self.place = folder / self.name
        super().run(folder, context)

    def options(self, context: Context) -> list[str]:
        """Overrides of the trainer, but for what the command line says otherwise."""
        said = {word.lstrip("+~").partition("=")[0] for word in context.overrides}
        options = {f"trainer.{key}": value for key, value in self.trainer.items()}
        return [f"{key}={written(value)}" for key, value in options.items() if key not in said]

    def common(self, context: Context, device: str) -> list[str]:
        """Overrides of each run on a device: the trainer's, and no baselines, which are runs of their own."""
        return [*self.options(context), f"trainer.accelerator={device}", "baselines=[]"]

    def reference(self, context: Context) -> dict:
        """The command line's own configuration.

        Raises:
            ValueError, OSError: Its data cannot be read, or nothing of them validates: then no run would be of use.
        """
        config = context.compose()
        split = load(config["data"], config["split"], config["task"]["name"]).split
        if not len(split.validation):
            raise ValueError(
                f"benchmark={self.name} compares validation scores, and split {split.name} leaves no links to validate "
                "on; set split.validation above 0"
            )
        return config

    def cell(self, context: Context, device: str, of: Sequence[str], **keys: str) -> list[Row]:
        """A run: one row."""
        common = {"scene": scene(context.overrides), "trainer": " ".join(self.options(context))}
        return [common | {"of": shlex.join(of), "default": "", "device": named(device)} | keys]

    def cells_of_axes(self, context: Context, device: str) -> Iterator[list[Row]]:
        """Those of the axes whose key the reference has.

        Raises:
            ValueError: A key is a group of options, and no component; or an axis cannot be read.
        """
        common = self.common(context, device)
        for name, axis in self.axes.items():
            try:
                config = context.compose(*common, *axis["of"])
                default = OmegaConf.select(OmegaConf.create(config), axis["key"])
            except (ValueError, OmegaConfBaseException) as error:
                raise ValueError(
                    f"benchmark.axes.{name} must have overrides and a key of a run, and the command line with "
                    f"{' '.join(axis['of'])} and {axis['key']} cannot be read ({sentence(error)}); mend them"
                ) from error
            if default is None:
                log.info("%s: %s is left out, as there is no %s here", self.name, name, axis["key"])
                continue
            if OmegaConf.is_config(default):  # a list, or a component
                default = [*default] if OmegaConf.is_list(default) else default.get("name")
                if default is None:
                    raise ValueError(
                        f"benchmark.axes.{name}.key must be one option or a component, and {axis['key']} has options "
                        "of its own; take one of them"
                    )
            values = self.values_about(name, default) if axis.get("values") is None else axis["values"]
            for value in values if default in values else [*values, default]:
                keys = {"axis": name, "key": axis["key"], "value": written(value), "default": written(default)}
                yield self.cell(context, device, axis["of"], **keys)

    def values_about(self, axis: str, default: object) -> list:
        """Values of an axis that has none.

        Raises:
            ValueError: It needs some.
        """
        raise ValueError(f"benchmark.axes.{axis} needs values, a list for {self.axes[axis]['key']}, and has none")

    def measure(self, cell: Sequence[Row], context: Context) -> Iterable[Row]:
        """Trains and tests, unless that is done already, or there is no time for it.

        Raises:
            ValueError: The run's folder holds another one, or a damaged one.
            OSError: A file cannot be written.
        """
        (row,) = cell
        words = overrides(row)
        places = row["device"], " ".join((row["scene"], row["trainer"])).strip(), ",".join(words)
        folder = self.place.joinpath(*map(run_folder, places))
        try:
            config = context.compose(*self.common(context, device_of(row, context)), *words)
        except BAD as error:
            return [row | {"status": UNAVAILABLE + sentence(error)}]
        if folder.is_dir():
            runs.folder.claim(folder, config)  # its error is no matter of this row: the folder is another command's
        if (folder / "metrics.json").is_file():
            return [row | facts(read_metrics(folder / "metrics.json"), folder) | {"status": MEASURED}]
        longest = config["trainer"].get("max_time")
        if longest and seconds("trainer.max_time", longest) > context.seconds_left():
            return [row | {"status": NOT_MEASURED}]
        log.info("%s: %s %s", self.name, row["axis"], " ".join(words))
        try:
            metrics = runs.run(config, folder)
        except Exception as error:  # of whatever system: the next one goes on
            is_of_data = isinstance(error, BAD) and folder.is_dir()  # which a removed folder is not
            if lacks_memory(error) or (isinstance(error, OSError) and not is_of_data):
                raise
            log.error("%s: %s", " ".join(words), sentence(error))
            log.debug("", exc_info=True)  # with hydra.verbose=true
            return [row | {"status": UNAVAILABLE + sentence(error)}]
        gc.collect()  # what Lightning has tied in circles
        return [row | facts(metrics, folder) | {"status": MEASURED}]


def overrides(row: Row) -> list[str]:
    """Those by which a row's run differs from the command line's."""
    of = shlex.split(row["of"])
    if row["value"] == row["default"]:
        return of
    return [*(word for word in of if word.partition("=")[0] != row["key"]), f"{row['key']}={row['value']}"]


def facts(metrics: Mapping, folder: Path) -> dict:
    """What a row has of a run."""
    task, own = metrics["task"], next(iter(metrics["models"]))
    monitor, mean = monitor_names(task)
    first = next(iter(metrics_of(metrics)))
    mean = mean or first
    validation = (metrics["validation"] or {}).get(own, {}).get(mean)
    points = read_validations(folder, monitor)
    curve = [(point.seconds, point.score) for point in points if math.isfinite(point.seconds)]
    if metrics.get("kriging") and curve and validation is not None:
        curve.append((train_seconds(metrics), validation))  # which follows the training
    found = {"task": task, "split": metrics["split"], "seed": metrics["seed"], "validation": validation}
    found |= {"steps": points[-1].step + 1 if points else None, "test": metrics["models"][own][mean]}
    found |= {"compared": metrics["models"][own][first], "curve": " ".join(f"{t:.1f}:{v:.5g}" for t, v in curve)}
    return found | {key: metrics[key] for key in COSTS} | {"train_seconds": train_seconds(metrics)}


def scene(words: Iterable[str]) -> str:
    """The command line's overrides as a page may show them: of places the last part, and what tells them apart."""
    shown = []
    for word in words:
        key, equals, value = word.partition("=")
        if value.startswith(("/", "~", ".")):
            place = Path(value).expanduser().absolute()
            value = f"{place.name}#{hashlib.sha256(str(place).encode()).hexdigest()[:6]}"
        shown.append(key + equals + value)
    return " ".join(shown)


def written(value: object) -> str:
    """A value as Hydra reads it."""
    match value:
        case None | bool():
            return {None: "null", True: "true", False: "false"}[value]
        case Mapping():
            return "{" + ",".join(f"{key}: {written(entry)}" for key, entry in value.items()) + "}"
        case list() | tuple():
            return f"[{','.join(map(written, value))}]"
    text = str(value)
    return text if re.fullmatch(r"[\w.:+-]+", text) else f"'{text}'"


def sentence(error: BaseException) -> str:
    """An error in one line; of one that is not meant for users its type, too."""
    text = " ".join(str(error).removeprefix("gaigs: ").split())
    return text if text and isinstance(error, BAD) else f"{type(error).__name__}: {text}".removesuffix(": ")
