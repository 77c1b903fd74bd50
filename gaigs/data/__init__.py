"""Measured and simulated links, from a transmitter's position to a receiver, with labels."""

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
from gaigs.data.front_ends import FrontEnds, learn_responses
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
    """Indices of the links for training, validation and test.

    ``name`` states the kind of split with its parameters. ``groups`` has the group of each of the n
    links, such as its row, run or cube. A group is never divided, even in cross-validation. None: a
    group is a place. ``by_receivers`` is true if whole receivers are held out.
    """

    name: str
    train: Int[Tensor, " train"]
    validation: Int[Tensor, " validation"]
    test: Int[Tensor, " test"]
    groups: Int[Tensor, " n"] | None = None
    by_receivers: bool = False

    def parts(self) -> dict[str, Int[Tensor, " k"]]:
        """The three parts by name."""
        return {"train": self.train, "validation": self.validation, "test": self.test}

    @property
    def known(self) -> Int[Tensor, " k"]:
        """Training and validation links, in this order."""
        return torch.cat((self.train, self.validation))

    def validating(self) -> "Split":
        """The split that tests on the validation links, for models trained without them."""
        return replace(self, validation=self.validation[:0], test=self.validation)

    def only(self, train: Int[Tensor, " k"]) -> "Split":
        """The split with these training links, without validation links."""
        return replace(self, train=train, validation=self.validation[:0])

    def choosing(self, validation: Int[Tensor, " v"]) -> "Split":
        """The split with these validation links."""
        return replace(self, validation=validation)


