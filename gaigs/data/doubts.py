"""Doubts about data that were read: sizes in another unit or frame, spectra without a direction."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.antenna import Receiver
from gaigs.io.images import GreyImages
from gaigs.task import Task
from gaigs.task.spectrum import Spectrum

LARGEST = 50.0
"""Ratio of two diagonals above which one is probably in another unit: millimetres differ by 1000."""


def doubts(
    task: Task,
    labels: Tensor | GreyImages,
    transmitters: Float[Tensor, "n 3"],
    receivers: Sequence[Receiver],
    edges: Float[Tensor, "k 2 3"],
) -> list[str]:
    """Sentences about walls, arrays and spectra that do not fit the other data.

    Raises:
        ValueError: All spectra are constant.
    """
    stands = torch.stack([receiver.pose.position for receiver in receivers]).to(transmitters)
    places = torch.cat((transmitters, stands))
    found = [walls_doubt(edges.flatten(0, 1), places)] if len(edges) else []
    room = _diagonal(places)
    for receiver in receivers:
        if (extent := _diagonal(receiver.array.elements)) > room > 0:
            found.append(
                f"the array of {receiver.name} is {extent:.3g} m across, transmitters and receivers {room:.3g} m; "
                "are its elements in m?"
            )
    if isinstance(task, Spectrum):
        found += _spectra_doubts(task, labels)
    return [doubt for doubt in found if doubt]


def walls_doubt(walls: Float[Tensor, "k 3"], places: Float[Tensor, "n 3"]) -> str:
    """A sentence if walls are in another unit or elsewhere than transmitters and receivers as seen from above."""
    own, room = _diagonal(walls[:, :2]), _diagonal(places[:, :2])
    if own and room and not 1 / LARGEST < own / room < LARGEST:
        return f"the walls are {own:.3g} m across, transmitters and receivers {room:.3g} m; are both in m?"
    lower, upper = walls[:, :2].amin(0), walls[:, :2].amax(0)
    apart = torch.maximum(lower - places[:, :2].amax(0), places[:, :2].amin(0) - upper).clamp_min(0).norm().item()
    if apart > 0.1 * (own + room):  # a single wall stands apart, too
        return f"the walls are {apart:.3g} m from all transmitters and receivers; are both in one frame?"
    return ""


def _diagonal(points: Float[Tensor, "k d"]) -> float:
    return (points.amax(0) - points.amin(0)).norm().item()


def _spectra_doubts(task: Spectrum, labels: Tensor | GreyImages) -> list[str]:
    """Counts of constant spectra, and of min-max spectra without a pixel of 0 or of 1."""
    parts = (labels[index].flatten(1) for index in torch.arange(len(labels)).split(256))
    low, high = torch.cat([torch.stack((part.amin(1), part.amax(1)), 1) for part in parts]).T
    constant = low == high
    if constant.all():
        raise ValueError(f"a spectrum must have pixels of different values; all {len(labels)} are constant")
    whole = ~torch.tensor(task.normalisation.startswith("min-max")) | ((low == 0) & (high == 1)) | constant
    found = []
    for which, defect in ((constant, "are constant"), (~whole, "lack a pixel of 0 or of 1")):
        if which.any():
            first = int(which.nonzero()[0])
            span = f"{low[first]:.3g} to {high[first]:.3g}"
            found.append(f"{int(which.sum())} of {len(labels)} spectra {defect}, first that of link {first}, {span}")
    return found
