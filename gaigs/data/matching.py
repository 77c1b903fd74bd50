"""Links against the scene that a model was made for."""

import torch
from torch import Tensor

from gaigs.data import Links
from gaigs.scene import Scene


def check_fit(links: Links, scene: Scene | None = None) -> None:
    """Raises a ``ValueError`` unless links have a split, and the receivers and labels of a model's scene if given."""
    if links.split is None:
        raise ValueError("links must have a split; gaigs.links(..., split='random') gives one")
    if scene is None:
        return
    there, here = scene.task, links.task
    axes = lambda task: {key: value for key, value in task.state().items() if key != "normalisation"}
    if there.name != here.name or tuple(there.shape) != tuple(here.shape) or not are_alike(axes(there), axes(here)):
        raise ValueError(
            f"links must have the model's labels, {there.name!r} {tuple(there.shape)} with the same axes, got "
            f"{here.name!r} {tuple(here.shape)}"
        )
    places = [
        [(each.pose.position, each.pose.rotation, each.array.elements, each.array.pattern) for each in receivers]
        for receivers in (scene.receivers, links.receivers)
    ]
    if not are_alike(*places):
        names = [", ".join(each.name for each in receivers) for receivers in (scene.receivers, links.receivers)]
        raise ValueError(
            f"links must have the model's receivers in the same order, with the same poses and arrays: "
            f"{names[0]}; got {names[1]}"
        )


def are_alike(a: object, b: object) -> bool:
    """True if nested values are equal, tensors to 1e-5."""
    if isinstance(a, Tensor):
        is_same = isinstance(b, Tensor) and a.shape == b.shape
        return is_same and torch.allclose(a.double(), b.double(), rtol=1e-6, atol=1e-5)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(are_alike(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(are_alike, a, b))
    return a == b
