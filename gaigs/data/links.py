"""Links of a registered reader, or of arrays in memory."""

import inspect
import logging
import math
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gaigs import configuration
from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Frame, Pose
from gaigs.core.query import Query, as_numbers, as_positions, as_tensor, check_carrier
from gaigs.core.task import Task, check_range
from gaigs.data import Links, divide, load
from gaigs.data.parts import check_parts
from gaigs.data.readings import loud_remark, marks_of
from gaigs.io.tables import number_places, shortened
from gaigs.registry import check_instance, check_type, registry, suggest

log = logging.getLogger(__name__)


def links(reader: str | None = None, /, **options: Any) -> Links:
    """Links of a registered reader, or of arrays in memory, with their split.

    Args:
        reader: Name of a registered reader, e.g. ``"synthetic"``, ``"nerf2_spectrum"``,
            ``"rssi_csv"``; None for arrays.
        options: Options of reader and split by their names, and ``split``, the name of a registered
            split. For arrays those of ``from_arrays``: ``task``, ``transmitters`` (n, 3) [m],
            ``receivers``, ``labels``.

    Raises:
        FileNotFoundError: The reader finds no data.
        TypeError: An option has a wrong type.
        ValueError: A name is unknown, or files, arrays or the split do not fit.

    Example:
        >>> gaigs.links("synthetic_rssi", transmitters=50, split="blocks", edge=2.0).split.name
        'blocks 2 m, test 0.2, validation 0.1, seed 0'
        >>> places = [[1.0, 1.0, 1.0], [2.0, 1.0, 1.0], [1.0, 2.0, 1.0], [2.0, 2.0, 1.0]]
        >>> unheard = float("nan")
        >>> levels = [[-40.0, -52.0], [-45.0, unheard], [-50.0, -41.0], [-55.0, -44.0]]  # [dBm]
        >>> anchors = [[0, 0, 2], [3, 3, 2]]
        >>> len(gaigs.links(task="rssi", transmitters=places, receivers=anchors, labels=levels))
        7
    """
    if reader is None:
        needed = ("task", "transmitters", "receivers", "labels")
        missing = [key for key in needed if key not in options]
        if missing:
            raise ValueError(
                f"links takes a reader's name first, or arrays: {', '.join(needed)}; missing: "
                f"{', '.join(missing)}"
            )
        return from_arrays(**options)
    if "test_rows" in options or "train_rows" in options:
        raise ValueError("test_rows and train_rows are for arrays; of a reader choose a split")
    config = configuration.composed([f"data={reader}"], options, ("data", "split"))
    return load(config["data"], config["split"])


