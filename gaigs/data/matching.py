"""Links against the scene that a model was made for."""

from typing import Any

import torch
from torch import Tensor

from gaigs.core.scene import Scene
from gaigs.data import Links


def check_fit(links: Links, scene: Scene | None = None) -> None:
    """Raises a ``ValueError`` unless links have a split and, with a model's scene, its receivers
    and labels.
    """
    if links.split is None:
        raise ValueError("links must have a split; gaigs.links(..., split='random') gives one")
    if scene is None:
        return
    axes = [task.state() | {"normalisation": ""} for task in (scene.task, links.task)]
    if not are_alike(*axes):
        expected, got = (f"{task.name!r} {tuple(task.shape)}" for task in (scene.task, links.task))
        raise ValueError(
            f"links must have the model's labels, {expected} with the same axes, got {got}"
        )
    both = scene.receivers, links.receivers
    antennas = [
        [(r.pose.position, r.pose.rotation, r.array.elements, r.array.pattern) for r in each]
        for each in both
    ]
    if not are_alike(*antennas):
        expected, got = (", ".join(receiver.name for receiver in each) for each in both)
        raise ValueError(
            f"links must have the model's receivers in the same order, with the same poses and arrays: {expected}; "
            f"got {got}"
        )


def are_alike(a: Any, b: Any) -> bool:
    """True if nested values are equal, tensors to 1e-5."""
    if isinstance(a, Tensor):
        is_same = isinstance(b, Tensor) and a.shape == b.shape
        return is_same and torch.allclose(a.double(), b.double(), rtol=1e-6, atol=1e-5)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(are_alike(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(are_alike, a, b))
    return a == b
