"""Measured and simulated links: who sent from where, who heard, and the label."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from gaigs.geometry import Pose
from gaigs.io.tables import number_places
from gaigs.query import Batch, Query, as_numbers, as_positions, check_carrier
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


@dataclass(frozen=True, repr=False)
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
        origin: Configurations of ``data`` and ``split`` that it was made by; empty for arrays in memory.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=50)
        >>> links
        <200 links of task 'rssi' to 4 receivers; split official, validation 0.1, seed 0: ...>
        >>> batch = links.batch(links.split.test[:8])
        >>> batch.query.transmitters.shape, batch.labels.shape
        (torch.Size([8, 3]), torch.Size([8]))
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
    origin: Mapping = field(default_factory=dict)

    def __repr__(self) -> str:
        parts = "no split"
        if self.split is not None:
            counts = ", ".join(f"{len(part)} {name}" for name, part in self.split.parts().items())
            parts = f"split {self.split.name}: {counts}"
        count = len(self.receivers)
        return f"<{len(self)} links of task {self.task.name!r} to {count} receiver{'s' * (count != 1)}; {parts}>"

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
    origin = {"data": dict(data), "split": dict(split)}
    return replace(links, split=registry("split").build(split, links=links), origin=origin)


def links(reader: str | None = None, /, **options) -> Links:
    """Links of a registered reader, or of arrays in memory, with their split.

    Args:
        reader: Name of a data set's reader, e.g. ``"synthetic"``, ``"nerf2_spectrum"``, ``"rssi_csv"``; None where
            arrays are given.
        options: ``split``, the name of a registered split, by default the one that suits the reader, and of arrays
            ``"random"``; and the options of reader and split by their names. Of arrays those of ``from_arrays``:
            ``task``, ``transmitters`` (n, 3) [m], ``receivers``, ``labels``.

    Raises:
        FileNotFoundError: The reader finds no data there.
        TypeError: An option is of another type than it must be.
        ValueError: A name is unknown, or the files, arrays or the split do not fit.

    Example:
        >>> gaigs.links("synthetic_rssi", transmitters=50, split="blocks", edge=2.0).split.name
        'blocks 2 m, test 0.2, validation 0.1, seed 0'
        >>> places = [[1.0, 1.0, 1.0], [2.0, 1.0, 1.0], [1.0, 2.0, 1.0], [2.0, 2.0, 1.0]]
        >>> readings = [[-40.0, -52.0], [-45.0, float("nan")], [-50.0, -41.0], [-55.0, -44.0]]  # [dBm], nan: not heard
        >>> len(gaigs.links(task="rssi", transmitters=places, receivers=[[0, 0, 2], [3, 3, 2]], labels=readings))
        7
    """
    from gaigs import configuration  # which needs Hydra, as a checkpoint does not

    if reader is None:
        needed = ("task", "transmitters", "receivers", "labels")
        if missing := [key for key in needed if key not in options]:
            raise ValueError(
                f"links takes the name of a reader first, or arrays: {', '.join(needed)}; {', '.join(missing)} must be "
                "given"
            )
        return from_arrays(**options)
    config = configuration.composed([f"data={reader}"], options, ("data", "split"))
    return load(config["data"], config["split"])


def from_arrays(
    task: str | Task,
    transmitters: Float[Tensor, "n 3"],
    receivers: Receiver | Sequence[Receiver] | Float[Tensor, "k 3"],
    labels: Tensor,
    index: Int[Tensor, "n"] | None = None,
    frequency: float | Float[Tensor, "n"] | None = None,
    split: str | Mapping = "random",
    **options,
) -> Links:
    """Links of arrays in memory, with their split; anything that becomes a tensor is an array.

    Args:
        task: What the labels are: ``"rssi"`` (scalars [dBm]), or a task with its axes, e.g.
            ``gaigs.task.spectrum.Spectrum(elevations, azimuths, "")`` or ``gaigs.task.csi.Csi(elements, frequencies)``.
        transmitters: Positions, world frame (n, 3) [m].
        receivers: ``Receiver`` objects, or positions (3,) or (k, 3) [m] of single antennas that look along the axes.
        labels: One a link, (n, ...) of the task's shape; or one for each transmitter and receiver, (n, k, ...). A
            reading that is NaN and a channel of zeros was not heard, and is left out.
        index: The receiver of each link (n,), from 0. Where it is missing there is one receiver; or n positions, each
            of one link; or labels are (n, k, ...).
        frequency: Carrier, one or one a link [Hz]; None is unknown, of channels the middle of the subcarriers.
        split: Name of a registered split.
        options: Of the split.

    Raises:
        TypeError: An option is of another type than it must be.
        ValueError: Shapes do not fit, a number is not finite or out of range, or there is nothing to split.
    """
    from gaigs import configuration

    config = configuration.composed([], {"split": split, **options}, ("split",))["split"]
    task = registry("task").build(task)
    places = as_positions("transmitters", transmitters).detach()
    if places.ndim != 2 or not len(places):
        raise ValueError(f"transmitters must be (n, 3) positions [m], got shape {tuple(places.shape)}")
    if isinstance(receivers, Receiver):
        receivers = [receivers]
    if not (isinstance(receivers, Sequence) and all(isinstance(each, Receiver) for each in receivers)):
        stands = as_positions("receivers", receivers).reshape(-1, 3)
        if index is None and len(stands) == len(places) > 1 and np.ndim(labels) == 1 + len(task.shape):
            stands, index = stands.unique(dim=0, return_inverse=True)
        receivers = [Receiver(f"rx{k}", Pose(place, torch.eye(3))) for k, place in enumerate(stands)]
    if np.ma.is_masked(labels):
        raise ValueError("labels must be plain numbers, got a masked array; fill it with nan, which was not heard")
    if task.dtype.is_complex:
        labels = torch.as_tensor(labels).detach().to(task.dtype)
    else:
        labels = as_numbers("labels", labels, f"labels of task {task.name!r}").detach().to(task.dtype)
    count, most, shape = len(places), len(receivers), tuple(task.shape)
    rows = torch.arange(count)
    if tuple(labels.shape) == (count, most, *shape) and index is None:
        rows, index = rows.repeat_interleave(most), torch.arange(most).repeat(count)
        labels = labels.flatten(0, 1)
    elif tuple(labels.shape) == (count, *shape) and (index is not None or most == 1):
        index = torch.zeros(count, dtype=torch.long) if index is None else torch.as_tensor(index)
    else:
        raise ValueError(
            f"labels of task {task.name!r} must be {(count, *shape)} with the receiver of each link in index, or "
            f"{(count, most, *shape)}, one for each transmitter and receiver, got {tuple(labels.shape)}"
        )
    is_whole = not (index.is_floating_point() or index.is_complex() or index.dtype == torch.bool)
    if not is_whole or index.shape != (len(rows),) or not ((index >= 0) & (index < most)).all():
        raise ValueError(f"index must be {count} whole numbers from 0 to {most - 1}, got {index.tolist()[:5]} ...")
    flat = labels.reshape(len(rows), -1)
    heard = (flat != 0).any(1) if task.dtype.is_complex else ~flat.isnan().all(1)
    if not heard.any() or not flat[heard].isfinite().all():
        raise ValueError("labels must be finite where something was heard, and something must have been")
    carriers = None
    if frequency is None and hasattr(task, "frequencies"):
        frequency = (task.frequencies.min() + task.frequencies.max()).item() / 2
    if frequency is not None:
        carriers = as_numbers("frequency", frequency, "a carrier in Hz")
        if carriers.ndim and carriers.shape != (count,):
            raise ValueError(f"frequency must be one number, or {count}, one for each transmitter, got {len(carriers)}")
        carriers = carriers.expand(count)[rows]
        for carrier in carriers.unique().tolist():
            check_carrier("frequency", carrier)
    made = Links(
        query=Query(places[rows][heard], index[heard].long(), None if carriers is None else carriers[heard]),
        receivers=tuple(receivers),
        labels=labels[heard],
        task=task,
        rows=number_places(places.tolist())[1][rows][heard],
        remarks=f"{int((~heard).sum())} links were not heard and are left out" if not heard.all() else "",
    )
    return replace(made, split=registry("split").build(config, links=made))


def check_fit(links: Links, scene: Scene | None = None) -> None:
    """Sees to it that links have a split, and are of the receivers and the task that a model was made for.

    Raises:
        ValueError: They have no split, other receivers, or labels of another task or with other axes.
    """
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
            f"links must have the model's receivers in the same order, at the same places: {names[0]}; got {names[1]}"
        )


def are_alike(a: object, b: object) -> bool:
    """Whether nested values are the same, tensors to 1e-5."""
    if isinstance(a, Tensor):
        return (
            isinstance(b, Tensor)
            and a.shape == b.shape
            and torch.allclose(a.double(), b.double(), rtol=1e-6, atol=1e-5)
        )
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(are_alike(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(are_alike, a, b))
    return a == b
