"""Conventions under which data may have been written, and how well each explains the labels."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.query import evenly


@dataclass(frozen=True)
class Sample:
    """Some links, evenly spread, in the form that hypotheses change.

    Attributes:
        index: Numbers of the links among all.
        transmitters: Positions of the links' transmitters [m].
        receivers: Number of each link's receiver.
        positions: Positions of the receivers [m].
        rotations: The receivers' axes in the world frame, as columns.
        elements: Offsets of each receiver's elements along its own axes [m].
        frequencies: Subcarriers of channels [Hz]; empty for other tasks.
        labels: One a link, of the task's shape.
    """

    index: Int[Tensor, " n"]
    transmitters: Float[Tensor, "n 3"]
    receivers: Int[Tensor, " n"]
    positions: Float[Tensor, "r 3"]
    rotations: Float[Tensor, "r 3 3"]
    elements: tuple[Float[Tensor, "_ 3"], ...]
    frequencies: Float[Tensor, " s"]
    labels: Tensor

    @property
    def local(self) -> Float[Tensor, "n 3"]:
        """Transmitters in the frame of their receiver [m]."""
        offsets = self.transmitters - self.positions[self.receivers]  # (n, 3)
        return torch.einsum("nw,nwa->na", offsets, self.rotations[self.receivers])


class Hypothesis(NamedTuple):
    """Another convention: its name, the sample read by it, and what mends the data."""

    name: str
    change: Callable[[Sample], Sample]
    mend: str


class Fit(NamedTuple):
    """The hypothesis that explains the labels best, with its score and that of the data as read."""

    hypothesis: Hypothesis
    read: float
    fits: float


def best_fit(sample: Sample, hypotheses: Sequence[Hypothesis], score: Callable[[Sample], float]) -> Fit:
    """The hypothesis with the highest score; of equal ones the first."""
    scores = [score(hypothesis.change(sample)) for hypothesis in hypotheses]
    number = max(range(len(scores)), key=scores.__getitem__)
    return Fit(hypotheses[number], score(sample), scores[number])


def sample_of(links: Any, most: int) -> Sample:
    """At most ``most`` links, evenly spread over those that are not tested; numbers are float64."""
    known = torch.arange(len(links)) if links.split is None else links.split.known.sort().values
    index = evenly(known, most)
    poses = [receiver.pose for receiver in links.receivers]
    labels = links.labels[index]
    return Sample(
        index=index,
        transmitters=links.query.transmitters[index].double(),
        receivers=links.query.receivers[index],
        positions=torch.stack([pose.position for pose in poses]).double(),
        rotations=torch.stack([pose.rotation for pose in poses]).double(),
        elements=tuple(receiver.array.elements.double() for receiver in links.receivers),
        frequencies=getattr(links.task, "frequencies", torch.zeros(0)).double(),
        labels=labels.to(torch.complex128 if labels.is_complex() else torch.float64),
    )


def unit_changes() -> list[Hypothesis]:
    """Units other than metres, of transmitters alone and of receivers alone: of both, directions are the same."""
    units = {"mm": 1e-3, "cm": 1e-2, "feet": 0.3048, "km": 1e3}
    changes = []
    for ends, change in (("transmitters", _with_transmitters), ("receivers", _with_receivers)):
        for unit, factor in units.items():
            scale = lambda points, factor=factor: factor * points
            mend = f"multiply the {ends}' positions by {factor:g}"
            changes.append(Hypothesis(f"{ends} are in {unit}", change(scale), mend))
    return changes


def axis_changes() -> list[Hypothesis]:
    """Axes that are exchanged or point the other way, of transmitters, receivers or both."""
    maps = {
        "x and y exchanged": ("[:, [1, 0, 2]]", [[0, 1, 0], [1, 0, 0], [0, 0, 1]]),
        "y and z exchanged": ("[:, [0, 2, 1]]", [[1, 0, 0], [0, 0, 1], [0, 1, 0]]),
        "x and z exchanged": ("[:, [2, 1, 0]]", [[0, 0, 1], [0, 1, 0], [1, 0, 0]]),
        "x negated": (" * [-1, 1, 1]", [[-1, 0, 0], [0, 1, 0], [0, 0, 1]]),
        "y negated": (" * [1, -1, 1]", [[1, 0, 0], [0, -1, 0], [0, 0, 1]]),
        "z negated": (" * [1, 1, -1]", [[1, 0, 0], [0, 1, 0], [0, 0, -1]]),
    }
    ends = {
        "transmitters": _with_transmitters,
        "receivers": _with_receivers,
        "transmitters and receivers": lambda move: lambda own: _with_receivers(move)(_with_transmitters(move)(own)),
    }
    changes = []
    for end, change in ends.items():
        for name, (mend, matrix) in maps.items():
            move = lambda points, matrix=matrix: points @ torch.tensor(matrix).to(points)
            changes.append(Hypothesis(f"{end} have {name}", change(move), f"positions{mend}"))
    return changes


def _with_transmitters(move: Callable[[Tensor], Tensor]) -> Callable[[Sample], Sample]:
    return lambda own: replace(own, transmitters=move(own.transmitters))


def _with_receivers(move: Callable[[Tensor], Tensor]) -> Callable[[Sample], Sample]:
    return lambda own: replace(own, positions=move(own.positions))