def from_arrays(
    task: str | Task,
    transmitters: Any,
    receivers: Any,
    labels: Any,
    index: Any = None,
    frequency: Any = None,
    bandwidth: float | None = None,
    split: str | Mapping | None = None,
    test_rows: Any = None,
    train_rows: Any = None,
    frame: Frame | None = None,
    **options: Any,
) -> Links:
    """Links of arrays in memory, or of values that torch converts, with their split.

    Args:
        task: Task of the labels: ``"rssi"`` (scalars [dBm]), or a task with its axes, e.g.
            ``Spectrum(elevations, azimuths)`` or ``Csi(elements, frequencies)`` of
            ``gaigs.core.task``.
        transmitters: Positions, world frame (n, 3) [m].
        receivers: ``Receiver`` or several, or positions (3,) or (k, 3) [m] of antennas that look
            along the axes; all elements of a channel then stand there.
        labels: One a link, (n, ...) of the task's shape; or one for each transmitter and receiver,
            (n, k, ...). Readings of NaN or None and channels of zeros were not received: they are
            left out, and so are receivers without training links.
        index: Receiver of each link (n,), or of all, from 0; not needed with one receiver, n
            positions, or labels (n, k, ...).
        frequency: Carrier, one or one a link [Hz]; None if unknown, for channels the middle of the
            subcarriers.
        bandwidth: Band around each carrier that powers are averaged over, 0 for a carrier alone
            [Hz]; None if unknown.
        split: Name of a registered split, ``options`` are its own; by default ``official`` with
            ``test_rows``, else ``random``.
        test_rows: Rows of ``transmitters`` to test on, as numbers or a mask (n,).
        train_rows: Rows to train and validate on; by default all others.
        frame: Place of the positions' origin on a map, such as ``gaigs.Frame(32632, 450000.0,
            5400000.0)`` for UTM less that easting and northing; None if unknown.

    Raises:
        TypeError: An option has a wrong type.
        ValueError: Shapes do not fit, a number is not finite or out of range, or there is nothing
            to split.
    """
    check_type("bandwidth", bandwidth, float | None)
    if frame is not None:
        check_instance("frame", frame, Frame)
    if bandwidth is not None and not 0 <= bandwidth < math.inf:
        raise ValueError(f"bandwidth must be 0 Hz or more, and finite, got {bandwidth}")
    config = _split_configuration(split, options, test_rows, train_rows)
    task = registry("task").build(task)
    places = as_positions("transmitters", transmitters).detach()
    if places.ndim != 2 or not len(places):
        raise ValueError(
            f"transmitters must be (n, 3) positions [m], got shape {tuple(places.shape)}"
        )
    remarks: list[str] = []
    if not _are_receivers(receivers):
        is_one_a_place = index is None and np.ndim(labels) == 1 + len(task.shape)
        receivers, index = _make_receivers(receivers, index, places, task, is_one_a_place, remarks)
    receivers = (receivers,) if isinstance(receivers, Receiver) else tuple(receivers)
    _check_names(receivers)
    rows, index, labels = _one_a_link(
        _as_labels(labels, task), index, len(places), len(receivers), task
    )
    received = _received(labels, task, remarks)
    check_range(task, labels, "labels")
    if task.is_scalar and task.unit == "dBm":
        _doubt_levels(labels, received, remarks)
    row = rows[received]
    sites = number_places(places.tolist())[1]
    parts: Any = None
    if test_rows is not None:
        parts = _parts(row, len(places), test_rows, train_rows)
        remarks += _shared_places(sites[row], *parts)
    undivided = Links(
        query=Query(places[row], index[received].long(), _carriers(frequency, task, row, places)),
        receivers=receivers,
        labels=labels[received],
        task=task,
        rows=sites[row],
        bandwidth=bandwidth,
        official=None if parts is None else (lambda: parts),
        uncertainties=torch.zeros(len(receivers)) if task.is_scalar else None,
        frame=frame,
        remarks="; ".join(remarks),
    )
    links = _divided(undivided, config)
    _warn_of_untrained(receivers, links.receivers)
    return links


def _warn_of_untrained(receivers: Sequence[Receiver], trained: Sequence[Receiver]) -> None:
    """Warns of receivers without training links."""
    names = {receiver.name for receiver in trained}
    untrained = [receiver.name for receiver in receivers if receiver.name not in names]
    if untrained:
        log.warning(
            "receivers without a training link are left out: %s\nname the others by name",
            shortened(untrained),
        )


def _divided(links: Links, split: Mapping) -> Links:
    """Links with their split; an error says if the ends of the links seem exchanged."""
    try:
        return divide(links, split)
    except ValueError:
        if len(links.receivers) == 1 or len(links.query.transmitters.unique(dim=0)) > 1:
            raise
        raise ValueError(
            "transmitters all stand at one place; if receivers move, give their places as "
            "transmitters, and the fixed end as receiver: a channel is the same both ways"
        ) from None


def _check_names(receivers: Sequence[Receiver]) -> None:
    """Raises a ``ValueError`` if two receivers have one name."""
    names = [receiver.name for receiver in receivers]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"receivers must have different names, got {name!r} more than once")


def _split_configuration(
    split: str | Mapping | None, options: Mapping, test_rows: Any, train_rows: Any
) -> dict:
    """The configuration of the split of arrays, with the options of its constructor."""
    has_rows = test_rows is not None or train_rows is not None
    split = split or ("official" if has_rows else "random")
    if split in registry("split").names():
        of_arrays = [*inspect.signature(from_arrays).parameters][:-1]
        of_split = [*registry("split").options(split)]
        for key in options:
            if key.rpartition(".")[2] in of_split:
                continue
            near = suggest(key, [*of_arrays, *of_split])
            raise ValueError(
                f"arrays have no option {near}; they have: {', '.join(of_arrays)}; split "
                f"{split!r}: {', '.join(of_split)}"
            )
    config = configuration.composed([], {"split": split, **options}, ("split",))["split"]
    if has_rows and (test_rows is None or config["name"] != "official"):
        raise ValueError(
            "train_rows and test_rows are for split='official'; give test_rows, and no other split"
        )
    return config


