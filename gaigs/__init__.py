"""Wireless channels predicted with 3-D Gaussian splatting.

>>> import gaigs
>>> links = gaigs.links("synthetic")  # any registered reader
>>> model = gaigs.train("mirrored", links, max_steps=300)  # any registered model
>>> print(gaigs.evaluate(model, links))  # beside the task's baselines
>>> spectra = model.predict([[1.0, 2.0, 1.5]])  # positions [m]
>>> model.save("room.ckpt")
>>> model = gaigs.load("room.ckpt")

``python -m gaigs`` does the same from the command line: it composes a configuration and calls ``gaigs.run``.
"""

import importlib
from typing import TYPE_CHECKING

from gaigs.version import __version__

if TYPE_CHECKING:
    from gaigs.checkpoint import load
    from gaigs.commands import run
    from gaigs.configuration import compose
    from gaigs.data import Links, links
    from gaigs.directions import Grid, Rays
    from gaigs.evaluation import evaluate
    from gaigs.geometry import Pose
    from gaigs.model import Model
    from gaigs.query import Query
    from gaigs.radio_maps import radio_map
    from gaigs.rasterizer import rasterize
    from gaigs.registry import register, registries
    from gaigs.runs.training import train
    from gaigs.scene import Array, Receiver, Scene
    from gaigs.task import Metric

PLACES = {
    "links": "data", "train": "runs.training", "evaluate": "evaluation", "load": "checkpoint",
    "compose": "configuration", "run": "commands", "rasterize": "rasterizer", "radio_map": "radio_maps",
    "register": "registry", "registries": "registry", "Model": "model", "Links": "data", "Query": "query",
    "Grid": "directions", "Rays": "directions", "Receiver": "scene", "Array": "scene", "Pose": "geometry",
    "Scene": "scene", "Metric": "task",
}  # fmt: skip
"""The module of each public name, which is imported when the name is first asked for: torch is slow to import."""

__all__ = [
    "Array", "Grid", "Links", "Metric", "Model", "Pose", "Query", "Rays", "Receiver", "Scene", "__version__", "compose",
    "evaluate", "links", "load", "radio_map", "rasterize", "register", "registries", "run", "train",
]  # fmt: skip


def __getattr__(name: str):
    if name not in PLACES:
        raise AttributeError(f"module 'gaigs' has no attribute {name!r}")
    value = globals()[name] = getattr(importlib.import_module(f"gaigs.{PLACES[name]}"), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *PLACES})
