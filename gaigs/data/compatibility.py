"""Checks that links have the labels and receivers of a model's scene."""

from typing import Any

import torch
from torch import Tensor

from gaigs.core.antenna import Receiver
from gaigs.core.scene import Scene
from gaigs.data import Links


def check_fit(links: Links, scene: Scene | None = None) -> None:
    """Raises a ``ValueError`` unless links have a split, and receivers and labels of a scene.

    The scene is that of the model; None for a model that is not trained yet.
    """
    if links.split is None:
        raise ValueError("links must have a split; gaigs.links(..., split='random') gives one")
    if scene is None:
        return
    # The normalisation only describes the scale of the labels, and may differ.
    axes = [task.state() | {"normalisation": ""} for task in (scene.task, links.task)]
    if not are_alike(*axes):
        expected, got = (f"{task.name!r} {tuple(task.shape)}" for task in (scene.task, links.task))
        raise ValueError(
            f"links must have the model's labels, {expected} with the same axes, got {got}"
        )
    if not are_alike(_antennas(scene.receivers), _antennas(links.receivers)):
        expected = ", ".join(receiver.name for receiver in scene.receivers)
        got = ", ".join(receiver.name for receiver in links.receivers)
        raise ValueError(
            "links must have the model's receivers in the same order, with the same poses and "
            f"arrays: {expected}; got {got}"
        )


def _antennas(receivers: tuple[Receiver, ...]) -> list[tuple]:
    """Properties of receivers that labels depend on: pose, elements and pattern."""
    antennas = []
    for receiver in receivers:
        pose = receiver.pose
        array = receiver.array
        antennas.append((pose.position, pose.rotation, array.elements, array.pattern))
    return antennas


def are_alike(a: Any, b: Any) -> bool:
    """True if nested values are equal; numbers of tensors may differ by about 1e-5."""
    if isinstance(a, Tensor):
        is_same = isinstance(b, Tensor) and a.shape == b.shape
        return is_same and torch.allclose(a.double(), b.double(), rtol=1e-6, atol=1e-5)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(are_alike(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(are_alike, a, b))
    return a == b