def _are_receivers(receivers: Any) -> bool:
    """True for a ``Receiver`` or several, in contrast to their positions."""
    if isinstance(receivers, Receiver):
        return True
    return isinstance(receivers, Sequence) and all(isinstance(r, Receiver) for r in receivers)


def _make_receivers(
    positions: Any,
    index: Any,
    places: Float[Tensor, "n 3"],
    task: Task,
    is_one_a_place: bool,
    remarks: list[str],
) -> tuple[list[Receiver], Any]:
    """Receivers at positions, named rx0, rx1, ..., and the receiver of each link.

    With ``is_one_a_place`` (one label for each place) and as many positions as places, position i
    is the receiver of link i; equal positions are one receiver.
    """
    stands = as_positions("receivers", positions).reshape(-1, 3)
    if is_one_a_place and len(stands) == len(places) > 1:
        distinct, index = number_places(stands.tolist())
        stands = torch.tensor(distinct)
    elements = task.elements
    if elements > 1:
        remarks.append(
            f"positions of the {elements} elements are unknown: all count as standing at their "
            "receiver's"
        )
    antenna = Array(torch.zeros(elements, 3))
    receivers = []
    for number, stand in enumerate(stands):
        receivers.append(Receiver(f"rx{number}", Pose(stand, torch.eye(3)), antenna))
    return receivers, index


def _as_labels(labels: Any, task: Task) -> Tensor:
    """Labels as a tensor of the task's dtype."""
    if np.ma.is_masked(labels):
        raise ValueError(
            "labels must be plain numbers, got a masked array; fill it with nan where nothing was "
            "heard"
        )
    convert = as_tensor if task.dtype.is_complex else as_numbers
    tensor = convert("labels", labels, f"those of task {task.name!r}").detach()
    if task.dtype.is_complex and not tensor.is_complex():
        raise ValueError(
            f"labels of task {task.name!r} must be complex, got {tensor.dtype}; magnitudes have no "
            "phase"
        )
    tensor = tensor.to(task.dtype)
    if tensor.is_complex():
        check_parts("labels", tensor.numpy())
    return tensor


class _LinkArrays(NamedTuple):
    """Row of ``transmitters``, receiver and label of each link."""

    rows: Int[Tensor, " m"]
    receivers: Int[Tensor, " m"]
    labels: Tensor


def _one_a_link(labels: Tensor, index: Any, count: int, receivers: int, task: Task) -> _LinkArrays:
    """Labels one a link, from (n, ...) with an index, or from (n, k, ...)."""
    shape = tuple(task.shape)
    rows = torch.arange(count)
    if tuple(labels.shape) == (count, receivers, *shape) and index is None:
        rows = rows.repeat_interleave(receivers)
        index = torch.arange(receivers).repeat(count)
        labels = labels.flatten(0, 1)  # (n x k, ...)
    elif tuple(labels.shape) == (count, *shape) and (index is not None or receivers == 1):
        index = as_tensor("index", 0 if index is None else index, "numbers of receivers")
        index = index if index.ndim else index.expand(count)
    else:
        raise ValueError(
            f"labels of task {task.name!r} must be {(count, *shape)} with the receiver of each "
            f"link in index, or {(count, receivers, *shape)}, one for each transmitter and "
            f"receiver, got {tuple(labels.shape)}"
        )
    is_whole = not (index.is_floating_point() or index.is_complex() or index.dtype == torch.bool)
    is_fitting = is_whole and index.shape == (len(rows),)
    if not is_fitting or not ((index >= 0) & (index < receivers)).all():
        raise ValueError(
            f"index must be {count} whole numbers from 0 to {receivers - 1}, got "
            f"{index.tolist()[:5]} ..."
        )
    return _LinkArrays(rows, index, labels)


