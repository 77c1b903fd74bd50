"""Measured and simulated links, each from one transmitter position to one receiver, with their
labels.
"""

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from gaigs.core.antenna import Receiver, lacking
from gaigs.core.geometry import Frame, Pose
from gaigs.core.query import Batch, Query
from gaigs.core.scene import Scene
from gaigs.core.task import Task
from gaigs.core.task.csi import Csi
from gaigs.data.checks import check
from gaigs.data.checks.subcarriers import constant_sentence, constant_subcarriers
from gaigs.data.gateways import estimate_place
from gaigs.data.maps import check_metres
from gaigs.io.images import GreyImages
from gaigs.io.tables import shortened
from gaigs.registry import registry

log = logging.getLogger(__name__)

Parts = tuple[Int[Tensor, " train"], Int[Tensor, " test"]]
"""Training and test links, ascending."""


@dataclass(frozen=True)
class Split:
    """Links to train, validate and test on; ``name`` is the protocol with its numbers.

    ``groups`` has the group of each link of the data, a row, a run or a cube: each is held out
    whole. None: places are.
    """

    name: str
    train: Int[Tensor, " train"]
    validation: Int[Tensor, " validation"]
    test: Int[Tensor, " test"]
    groups: Int[Tensor, " n"] | None = None

    def parts(self) -> dict[str, Int[Tensor, " k"]]:
        """The three parts by name."""
        return {"train": self.train, "validation": self.validation, "test": self.test}

    @property
    def known(self) -> Int[Tensor, " k"]:
        """Training and validation links, in this order."""
        return torch.cat((self.train, self.validation))

    def validating(self) -> "Split":
        """The split whose test are the validation links, for models that have not seen them."""
        return replace(self, validation=self.validation[:0], test=self.validation)

    def only(self, train: Int[Tensor, " k"]) -> "Split":
        """The split with some training links, and nothing to validate."""
        return replace(self, train=train, validation=self.validation[:0])

    def choosing(self, validation: Int[Tensor, " v"]) -> "Split":
        """The split with other validation links, such as some of its own."""
        return replace(self, validation=validation)


