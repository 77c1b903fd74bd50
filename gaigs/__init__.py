"""Wireless channels predicted with 3-D Gaussian splatting.

>>> import gaigs
>>> links = gaigs.links("synthetic_rssi")  # any registered reader
>>> model = gaigs.train(links, max_steps=300)  # tries several models; or train("mirrored", links)
>>> print(gaigs.evaluate(model, links))  # beside the task's baselines
>>> levels = model.predict([[1.0, 2.0, 1.5]])  # [m] -> (places, receivers) [dBm]
>>> model.save("room.ckpt")
>>> model = gaigs.load("room.ckpt")

``python -m gaigs`` does the same from the command line: it composes a configuration and calls
``gaigs.run``.
"""

import importlib
from types import FunctionType
from typing import TYPE_CHECKING

from gaigs.version import __version__

if TYPE_CHECKING:
    from gaigs.calibration import Estimate
    from gaigs.commands import run
    from gaigs.commands.describe import Description, describe
    from gaigs.commands.export import export
    from gaigs.commands.locate.fingerprints import Fingerprints
    from gaigs.commands.locate.location import Location
    from gaigs.commands.locate.posterior import locate
    from gaigs.commands.locate.prediction_map import fingerprints
    from gaigs.commands.place.plan import SitePlan, place
    from gaigs.commands.survey.plan import SurveyPlan, survey
    from gaigs.commands.view import View, view
    from gaigs.configuration import compose
    from gaigs.core.antenna import Array, Receiver
    from gaigs.core.geometry import Frame, Grid, Pose, Rays
    from gaigs.core.query import Query
    from gaigs.core.radio_maps import radio_map
    from gaigs.core.results import plot
    from gaigs.core.scene import Scene
    from gaigs.core.task import Metric
    from gaigs.data import Links
    from gaigs.data.links import links
    from gaigs.model import Model
    from gaigs.registry import register, registries
    from gaigs.runs import load
    from gaigs.runs.evaluation import evaluate
    from gaigs.runs.training import train
    from gaigs.splatting.rasterizer import rasterize

PLACES = {
    "Estimate": "calibration",
    "run": "commands",
    "describe": "commands.describe",
    "Description": "commands.describe",
    "export": "commands.export",
    "locate": "commands.locate.posterior",
    "Location": "commands.locate.location",
    "fingerprints": "commands.locate.prediction_map",
    "Fingerprints": "commands.locate.fingerprints",
    "place": "commands.place.plan",
    "SitePlan": "commands.place.plan",
    "survey": "commands.survey.plan",
    "SurveyPlan": "commands.survey.plan",
    "view": "commands.view",
    "View": "commands.view",
    "compose": "configuration",
    "Receiver": "core.antenna",
    "Array": "core.antenna",
    "Grid": "core.geometry",
    "Frame": "core.geometry",
    "Rays": "core.geometry",
    "Pose": "core.geometry",
    "Query": "core.query",
    "radio_map": "core.radio_maps",
    "plot": "core.results",
    "Scene": "core.scene",
    "Metric": "core.task",
    "Links": "data",
    "links": "data.links",
    "Model": "model",
    "register": "registry",
    "registries": "registry",
    "load": "runs",
    "evaluate": "runs.evaluation",
    "train": "runs.training",
    "rasterize": "splatting.rasterizer",
}
"""The module of each public name, imported when the name is first used: torch is slow."""

__all__ = [
    "Array", "Description", "Estimate", "Fingerprints", "Frame", "Grid", "Links", "Location",
    "Metric", "Model", "Pose", "Query", "Rays", "Receiver", "Scene", "SitePlan", "SurveyPlan",
    "View", "__version__", "compose", "describe", "evaluate", "export", "fingerprints", "links",
    "load", "locate", "place", "plot", "radio_map", "rasterize", "register", "registries", "run",
    "survey", "train", "view",
]  # fmt: skip


def __getattr__(name: str):
    if name == "sklearn":  # a module, which takes scikit-learn
        return importlib.import_module("gaigs.sklearn")
    if name not in PLACES:
        raise AttributeError(f"module 'gaigs' has no attribute {name!r}")
    module = importlib.import_module(f"gaigs.{PLACES[name]}")
    value = getattr(module, name)
    # The decorator of ``register`` looks at its caller, and ``compose`` needs no torch.
    if isinstance(value, FunctionType) and name not in ("register", "compose"):
        from gaigs.registry.torch_modes import usual_modes

        value = usual_modes()(value)
        setattr(module, name, value)  # where pickle looks for it
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *PLACES})
