"""Wireless channels predicted with 3-D Gaussian splatting.

>>> import gaigs
>>> links = gaigs.links("synthetic")  # any registered reader
>>> model = gaigs.train("mirrored", links, max_steps=300)  # any registered model
>>> print(gaigs.evaluate(model, links))  # beside the task's baselines
>>> spectra = model.predict([[1.0, 2.0, 1.5]])  # positions [m] -> (places, receivers, rows, columns)
>>> model.save("room.ckpt")
>>> model = gaigs.load("room.ckpt")

``python -m gaigs`` does the same from the command line: it composes a configuration and calls ``gaigs.run``.
"""

import importlib
import inspect
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from gaigs.registry.modes import usual_modes
from gaigs.version import __version__

if TYPE_CHECKING:
    from gaigs.antenna import Array, Receiver
    from gaigs.configuration import compose
    from gaigs.data import Links
    from gaigs.data.links import links
    from gaigs.describing import Description, describe
    from gaigs.exporting import export
    from gaigs.geometry import Frame, Grid, Pose, Rays
    from gaigs.kriging.intervals import Estimate
    from gaigs.locating import Fingerprints, Location, fingerprints, locate
    from gaigs.model import Model
    from gaigs.query import Query
    from gaigs.radio_maps import radio_map
    from gaigs.rasterizer import rasterize
    from gaigs.registry import register, registries
    from gaigs.runs import load
    from gaigs.runs.evaluation import evaluate
    from gaigs.runs.training import train
    from gaigs.scene import Scene
    from gaigs.surveying import SurveyPlan, survey
    from gaigs.task import Metric
    from gaigs.viewing import View, view


PLACES = {
    "links": "data.links", "train": "runs.training", "evaluate": "runs.evaluation", "load": "runs",
    "compose": "configuration", "rasterize": "rasterizer", "radio_map": "radio_maps", "register": "registry",
    "registries": "registry", "Model": "model", "Links": "data", "Query": "query", "Grid": "geometry",
    "Frame": "geometry", "Rays": "geometry", "Receiver": "antenna", "Array": "antenna", "Pose": "geometry",
    "Scene": "scene", "Metric": "task", "survey": "surveying", "SurveyPlan": "surveying",
    "Estimate": "kriging.intervals", "locate": "locating", "Location": "locating", "fingerprints": "locating",
    "Fingerprints": "locating",
    "describe": "describing", "Description": "describing",
    "export": "exporting",
    "view": "viewing", "View": "viewing",
}  # fmt: skip
"""The module of each public name, which is imported when the name is first used: torch is slow to import."""

__all__ = [
    "Array", "Description", "Estimate", "Fingerprints", "Frame", "Grid", "Links", "Location", "Metric", "Model", "Pose",
    "Query", "Rays", "Receiver", "Scene", "SurveyPlan", "View", "__version__", "compose", "describe", "evaluate",
    "export", "fingerprints", "links", "load", "locate", "radio_map", "rasterize", "register", "registries", "run",
    "survey", "train", "view",
]  # fmt: skip


def __getattr__(name: str):
    if name not in PLACES:
        raise AttributeError(f"module 'gaigs' has no attribute {name!r}")
    module = importlib.import_module(f"gaigs.{PLACES[name]}")
    value = getattr(module, name)
    if inspect.isfunction(value) and name != "register":  # the decorator of ``register`` looks at its caller
        value = usual_modes()(value)
        setattr(module, name, value)  # where pickle looks for it
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *PLACES})


@usual_modes()
def run(configuration: Mapping, folder: str | Path) -> dict | None:
    """Executes the command of a configuration, as ``python -m gaigs`` does; resumes a run that was stopped.

    Args:
        configuration: The result of ``gaigs.compose``.
        folder: Gets the results; with ``command=train`` the run folder of docs/start.md.

    Returns:
        With ``command=train`` the contents of ``metrics.json``, or None in all but the first of several processes.
        None with the other commands.

    Raises:
        TypeError, ValueError: The configuration does not fit the data, or the folder holds another run.
        ImportError: A component needs a package that is not installed.
        OSError: A file cannot be read or written; no partial file is left.
        KeyboardInterrupt: Ctrl-C; ``gaigs.processes.Stopped`` for it, SIGTERM and SIGHUP within a training.

    Example:
        >>> configuration = gaigs.compose("model=knn", "data.transmitters=40", "data.order=0", baselines=["mean"])
        >>> metrics = gaigs.run(configuration, "runs/room")
        Test scores
        ...
        results: runs/room
        >>> list(metrics["models"])
        ['knn', 'mean']
    """
    from gaigs import configuration as configurations
    from gaigs.registry import call
    from gaigs.report.formats import figure_formats

    if not isinstance(configuration, Mapping):
        raise TypeError(f"configuration must be the result of gaigs.compose, got {configuration!r:.80}")
    config, folder = dict(configuration), Path(folder)
    if config.get("command") == "devices":  # works with any other keys
        from gaigs.rasterizer.devices import default_device, devices

        names, default = devices(), default_device()
        for number, name in enumerate(names):
            print(f"{name}  <- rasterizer=opencl takes this one" if number == names.index(default) else name)
        return None
    configurations.check(config)
    with call("figures", figure_formats, config["figures"]):
        return _execute(config, folder)


def _execute(config: dict, folder: Path) -> dict | None:
    """Executes the command of a checked configuration."""
    from gaigs import processes

    match config["command"]:
        case "train":
            from gaigs import runs

            return runs.run(config, folder)
        case "agreement" | "describe" | "survey" | "locate" | "export" as command:
            from gaigs import agreement, describing, exporting, locating, stages, surveying

            modules = {
                "agreement": agreement, "describe": describing, "survey": surveying, "locate": locating,
                "export": exporting,
            }  # fmt: skip
            shows = config["trainer"].get("enable_progress_bar", True)
            with processes.limited_threads(config["threads"]), stages.watched(shown=shows):
                modules[command].run(config, folder)
        case "view":
            from gaigs import viewing

            with processes.limited_threads(config["threads"]):
                viewing.run(config)
        case unknown:
            from gaigs.registry import suggest

            scripts = {
                "report": "python -m gaigs.report FOLDER makes its tables",
                "benchmark": "python benchmarks/step.py and others measure, in a clone",
            }
            if unknown in scripts:
                raise ValueError(f"there is no command {unknown!r}; {scripts[unknown]}")
            known = "train", "agreement", "describe", "survey", "locate", "export", "view", "devices"
            raise ValueError(f"command must be one of {', '.join(known)}, got {suggest(unknown, known)}")
    return None