@dataclass(frozen=True, repr=False)
class Links:
    """A data set: n links, each from one transmitter position to one receiver.

    Attributes:
        query: Transmitter positions (float32), receivers and frequencies.
        receivers: Receivers that the query points to.
        labels: Tensor, or object that reads labels from files; an index (k,) gives labels (k,
            *task.shape).
        task: Task of the labels.
        rows: Row of each link in the order of measurement, from 0 (n,). Links of one transmission
            to several receivers, or at several frequencies, share a row. None: each link has its
            own.
        official: Reads the training and test links that came with the data, for the official split
            only; or None.
        split: Train, validation and test links; None until a split is chosen, see ``load``.
        bandwidth: Band around each carrier that a label's power is averaged over, 0 for a carrier
            alone [Hz]; None if unknown.
        held_out: The same links at subcarriers that are held out, with the labels of the test; None
            if there are none.
        frame: Place of the world frame on a map; None if unknown.
        uncertainties: Standard deviation of each receiver's place (r,) [m]: 0 if given, infinite
            until ``divide`` estimates it from the training links. None: all are given, and
            receivers without training links stay.
        noises: Standard deviation of each label by the scatter of repeated readings, less the more
            of them it is the mean of (n,), in the label's unit; None without repetitions.
        edges: Line segments of the room to draw in figures (k, 2, 3) [m]; empty if unknown.
        remarks: Counts of links read and left out, with the reason.
        origin: Configurations of ``data`` and ``split``; empty for arrays in memory.

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
    labels: Tensor | GreyImages
    task: Task
    rows: Int[Tensor, " n"] | None = None
    official: Callable[[], Parts] | None = None
    split: Split | None = None
    bandwidth: float | None = None
    held_out: "Links | None" = None
    frame: Frame | None = None
    uncertainties: Float[Tensor, " r"] | None = None
    noises: Float[Tensor, " n"] | None = None
    edges: Float[Tensor, "k 2 3"] = field(
        default_factory=lambda: torch.zeros(0, 2, 3, dtype=torch.float32)
    )
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

    def batch(self, index: Int[Tensor, " b"]) -> Batch:
        """Links as a batch with labels, in all directions of the task."""
        # Rows of a tensor are copied five times as fast by index_select as by brackets.
        labels = (
            self.labels.index_select(0, index)
            if isinstance(self.labels, Tensor)
            else self.labels[index]
        )
        return Batch(self.query[index], self.task.directions, labels)

    def known(self, receiver: int) -> Int[Tensor, " k"]:
        """Training and validation links to a receiver; look-ups use them all."""
        index = self.split.known
        return index[self.query.receivers[index] == receiver]

    @property
    def scene(self) -> Scene:
        """The scene that a model is built from; a ``ValueError`` if all training transmitters stand
        at one point.
        """
        training = self.query[self.split.train]
        train = training.transmitters.unique(dim=0)
        if len(train) < 2:
            raise ValueError(
                f"training takes transmitters at two points or more, got {len(train)}; check the split"
            )
        frequencies = (
            torch.zeros(0) if training.frequencies is None else training.frequencies.unique()
        )
        box = train.amin(0), train.amax(0), median_spacing(train)
        return Scene(
            self.receivers,
            *box,
            self.task,
            frequencies,
            self.bandwidth,
            self.frame,
            floors_of(train),
        )


def median_spacing(places: Float[Tensor, "n 3"]) -> float:
    """Median distance from a place to the nearest other one [m]; takes two places or more."""
    distances, _ = cKDTree(places.double().numpy()).query(places.double().numpy(), k=2)
    return float(np.median(distances[:, 1]))


def floors_of(places: Float[Tensor, "n 3"]) -> Float[Tensor, " k"]:
    """Heights of separate floors [m], that with most places first; empty of one floor.

    A floor has 5 places or more. None lies in the 2 m between two floors, nor in twice the range of
    a floor's heights.
    """
    heights = places[:, 2].sort().values
    gaps = heights.diff()
    ends = (gaps > 2).nonzero()[:, 0]
    floors = heights.tensor_split(ends + 1)
    if (
        not len(ends)
        or min(map(len, floors)) < 5
        or gaps[ends].min() < 2 * max(floor[-1] - floor[0] for floor in floors)
    ):
        return heights[:0]
    return torch.stack([floor.median() for floor in sorted(floors, key=len, reverse=True)])


def load(data: Mapping, split: Mapping, task: str | None = None, is_checked: bool = True) -> Links:
    """A data set with its split, by the configurations of both; ``task`` names the expected task,
    None for any. ``is_checked`` is as for ``divide``.

    Raises:
        FileNotFoundError: The data are missing.
        ValueError: A file, an option or the split has a defect, or the labels are of another task.
    """
    links = registry("data").build(data)
    if task not in (None, links.task.name):
        found = f"the labels of data {data['name']!r} are of task {links.task.name!r}"
        raise ValueError(
            f"{found}, and the configuration is for {task!r}; add task={links.task.name}"
        )
    origin = {"data": dict(data), "split": dict(split)}
    return replace(divide(links, split, is_checked), origin=origin)


def divide(links: Links, split: Mapping, is_checked: bool = True) -> Links:
    """Links with their split, by its configuration; remarks say what is doubtful, such as the phase
    of channels, and with ``is_checked`` what ``data.checks`` finds.

    Of links with ``uncertainties``, receivers without a training link are left out, and those
    without a place get an estimate of it from the training links.

    Raises:
        ValueError: An option of the split has a defect, two of its parts share a link, or all
            spectra are constant.
    """
    if isinstance(links.task, Csi) and isinstance(links.labels, Tensor):
        check_elements(links)
        links = without_constant(links)
    parts = registry("split").build(split, links=links)
    given = [*parts.parts().values()]
    numbers, is_whole = torch.cat(given), all(part.dtype == torch.long for part in given)
    if (
        not is_whole
        or not ((numbers >= 0) & (numbers < len(links))).all()
        or len(numbers.unique()) < len(numbers)
    ):
        raise ValueError(
            f"split {parts.name!r} must give int64 numbers of links, no masks, and none in two parts"
        )
    if links.held_out is not None:
        tasks: Any = links.task, links.held_out.task
        bands = [task.frequencies / 1e9 for task in tasks]
        at = [f"at {band.min():.7g} .. {band.max():.7g} GHz" for band in bands]
        parts = replace(parts, name=f"{parts.name}, trained {at[0]}, tested {at[1]}")
    links = replace(links, split=parts)
    if links.frame is None:
        check_metres("transmitters", links.query.transmitters.unique(dim=0).double().numpy())
    if links.uncertainties is not None:
        links = with_places(only_trained(links))
    remarks, phase = [links.remarks], getattr(links.task, "phase", "known")
    if phase != "known":
        unknown = {"per_link": "phase", "per_link_and_delay": "phase, delay and gain"}[phase]
        remarks.append(f"{unknown} of each link unknown, and removed in every score")
    for finding in check(links) if is_checked else ():
        log.warning("%s", finding)
        remarks.append(str(finding))
    return replace(links, remarks="; ".join(filter(None, remarks)))


def check_elements(links: Links) -> None:
    """A ``ValueError`` unless channels have the elements of their receivers' arrays, and are 0 at
    all others.
    """
    count, sizes = links.task.shape[0], [len(receiver.array) for receiver in links.receivers]
    if max(sizes) != count:
        raise ValueError(
            f"the task has {count} elements, and the largest array of the receivers {max(sizes)}; "
            "give Csi the number of elements of the largest one"
        )
    for part in torch.arange(len(links) if min(sizes) < count else 0).split(1024):
        own = links.query.receivers[part]
        if (
            beyond := (links.labels[part] != 0).any(2) & lacking(links.receivers, own, count)
        ).any():
            link, element = beyond.nonzero()[0].tolist()
            raise ValueError(
                f"labels must be 0 at elements that an array lacks; that of link {int(part[link])} is not at element "
                f"{element}, and {links.receivers[int(own[link])].name} has {sizes[int(own[link])]} elements"
            )


def without_constant(links: Links) -> Links:
    """Channels without the subcarriers, and then the links, that have no channel; remarks and a
    warning count them.

    The same holds for the subcarriers that are held out. If all subcarriers of the links are so,
    they stay.

    Raises:
        ValueError: All subcarriers that are held out are so.
    """
    both, remarks = [], [links.remarks]
    for part in filter(None, (links, links.held_out)):
        constant = constant_subcarriers(part)
        if constant.all() and part is not links:
            raise ValueError(
                "all subcarriers to test on have one value in every link; choose another data.band_test"
            )
        if constant.any() and not constant.all():
            task: Any = part.task
            remarks.append(constant_sentence(constant, task.frequencies).format("and are left out"))
            log.warning("%s", remarks[-1])
            task = Csi(task.elements, task.frequencies[~constant], task.phase)
            part = replace(part, labels=part.labels[..., ~constant], task=task)
        both.append(part)
    if len(remarks) == 1:
        return links
    heard = torch.stack([part.labels.abs().amax((1, 2)) > 0 for part in both]).all(0)
    if silent := int((~heard).sum()):
        remarks.append(f"{silent} links with no other subcarrier are left out")
        both = [kept_links(part, heard) for part in both]
    return replace(
        both[0],
        held_out=both[1] if len(both) > 1 else None,
        remarks="; ".join(filter(None, remarks)),
    )


def kept_links(links: Links, kept: Bool[Tensor, " n"]) -> Links:
    """Some of the links, before a split; receivers stay."""
    number = kept.cumsum(0) - 1
    given = links.official
    official = (
        None if given is None else lambda: tuple(number[part[kept[part]]] for part in given())
    )
    return replace(
        links,
        query=links.query[kept],
        labels=links.labels[kept],
        rows=None if links.rows is None else links.rows[kept],
        noises=None if links.noises is None else links.noises[kept],
        official=official,
    )


def only_trained(links: Links) -> Links:
    """Links to receivers that have training links: nothing is known of others. A remark names
    these.
    """
    trained = links.query.receivers[links.split.train].unique()
    if len(trained) == len(links.receivers):
        return links
    number = torch.full((len(links.receivers),), -1).index_copy(
        0, trained, torch.arange(len(trained))
    )
    kept = (number[links.query.receivers] >= 0).nonzero()[:, 0]
    some = lambda values: None if values is None else values[kept]
    parts = {
        name: torch.isin(kept, part).nonzero()[:, 0] for name, part in links.split.parts().items()
    }
    if len(links.split.test) and not len(parts["test"]) and len(links) < 1.5 * len(links.receivers):
        each = f"{len(links.receivers)} receivers have {len(links)} links"
        raise ValueError(
            f"{each}, and those with test links none to train on: models are learnt for each receiver\n"
            "give a fixed receiver one place for all its links, and the moving end as transmitters"
        )
    names = [
        receiver.name for receiver, new in zip(links.receivers, number, strict=True) if new < 0
    ]
    remark = f"receivers without a training link are left out, with {len(links) - len(kept)} links: {shortened(names)}"
    return replace(
        links,
        query=replace(links.query[kept], receivers=number[links.query.receivers[kept]]),
        receivers=tuple(links.receivers[old] for old in trained.tolist()),
        labels=links.labels[kept],
        rows=some(links.rows),
        official=None,
        split=Split(links.split.name, **parts, groups=some(links.split.groups)),
        uncertainties=links.uncertainties[trained],
        noises=some(links.noises),
        remarks="; ".join(filter(None, (links.remarks, remark))),
    )


def with_places(links: Links) -> Links:
    """Links whose receivers without a place have an estimate from the training links; remarks say
    how certain it is.
    """
    if links.uncertainties.isfinite().all():
        return links
    receivers, deviations, named = [*links.receivers], links.uncertainties.clone(), []
    train = links.split.train
    for number in (~deviations.isfinite()).nonzero()[:, 0].tolist():
        own, receiver = train[links.query.receivers[train] == number], receivers[number]
        place, deviation = estimate_place(links.query.transmitters[own], links.labels[own])
        receivers[number] = replace(receiver, pose=Pose(place, torch.eye(3)))
        deviations[number] = deviation
        named.append(f"{receiver.name} {deviation:.2g}")
    remark = (
        f"places of {len(named)} receivers are estimated from the training links, with a median standard deviation of "
        f"{deviations[deviations > 0].median().item():.2g} m: {shortened(named)}"
    )
    return replace(
        links,
        receivers=tuple(receivers),
        uncertainties=deviations,
        remarks="; ".join(filter(None, (links.remarks, remark))),
    )