def _received(labels: Tensor, task: Task, remarks: list[str]) -> Bool[Tensor, " m"]:
    """True for links with a label; NaN, and channels of zeros, were not received."""
    flat = labels.reshape(len(labels), -1)
    received = ~flat.isnan().all(1)
    if task.dtype.is_complex:
        received &= (flat != 0).any(1)
    broken = received & ~flat.isfinite().all(1)
    if not received.any() or broken.any():
        where = f"; link {int(broken.int().argmax())} is not" if broken.any() else ""
        raise ValueError(
            "labels must be finite where something was heard, and something must have been "
            f"heard{where}"
        )
    if not received.all():
        remarks.append(f"{int((~received).sum())} links were not heard and are left out")
    return received


def _doubt_levels(labels: Tensor, received: Tensor, remarks: list[str]) -> None:
    """Remarks, with a warning, about levels that may mean "not heard"."""
    doubts = [loud_remark(labels[received].tolist()).removeprefix("; ")]
    for mark in marks_of(labels[:, None].numpy()):
        readings = int((labels == mark).sum())
        doubts.append(f"{readings} readings of {mark:g} dBm are taken for levels")
    text = "; ".join(filter(None, doubts))
    if text:
        remarks.append(text)
        log.warning("%s\ngive nan where nothing was heard, and levels in dBm", text)


def _carriers(
    frequency: Any, task: Task, row: Int[Tensor, " m"], places: Float[Tensor, "n 3"]
) -> Float[Tensor, " m"] | None:
    """Carrier of each link [Hz]; of channels by default the middle of the subcarriers."""
    if frequency is None and task.frequencies is not None:
        frequency = (task.frequencies.min() + task.frequencies.max()).item() / 2
    if frequency is None:
        return None
    carriers = as_numbers("frequency", frequency, "a carrier in Hz")
    count = len(places)
    if carriers.ndim and carriers.shape != (count,):
        raise ValueError(
            f"frequency must be one number, or {count}, one for each transmitter, got "
            f"{len(carriers)}"
        )
    carriers = carriers.expand(count)[row]
    check_carrier("frequency", carriers.unique())
    return carriers


def _parts(
    row: Int[Tensor, " m"], count: int, test_rows: Any, train_rows: Any
) -> tuple[Int[Tensor, " k"], Int[Tensor, " l"]]:
    """Training and test links, by the rows of ``transmitters`` that were given."""
    testing = _rows("test_rows", test_rows, count)
    everything = torch.arange(count)
    training = everything[~torch.isin(everything, testing)]
    if train_rows is not None:
        training = _rows("train_rows", train_rows, count)
    both = training[torch.isin(training, testing)]
    if len(both):
        raise ValueError(
            f"train_rows and test_rows must have no row in common, got {both[0].item()} in both"
        )
    if not len(training):
        raise ValueError(f"test_rows leave no row to train on, got all {count}")
    return torch.isin(row, training).nonzero()[:, 0], torch.isin(row, testing).nonzero()[:, 0]


def _shared_places(
    sites: Int[Tensor, " m"], train: Int[Tensor, " k"], test: Int[Tensor, " l"]
) -> list[str]:
    """A remark if test links stand at places of training links."""
    shared = torch.isin(sites[test], sites[train])
    if not shared.any():
        return []
    return [f"{int(shared.sum())} test links stand at places of training links"]


def _rows(name: str, values: Any, count: int) -> Int[Tensor, " k"]:
    """Ascending numbers of rows, given as such or as a mask of all ``count`` rows."""
    rows = as_tensor(name, values, "numbers of rows")
    if rows.dtype == torch.bool and rows.shape == (count,):
        rows = rows.nonzero()[:, 0]
    is_whole = not (rows.is_floating_point() or rows.is_complex() or rows.dtype == torch.bool)
    numbers = rows.long()
    given = reprlib.repr(values)
    is_list = is_whole and rows.ndim == 1 and len(rows)
    if not is_list or not ((numbers >= 0) & (numbers < count)).all():
        raise ValueError(
            f"{name} must be numbers of rows from 0 to {count - 1}, or a mask of {count}, got "
            f"{given}"
        )
    if len(numbers.unique()) < len(numbers):
        raise ValueError(
            f"{name} must hold each row once, got {given}; a mask must be boolean, of True and "
            "False"
        )
    return numbers.sort().values
