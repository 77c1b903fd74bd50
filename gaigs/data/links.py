"""Links of a registered reader, or of arrays in memory."""

import inspect
import logging
import math
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
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
        >>> readings = [[-40.0, -52.0], [-45.0, float("nan")], [-50.0, -41.0], [-55.0, -44.0]]  # [dBm], nan: not heard
        >>> len(gaigs.links(task="rssi", transmitters=places, receivers=[[0, 0, 2], [3, 3, 2]], labels=readings))
        7
    """
    if reader is None:
        needed = ("task", "transmitters", "receivers", "labels")
        if missing := ", ".join(key for key in needed if key not in options):
            raise ValueError(
                f"links takes a reader's name first, or arrays: {', '.join(needed)}; missing: {missing}"
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
            (n, k, ...). Readings of NaN or None and channels of zeros were not heard, and are left
            out; so are receivers without training links.
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
    has_parts = test_rows is not None or train_rows is not None
    split = split or ("official" if has_parts else "random")
    if split in registry("split").names():
        fields, has = (
            [*inspect.signature(from_arrays).parameters][:-1],
            [*registry("split").options(split)],
        )
        if unknown := [key for key in options if key.rpartition(".")[2] not in has]:
            near, known = suggest(unknown[0], [*fields, *has]), ", ".join(fields)
            raise ValueError(
                f"arrays have no option {near}; they have: {known}; split {split!r}: {', '.join(has)}"
            )
    config = configuration.composed([], {"split": split, **options}, ("split",))["split"]
    if has_parts and (test_rows is None or config["name"] != "official"):
        raise ValueError(
            "train_rows and test_rows are for split='official'; give test_rows, and no other split"
        )
    task, remarks = registry("task").build(task), []
    places = as_positions("transmitters", transmitters).detach()
    if places.ndim != 2 or not len(places):
        raise ValueError(
            f"transmitters must be (n, 3) positions [m], got shape {tuple(places.shape)}"
        )
    if isinstance(receivers, Receiver):
        receivers = [receivers]
    if not (
        isinstance(receivers, Sequence) and all(isinstance(each, Receiver) for each in receivers)
    ):
        stands = as_positions("receivers", receivers).reshape(-1, 3)
        if (
            index is None
            and len(stands) == len(places) > 1
            and np.ndim(labels) == 1 + len(task.shape)
        ):
            distinct, index = number_places(stands.tolist())
            stands = torch.tensor(distinct)
        antenna = Array(torch.zeros(task.elements, 3))
        if task.elements > 1:
            remarks.append(
                f"positions of the {task.elements} elements are unknown: all count as standing at their receiver's"
            )
        receivers = [
            Receiver(f"rx{k}", Pose(place, torch.eye(3)), antenna) for k, place in enumerate(stands)
        ]
    names = [receiver.name for receiver in receivers]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"receivers must have different names, got {twice[0]!r} more than once")
    if np.ma.is_masked(labels):
        raise ValueError(
            "labels must be plain numbers, got a masked array; fill it with nan where nothing was heard"
        )
    convert = as_tensor if task.dtype.is_complex else as_numbers
    labels = convert("labels", labels, f"those of task {task.name!r}").detach()
    if task.dtype.is_complex and not labels.is_complex():
        raise ValueError(
            f"labels of task {task.name!r} must be complex, got {labels.dtype}; magnitudes have no phase"
        )
    labels = labels.to(task.dtype)
    if labels.is_complex():
        check_parts("labels", labels.numpy())
    count, most, shape = len(places), len(receivers), tuple(task.shape)
    rows = torch.arange(count)
    if tuple(labels.shape) == (count, most, *shape) and index is None:
        rows, index = rows.repeat_interleave(most), torch.arange(most).repeat(count)
        labels = labels.flatten(0, 1)
    elif tuple(labels.shape) == (count, *shape) and (index is not None or most == 1):
        index = as_tensor("index", 0 if index is None else index, "numbers of receivers")
        index = index if index.ndim else index.expand(count)
    else:
        raise ValueError(
            f"labels of task {task.name!r} must be {(count, *shape)} with the receiver of each link in index, or "
            f"{(count, most, *shape)}, one for each transmitter and receiver, got {tuple(labels.shape)}"
        )
    is_whole = not (index.is_floating_point() or index.is_complex() or index.dtype == torch.bool)
    if not is_whole or index.shape != (len(rows),) or not ((index >= 0) & (index < most)).all():
        raise ValueError(
            f"index must be {count} whole numbers from 0 to {most - 1}, got {index.tolist()[:5]} ..."
        )
    flat = labels.reshape(len(rows), -1)
    heard = ~flat.isnan().all(1) & ((flat != 0).any(1) | (not task.dtype.is_complex))
    broken = heard & ~flat.isfinite().all(1)
    if not heard.any() or broken.any():
        where = f"; link {int(broken.int().argmax())} is not" if broken.any() else ""
        raise ValueError(
            f"labels must be finite where something was heard, and something must have been heard{where}"
        )
    if not heard.all():
        remarks.append(f"{int((~heard).sum())} links were not heard and are left out")
    check_range(task, labels, "labels")
    if task.is_scalar and task.unit == "dBm":
        doubtful = loud_remark(labels[heard].tolist())
        marks = {mark: int((labels == mark).sum()) for mark in marks_of(labels[:, None].numpy())}
        doubtful += "".join(
            f"; {count} readings of {mark:g} dBm are taken for levels"
            for mark, count in marks.items()
        )
        if doubtful:
            remarks.append(doubtful.removeprefix("; "))
            log.warning("%s\ngive nan where nothing was heard, and levels in dBm", remarks[-1])
    carriers = None
    if frequency is None and task.frequencies is not None:
        frequency = (task.frequencies.min() + task.frequencies.max()).item() / 2
    if frequency is not None:
        carriers = as_numbers("frequency", frequency, "a carrier in Hz")
        if carriers.ndim and carriers.shape != (count,):
            raise ValueError(
                f"frequency must be one number, or {count}, one for each transmitter, got {len(carriers)}"
            )
        carriers = carriers.expand(count)[rows][heard]
        for carrier in carriers.unique().tolist():
            check_carrier("frequency", carrier)
    own, (distinct, sites) = rows[heard], number_places(places.tolist())
    parts: Any = None
    if has_parts:
        testing = _rows("test_rows", test_rows, count)
        others = torch.arange(count)[~torch.isin(torch.arange(count), testing)]
        training = others if train_rows is None else _rows("train_rows", train_rows, count)
        if (both := training[torch.isin(training, testing)]).numel():
            raise ValueError(
                f"train_rows and test_rows must have no row in common, got {both[0].item()} in both"
            )
        if not len(training):
            raise ValueError(f"test_rows leave no row to train on, got all {count}")
        parts = tuple(torch.isin(own, part).nonzero()[:, 0] for part in (training, testing))
        if beside := int(torch.isin(sites[own[parts[1]]], sites[own[parts[0]]]).sum()):
            remarks.append(f"{beside} test links stand at places of training links")
    made = Links(
        query=Query(places[rows][heard], index[heard].long(), carriers),
        receivers=tuple(receivers),
        labels=labels[heard],
        task=task,
        rows=sites[own],
        bandwidth=bandwidth,
        official=(lambda: parts) if has_parts else None,
        uncertainties=torch.zeros(len(receivers)) if task.is_scalar else None,
        frame=frame,
        remarks="; ".join(remarks),
    )
    try:
        links = divide(made, config)
    except ValueError:
        if len(distinct) > 1 or most == 1:
            raise
        raise ValueError(
            "transmitters all stand at one place; if receivers move, give their places as transmitters, and the fixed "
            "end as receiver: a channel is the same both ways"
        ) from None
    if left := [
        name for name in names if name not in {receiver.name for receiver in links.receivers}
    ]:
        log.warning(
            "receivers without a training link are left out: %s\nname the others by name",
            shortened(left),
        )
    return links


def _rows(name: str, values: Any, count: int) -> Int[Tensor, " k"]:
    """Ascending numbers of rows, given as such or as a mask of all ``count`` rows."""
    rows = as_tensor(name, values, "numbers of rows")
    if rows.dtype == torch.bool and rows.shape == (count,):
        rows = rows.nonzero()[:, 0]
    is_whole = not (rows.is_floating_point() or rows.is_complex() or rows.dtype == torch.bool)
    numbers, given = rows.long(), reprlib.repr(values)
    if not (
        is_whole and rows.ndim == 1 and len(rows) and ((numbers >= 0) & (numbers < count)).all()
    ):
        raise ValueError(
            f"{name} must be numbers of rows from 0 to {count - 1}, or a mask of {count}, got {given}"
        )
    if len(numbers.unique()) < len(numbers):
        raise ValueError(
            f"{name} must hold each row once, got {given}; a mask must be boolean, of True and False"
        )
    return numbers.sort().values