@dataclass(frozen=True, repr=False)
class Links:
    """A data set: n links, each from one transmitter position to one receiver.

    Attributes:
        query: Transmitter positions (float32), receivers and frequencies.
        receivers: The scene's receivers; ``query.receivers`` holds their numbers.
        labels: Tensor, or object that reads labels from files. An index (k,) gives labels (k,
            *task.shape).
        task: Task of the labels.
        rows: Row of each link in the order of measurement, from 0 (n,). Links of one transmission
            to several receivers, or at several frequencies, share a row. None: each link is a row.
        official: Function that reads the training and test links that came with the data, for the
            official split; or None.
        split: Train, validation and test links; None until a split is chosen, see ``load``.
        bandwidth: Band around each carrier over which a label's power is averaged [Hz]. 0: a single
            carrier; None: unknown.
        held_out: The same links at held-out subcarriers, whose labels are the test; None if no
            subcarriers are held out.
        frame: Place of the world frame on a map; None if unknown.
        uncertainties: Standard deviation of each receiver's place (r,) [m]: 0 for a given place,
            infinite until ``divide`` estimates the place from the training links. None: all places
            are given, and receivers without training links stay.
        noises: Standard deviation of each label (n,), in its unit, from the scatter of repeated
            readings. The deviation of a mean of several readings is lower. None without
            repetitions.
        edges: Line segments of the room to draw in figures (k, 2, 3) [m]; empty if unknown.
        one_radio: True if the receivers are places of one moving radio, or identical radios, so
            that all have the same gain. Otherwise each receiver has a separate gain.
        front_ends: Responses of the receivers' front ends; None if none is learnt.
        remarks: Counts of links that were read and excluded, with the reason.
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
    front_ends: FrontEnds | None = None
    one_radio: bool = False
    remarks: str = ""
    origin: Mapping = field(default_factory=dict)

    def __repr__(self) -> str:
        parts = "no split"
        if self.split is not None:
            counts = ", ".join(f"{len(part)} {name}" for name, part in self.split.parts().items())
            parts = f"split {self.split.name}: {counts}"
        count = len(self.receivers)
        return (
            f"<{len(self)} links of task {self.task.name!r} to {count} "
            f"receiver{'s' * (count != 1)}; {parts}>"
        )

    def __len__(self) -> int:
        return len(self.query)

    def batch(self, index: Int[Tensor, " b"]) -> Batch:
        """Links as a batch with labels, in all directions of the task."""
        # Rows of a tensor are copied five times as fast by index_select as by brackets.
        if isinstance(self.labels, Tensor):
            labels = self.labels.index_select(0, index)
        else:
            labels = self.labels[index]
        return Batch(self.query[index], self.task.directions, labels)

    def known(self, receiver: int) -> Int[Tensor, " k"]:
        """Training and validation links to a receiver, the links that look-ups use."""
        index = self.split.known
        return index[self.query.receivers[index] == receiver]

    @property
    def scene(self) -> Scene:
        """The scene from which a model is built.

        Raises:
            ValueError: All training transmitters are at one point.
        """
        training = self.query[self.split.train]
        # A place may have several links. Integer keys drop most of them ten times faster than a
        # comparison of coordinates.
        _, first = np.unique(training.place_keys, return_index=True)
        train = training.transmitters[first].unique(dim=0)
        if len(train) < 2:
            raise ValueError(
                f"training takes transmitters at two points or more, got {len(train)}; check the "
                "split"
            )
        frequencies = torch.zeros(0)
        if training.frequencies is not None:
            frequencies = training.frequencies.unique()
        return Scene(
            receivers=self.receivers,
            lower=train.amin(0),
            upper=train.amax(0),
            spacing=median_spacing(train),
            task=self.task,
            frequencies=frequencies,
            bandwidth=self.bandwidth,
            frame=self.frame,
            responses=None if self.front_ends is None else self.front_ends.responses,
            floors=floors_of(train),
            places=len(train),
            one_radio=self.one_radio,
        )


def median_spacing(places: Float[Tensor, "n 3"]) -> float:
    """Median distance from a place to its nearest neighbour [m]; needs two places or more."""
    points = places.double().numpy()
    distances, _ = cKDTree(points).query(points, k=2)
    return float(np.median(distances[:, 1]))


def floors_of(places: Float[Tensor, "n 3"]) -> Float[Tensor, " k"]:
    """Heights of separate floors [m], the floor with most places first; empty for a single floor.

    A floor has 5 places or more. The gap between two floors is more than 2 m, and at least twice
    the range of heights on any floor.
    """
    heights = places[:, 2].sort().values
    gaps = heights.diff()
    ends = (gaps > 2).nonzero()[:, 0]
    floors = heights.tensor_split(ends + 1)
    if not len(ends) or min(map(len, floors)) < 5:
        return heights[:0]
    if gaps[ends].min() < 2 * max(floor[-1] - floor[0] for floor in floors):
        return heights[:0]
    return torch.stack([floor.median() for floor in sorted(floors, key=len, reverse=True)])


def load(data: Mapping, split: Mapping, task: str | None = None, is_checked: bool = True) -> Links:
    """A data set with its split, from the configurations of both.

    ``task`` names the expected task; None for any. ``is_checked`` is as for ``divide``.

    Raises:
        FileNotFoundError: The data are missing.
        ValueError: A file, an option or the split has a defect, or the labels are of another task.
    """
    links = registry("data").build(data)
    if task not in (None, links.task.name):
        from gaigs.configuration import files_of  # with Hydra, which loading a model does without

        # A plug-in's own task has no file of choices.
        option = "task" if files_of("task", links.task.name) else "task.name"
        raise ValueError(
            f"the labels of data {data['name']!r} are of task {links.task.name!r}, and the "
            f"configuration is for {task!r}; add {option}={links.task.name}"
        )
    origin = {"data": dict(data), "split": dict(split)}
    return replace(divide(links, split, is_checked), origin=origin)


def divide(links: Links, split: Mapping, is_checked: bool = True) -> Links:
    """Links with a split, and with all preparations that follow from it.

    Responses of front ends are learnt for channels, and constant subcarriers are removed. In links
    with ``uncertainties`` receivers without a training link are removed, and unknown places of
    receivers are estimated from the training links. The remarks state each change.

    Args:
        split: Configuration of the split.
        is_checked: True to look for faults, such as random phases, with ``data.checks``, for the
            remarks.
    """
    if links.task.is_channel and isinstance(links.labels, Tensor):
        check_elements(links)
        links = without_constant(links)
    division: Split = registry("split").build(split, links=links)
    _check_split(division, len(links))
    if links.held_out is not None:
        for verb, task in (("trained", links.task), ("tested", links.held_out.task)):
            band = task.frequencies / 1e9
            name = f"{division.name}, {verb} at {band.min():.7g} .. {band.max():.7g} GHz"
            division = replace(division, name=name)
    links = replace(links, split=division)
    if links.frame is None:
        check_metres("transmitters", links.query.transmitters.unique(dim=0).double().numpy())
    if links.uncertainties is not None and not links.one_radio:
        links = with_places(only_trained(links))
    remarks = [links.remarks]
    if links.task.name == "csi" and isinstance(links.labels, Tensor):
        links = replace(links, front_ends=learn_responses(links))
    if links.front_ends is not None:
        log.info("%s", links.front_ends.remark)
        remarks.append(links.front_ends.remark)
    phase = links.task.phase
    if phase != "known":
        unknown = {"per_link": "phase", "per_link_and_delay": "phase, delay and gain"}[phase]
        remarks.append(f"{unknown} of each link unknown, and removed in every score")
    for finding in check(links) if is_checked else ():
        log.warning("%s", finding)
        remarks.append(str(finding))
    return replace(links, remarks="; ".join(filter(None, remarks)))


def _check_split(split: Split, count: int) -> None:
    """Raises a ``ValueError`` unless the parts are disjoint lists of links."""
    given = [*split.parts().values()]
    if not all(part.dtype == torch.long for part in given):
        raise ValueError(
            f"the parts of split {split.name!r} must be int64 numbers of links; turn a mask into "
            "mask.nonzero()[:, 0]"
        )
    numbers = torch.cat(given)
    if not ((numbers >= 0) & (numbers < count)).all():
        raise ValueError(
            f"the parts of split {split.name!r} must hold numbers from 0 to {count - 1}, got "
            f"{int(numbers.min())} to {int(numbers.max())}"
        )
    if len(numbers.unique()) < len(numbers):
        raise ValueError(
            f"the parts of split {split.name!r} share a link; give each link to one part, once"
        )


def check_elements(links: Links) -> None:
    """Raises a ``ValueError`` if channels do not have the elements of their receivers' arrays.

    Channels must be 0 at missing elements of an array, and outside a receiver's band.
    """
    count = links.task.shape[0]
    sizes = [len(receiver.array) for receiver in links.receivers]
    if max(sizes) != count:
        raise ValueError(
            f"the task has {count} elements, and the largest array of the receivers {max(sizes)}; "
            "give Csi the number of elements of the largest one"
        )
    everyone = torch.arange(len(sizes))
    absent = lacking(links.receivers, everyone, count, links.task.frequencies)  # (r, e, s)
    checked = len(links) if absent.any() else 0
    for part in torch.arange(checked).split(1024):  # as many as fit into memory
        receivers = links.query.receivers[part]
        beyond = (links.labels[part] != 0) & absent[receivers.long()]  # (1024, e, s)
        if beyond.any():
            link, element, subcarrier = beyond.nonzero()[0].tolist()
            receiver = int(receivers[link])
            raise ValueError(
                "labels must be 0 at elements that an array lacks and outside a receiver's band; "
                f"that of link {int(part[link])} is not at element {element} and subcarrier "
                f"{subcarrier}, and {links.receivers[receiver].name} has {sizes[receiver]} elements"
            )


def without_constant(links: Links) -> Links:
    """Channels without constant subcarriers, which are guards or nulls; remarks count them.

    Links at held-out subcarriers lose their constant subcarriers, too. Links that are 0 at all
    other subcarriers are removed. If all subcarriers are constant, the links are unchanged.
    """
    both = []  # the links, and the same links at held-out subcarriers
    remarks = [links.remarks]
    for part in filter(None, (links, links.held_out)):
        constant = constant_subcarriers(part)
        if constant.all() and part is not links:
            raise ValueError(
                "all subcarriers to test on have one value in every link; choose another "
                "data.band_test"
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
    received = torch.stack([part.labels.abs().amax((1, 2)) > 0 for part in both]).all(0)
    silent = int((~received).sum())
    if silent:
        remarks.append(f"{silent} links with no other subcarrier are left out")
        both = [kept_links(part, received) for part in both]
    return replace(
        both[0],
        held_out=both[1] if len(both) > 1 else None,
        remarks="; ".join(filter(None, remarks)),
    )


def kept_links(links: Links, kept: Bool[Tensor, " n"]) -> Links:
    """The links where ``kept`` is true, renumbered; for links without a split. Receivers stay."""
    number = kept.cumsum(0) - 1  # new number of each kept link
    read_parts: Any = links.official

    def official() -> Parts:
        train, test = read_parts()
        return number[train[kept[train]]], number[test[kept[test]]]

    return replace(
        links,
        query=links.query[kept],
        labels=links.labels[kept],
        rows=None if links.rows is None else links.rows[kept],
        noises=None if links.noises is None else links.noises[kept],
        official=None if read_parts is None else official,
    )


def only_trained(links: Links) -> Links:
    """Links to receivers that have training links; a remark names the other receivers."""
    split: Any = links.split
    trained = links.query.receivers[split.train].unique()
    if split.by_receivers:  # held-out receivers have given places, and are predicted untrained
        trained = links.query.receivers.unique()
    if len(trained) == len(links.receivers):
        return links
    # New number of each receiver (receivers,); -1 without a training link.
    number = torch.full((len(links.receivers),), -1)
    number = number.index_copy(0, trained, torch.arange(len(trained)))
    is_kept = number[links.query.receivers] >= 0
    index = is_kept.nonzero()[:, 0]
    groups = None if split.groups is None else split.groups[index]
    parts = {}
    for name, part in links.split.parts().items():
        parts[name] = torch.isin(index, part).nonzero()[:, 0]
    # About a link a receiver: the receivers are places of an end that moves.
    is_moving = len(links) < 1.5 * len(links.receivers)
    if len(links.split.test) and not len(parts["test"]) and is_moving:
        raise ValueError(
            f"{len(links.receivers)} receivers have {len(links)} links, and those with test links "
            "none to train on: models are learnt for each receiver\n"
            "give one_radio=True if both ends move, else the moving end as transmitters"
        )
    untrained = [links.receivers[old].name for old in (number < 0).nonzero()[:, 0].tolist()]
    remark = (
        f"receivers without a training link are left out, with {len(links) - len(index)} links: "
        f"{shortened(untrained)}"
    )
    return replace(
        kept_links(links, is_kept),
        query=replace(links.query[index], receivers=number[links.query.receivers[index]]),
        receivers=tuple(links.receivers[old] for old in trained.tolist()),
        official=None,
        split=replace(split, **parts, groups=groups),
        uncertainties=links.uncertainties[trained],
        remarks="; ".join(filter(None, (links.remarks, remark))),
    )


def with_places(links: Links) -> Links:
    """Links with estimated places of receivers without a place; a remark states the uncertainty."""
    if links.uncertainties.isfinite().all():
        return links
    receivers = [*links.receivers]
    deviations = links.uncertainties.clone()
    named = []
    train = links.split.train
    for number in (~deviations.isfinite()).nonzero()[:, 0].tolist():
        receiver = receivers[number]
        index = train[links.query.receivers[train] == number]
        place, deviation = estimate_place(links.query.transmitters[index], links.labels[index])
        receivers[number] = replace(receiver, pose=Pose(place, torch.eye(3)))
        deviations[number] = deviation
        named.append(f"{receiver.name} {deviation:.2g}")
    remark = (
        f"places of {len(named)} receivers are estimated from the training links, with a median "
        f"standard deviation of {deviations[deviations > 0].median().item():.2g} m: "
        f"{shortened(named)}"
    )
    return replace(
        links,
        receivers=tuple(receivers),
        uncertainties=deviations,
        remarks="; ".join(filter(None, (links.remarks, remark))),
    )
