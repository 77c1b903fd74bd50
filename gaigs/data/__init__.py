"""Measured and simulated links: who sent from where, who heard, and the label."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from gaigs.query import Batch, Query
from gaigs.registry import registry
from gaigs.scene import Receiver, Scene
from gaigs.task import Task

Parts = tuple[Int[Tensor, "train"], Int[Tensor, "test"]]
"""Training and test links, ascending."""


@dataclass(frozen=True)
class Split:
    """Which links train, validate and test; ``name`` says by which protocol, with its numbers."""

    name: str
    train: Int[Tensor, "train"]
    validation: Int[Tensor, "validation"]
    test: Int[Tensor, "test"]

    def parts(self) -> dict[str, Int[Tensor, "k"]]:
        """The three by name."""
        return {"train": self.train, "validation": self.validation, "test": self.test}


@dataclass(frozen=True)
class Links:
    """A data set: n links, each from one transmitter position to one receiver.

    Attributes:
        query: Who sent from where, who heard, at which frequency; positions in float32.
        receivers: Who hears.
        labels: Indexed by an integer tensor (k,) it gives labels (k, *task.shape) of the task's dtype. A tensor, or
            anything that reads its labels when asked.
        task: What the labels are.
        rows: Row of each link in the order of measurement, from 0 (n,): the links by which several receivers heard
            one transmission, or one receiver at several frequencies, have the same. Each has its own where None.
        official: Gives the training and test links that came with the data; None where none came. It may read files,
            and is called for the official split alone.
        split: Train, validation and test links; None until a split is chosen, see ``load``.
        bandwidth: Of the band around each carrier that a label's power is averaged over, 0 for a carrier alone [Hz];
            None where it is unknown.
        edges: Line segments of the room to draw in figures (k, 2, 3) [m]; empty where unknown.
        remarks: What was read, and what was left out and why, in a sentence.
    """

    query: Query
    receivers: tuple[Receiver, ...]
    labels: Tensor
    task: Task
    rows: Int[Tensor, "n"] | None = None
    official: Callable[[], Parts] | None = None
    split: Split | None = None
    bandwidth: float | None = None
    edges: Float[Tensor, "k 2 3"] = field(default_factory=lambda: torch.zeros(0, 2, 3))
    remarks: str = ""

    def __len__(self) -> int:
        return len(self.query)

    def batch(self, index: Int[Tensor, "b"]) -> Batch:
        """Links as a batch with labels, in all directions that these have."""
        return Batch(self.query[index], self.task.directions, self.labels[index])

    def known(self, receiver: int) -> Int[Tensor, "k"]:
        """The links to a receiver that are not held out for the test; look-ups use them all."""
        index = torch.cat((self.split.train, self.split.validation))
        return index[self.query.receivers[index] == receiver]

    @property
    def scene(self) -> Scene:
        """What a model is built from.

        Raises:
            ValueError: All training transmitters stand at one point.
        """
        training = self.query[self.split.train]
        train = training.transmitters.unique(dim=0)
        if len(train) < 2:
            raise ValueError(f"training takes transmitters at two points or more, got {len(train)}; check the split")
        frequencies = torch.zeros(0) if training.frequencies is None else training.frequencies.unique()
        box = train.amin(0), train.amax(0), median_spacing(train)
        return Scene(self.receivers, *box, self.task, frequencies, self.bandwidth)


def median_spacing(places: Float[Tensor, "n 3"]) -> float:
    """Median distance from a place to the nearest other one [m]; of two or more different places."""
    distances, _ = cKDTree(places.double().numpy()).query(places.double().numpy(), k=2)
    return float(np.median(distances[:, 1]))


def load(data: Mapping, split: Mapping, task: str | None = None) -> Links:
    """A data set with its split.

    Args:
        data: Configuration of a registered data set.
        split: Configuration of a registered split.
        task: Name of the task that the rest of the configuration is for; None for whatever the labels are.

    Raises:
        FileNotFoundError: Data that are not there.
        ValueError: Something is wrong with the files, the options or the split, or the labels are of another task.
    """
    links = registry("data").build(data)
    if task not in (None, links.task.name):
        raise ValueError(
            f"the labels of data {data['name']!r} are of task {links.task.name!r}, and the configuration is for "
            f"{task!r}; add task={links.task.name}"
        )
    return replace(links, split=registry("split").build(split, links=links))
