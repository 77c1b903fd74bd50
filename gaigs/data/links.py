"""Links of a registered reader, or of arrays in memory."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from gaigs import configuration
from gaigs.antenna import Receiver
from gaigs.data import Links, divide, load
from gaigs.data.readings import LOUDEST, gateway, loud_remark, marks_of
from gaigs.io.tables import number_places
from gaigs.query import Query, as_numbers, as_positions, as_tensor, check_carrier
from gaigs.registry import registry
from gaigs.task import Task
from gaigs.task.rssi import Rssi
from gaigs.task.spectrum import Spectrum


def links(reader: str | None = None, /, **options: Any) -> Links:
    """Links of a registered reader, or of arrays in memory, with their split.

    Args:
        reader: Name of a registered reader, e.g. ``"synthetic"``, ``"nerf2_spectrum"``, ``"rssi_csv"``; None for
            arrays.
        options: Options of reader and split by their names, and ``split``, the name of a registered split. For arrays
            those of ``from_arrays``: ``task``, ``transmitters`` (n, 3) [m], ``receivers``, ``labels``.

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
            raise ValueError(f"links takes a reader's name first, or arrays: {', '.join(needed)}; missing: {missing}")
        return from_arrays(**options)
    config = configuration.composed([f"data={reader}"], options, ("data", "split"))
    return load(config["data"], config["split"])


def from_arrays(
    task: str | Task,
    transmitters: Any,
    receivers: Any,
    labels: Any,
    index: Any = None,
    frequency: Any = None,
    split: str | Mapping = "random",
    **options: Any,
) -> Links:
    """Links of arrays in memory, or of values that torch converts, with their split.

    Args:
        task: Task of the labels: ``"rssi"`` (scalars [dBm]), or a task with its axes, e.g.
            ``gaigs.task.spectrum.Spectrum(elevations, azimuths, "")`` or ``gaigs.task.csi.Csi(elements, frequencies)``.
        transmitters: Positions, world frame (n, 3) [m].
        receivers: ``Receiver`` or several, or positions (3,) or (k, 3) [m] of single antennas that look along the axes.
        labels: One a link, (n, ...) of the task's shape; or one for each transmitter and receiver, (n, k, ...).
            Readings of NaN and channels of zeros were not heard, and are left out.
        index: Receiver of each link (n,), or of all, from 0; not needed with one receiver, n positions, or labels
            (n, k, ...).
        frequency: Carrier, one or one a link [Hz]; None if unknown, for channels the middle of the subcarriers.
        split: Name of a registered split; ``options`` are its own.

    Raises:
        TypeError: An option has a wrong type.
        ValueError: Shapes do not fit, a number is not finite or out of range, or there is nothing to split.
    """
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
        receivers = [gateway(f"rx{k}", place) for k, place in enumerate(stands)]
    names = [receiver.name for receiver in receivers]
    if twice := [name for name in names if names.count(name) > 1]:
        raise ValueError(f"receivers must have different names, got {twice[0]!r} more than once")
    if np.ma.is_masked(labels):
        raise ValueError("labels must be plain numbers, got a masked array; fill it with nan where nothing was heard")
    convert = as_tensor if task.dtype.is_complex else as_numbers
    labels = convert("labels", labels, f"those of task {task.name!r}").detach()
    if task.dtype.is_complex and not labels.is_complex():
        raise ValueError(f"labels of task {task.name!r} must be complex, got {labels.dtype}; magnitudes have no phase")
    labels = labels.to(task.dtype)
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
        raise ValueError(f"index must be {count} whole numbers from 0 to {most - 1}, got {index.tolist()[:5]} ...")
    flat = labels.reshape(len(rows), -1)
    heard = ~flat.isnan().all(1) & ((flat != 0).any(1) | (not task.dtype.is_complex))
    broken = heard & ~flat.isfinite().all(1)
    if not heard.any() or broken.any():
        where = f"; link {int(broken.int().argmax())} is not" if broken.any() else ""
        raise ValueError(f"labels must be finite where something was heard, and something must have been heard{where}")
    remarks = f"{int((~heard).sum())} links were not heard and are left out" if not heard.all() else ""
    if isinstance(task, Rssi | Spectrum):
        lowest, highest, unit = (-200.0, LOUDEST, " dBm, nan where nothing was heard") if not shape else (0.0, 1.0, "")
        wrong = heard & ((flat < lowest) | (flat > highest + 1e-6)).any(1)
        if wrong.any():
            link = int(wrong.int().argmax())
            raise ValueError(
                f"labels of task {task.name!r} must be from {lowest:g} to {highest:g}{unit}; "
                f"those of link {link} are from {flat[link].min():g} to {flat[link].max():g}"
            )
    if isinstance(task, Rssi):
        remarks += loud_remark(labels[heard].tolist())
        marks = {mark: int((labels == mark).sum()) for mark in marks_of(labels[:, None].numpy())}
        remarks += "".join(f"; {count} readings of {mark:g} dBm are taken for levels" for mark, count in marks.items())
    carriers = None
    if frequency is None and hasattr(task, "frequencies"):
        frequency = (task.frequencies.min() + task.frequencies.max()).item() / 2
    if frequency is not None:
        carriers = as_numbers("frequency", frequency, "a carrier in Hz")
        if carriers.ndim and carriers.shape != (count,):
            raise ValueError(f"frequency must be one number, or {count}, one for each transmitter, got {len(carriers)}")
        carriers = carriers.expand(count)[rows][heard]
        for carrier in carriers.unique().tolist():
            check_carrier("frequency", carrier)
    made = Links(
        query=Query(places[rows][heard], index[heard].long(), carriers),
        receivers=tuple(receivers),
        labels=labels[heard],
        task=task,
        rows=number_places(places.tolist())[1][rows][heard],
        remarks=remarks.removeprefix("; "),
    )
    return divide(made, config)
