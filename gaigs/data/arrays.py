"""Links of arrays in memory."""

import inspect
import logging
import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
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
from gaigs.data import Links, divide
from gaigs.data.parts import check_parts
from gaigs.data.readings import are_one_radio, marks_of, remark_on_zeros
from gaigs.data.rows import are_numbers, parts_of_rows
from gaigs.io.frames import is_frame, read_frame
from gaigs.io.tables import number_places, shortened
from gaigs.registry import check_instance, registry, suggest

log = logging.getLogger(__name__)


def from_arrays(
    task: str | Task,
    transmitters: Any,
    labels: Any,
    receivers: Any = None,
    index: Any = None,
    frequency: Any = None,
    bandwidth: float | None = None,
    split: str | Mapping | None = None,
    test_rows: Any = None,
    train_rows: Any = None,
    frame: Frame | None = None,
    height: float = 1.0,
    one_radio: bool | None = None,
    **options: Any,
) -> Links:
    """Links of arrays in memory, or of values that torch converts, with their split.

    Args:
        task: Task of the labels: ``"rssi"`` (scalars [dBm]), or a task with its axes, e.g.
            ``Spectrum(elevations, azimuths)`` or ``Csi(elements, frequencies)`` of
            ``gaigs.core.task``.
        transmitters: Positions, world frame (n, 3) [m], or (n, 2) of one ``height``.
        labels: A label for each link (n, *task.shape), or for each transmitter and receiver (n, k,
            *task.shape). Scalars (n, k) may be a data frame, whose columns name the receivers.
            Labels of NaN or None and channels of zeros were not received. They are left out, and
            so are receivers without training links.
        receivers: One or several ``Receiver``; or positions (3,) or (k, 3) [m]; or a mapping of
            names to positions. Receivers at positions have the world's axes, with all elements at
            the position. For levels [dBm] positions may be None or NaN; they are then estimated
            from the training links.
        index: Number of each link's receiver (n,), or one number for all links, from 0. It is not
            needed with one receiver, n positions, or labels (n, k, ...).
        frequency: Carrier of all links, or of each link (n,) [Hz]. None: unknown, or for channels
            the middle of the subcarriers.
        bandwidth: Band around each carrier over which powers are averaged [Hz]; 0: a single
            carrier; None: unknown.
        split: Name of a registered split, whose options are in ``options``. None: ``official`` if
            ``test_rows`` are given, otherwise ``random``.
        test_rows: Rows of ``transmitters`` to test on, as numbers or a mask (n,).
        train_rows: Rows to train and validate on. None: all other rows.
        frame: Place of the positions' origin on a map, such as ``gaigs.Frame(32632, 450000.0,
            5400000.0)`` for UTM less that easting and northing; None if unknown.
        height: Height of positions (n, 2) or (k, 2) [m].
        one_radio: True if the receivers are places of one moving radio, or identical radios, so
            that all have the same gain. None: ``gaigs.data.readings.are_one_radio`` decides, if
            each link has its own receiver position.

    Raises:
        TypeError: An option has a wrong type.
        ValueError: Shapes do not fit, a number is not finite or out of range, or there is nothing
            to split.
    """
    _check_options(bandwidth, frame)
    config = split_configuration("arrays", from_arrays, split, options, test_rows, train_rows)
    task = registry("task").build(task)
    remarks: list[str] = []
    places = as_positions("transmitters", _with_height(transmitters, height, remarks)).detach()
    if places.ndim != 2 or not len(places):
        raise ValueError(
            f"transmitters must be (n, 3) positions [m], got shape {tuple(places.shape)}"
        )
    names: list[str] = []
    if task.is_scalar and is_frame(labels):
        table = read_frame(labels, "labels")
        names, labels = table.names, table.numbers
    ends = _find_ends(receivers, names, labels, index, places, task, height, remarks)
    receivers = ends.receivers
    rows, index, labels = _one_a_link(
        _as_labels(labels, task), ends.index, len(places), len(receivers), task
    )
    received = _received(labels, task, remarks)
    check_range(task, labels, "labels")
    if task.is_scalar and task.unit == "dBm":
        _doubt_levels(labels, received, remarks)
    row = rows[received]  # row of ``transmitters`` of each received link
    sites = number_places(places.tolist())[1]  # number of each row's place
    parts: Any = None
    if test_rows is not None:
        parts = parts_of_rows(row, len(places), test_rows, train_rows)
        remarks += _remarks_on_shared_places(*(sites[row[part]] for part in parts))
    undivided = Links(
        query=Query(places[row], index[received].long(), _carriers(frequency, task, row, places)),
        receivers=receivers,
        labels=labels[received],
        task=task,
        rows=sites[row],
        bandwidth=bandwidth,
        official=None if parts is None else (lambda: parts),
        uncertainties=ends.uncertainties if task.is_scalar else None,
        frame=frame,
        one_radio=ends.are_one_radio(sites[row], one_radio, remarks),  # before they are joined
        remarks="; ".join(remarks),
    )
    links = divide(undivided, config)
    _warn_of_untrained(receivers, links.receivers)
    return links


def _remarks_on_shared_places(train: Int[Tensor, " k"], test: Int[Tensor, " l"]) -> list[str]:
    """A remark if test links stand at places of training links; both as numbers of places."""
    shared = int(torch.isin(test, train).sum())
    return [f"{shared} test links stand at places of training links"] if shared else []


def _warn_of_untrained(receivers: Sequence[Receiver], trained: Sequence[Receiver]) -> None:
    """Warns of receivers without training links."""
    names = {receiver.name for receiver in trained}
    untrained = [receiver.name for receiver in receivers if receiver.name not in names]
    if untrained:
        log.warning(
            "receivers without a training link are left out: %s\nuse names: indices shift",
            shortened(untrained),
        )


def _check_options(bandwidth: Any, frame: Any) -> None:
    """Raises a ``TypeError`` for a wrong frame, and a ``ValueError`` for a wrong bandwidth."""
    if frame is not None:
        check_instance("frame", frame, Frame)
    if bandwidth is not None and not 0 <= bandwidth < math.inf:
        raise ValueError(f"bandwidth must be 0 Hz or more, and finite, got {bandwidth}")


def _check_names(receivers: Sequence[Receiver]) -> None:
    """Raises a ``ValueError`` if two receivers have one name."""
    names = Counter(receiver.name for receiver in receivers)
    for name, count in names.items():
        if count > 1:
            raise ValueError(f"receivers must have different names, got {name!r} more than once")


def split_configuration(
    data: str,
    reader: Callable,
    split: str | Mapping | None,
    options: Mapping,
    test_rows: Any = None,
    train_rows: Any = None,
) -> dict:
    """The configuration of the split of data in memory, with the options of its constructor.

    Args:
        data: Name of the data in errors, in the plural, such as ``arrays``.
        reader: Function that the user calls; errors list its parameters but the last, the options.
        test_rows, train_rows: Rows that the user gives, for the split ``official`` only.
    """
    has_rows = test_rows is not None or train_rows is not None
    split = split or ("official" if has_rows else "random")
    if split in registry("split").names():
        of_arrays = [*inspect.signature(reader).parameters][:-1]
        of_split = [*registry("split").options(split)]
        for key in options:
            if key.rpartition(".")[2] in of_split:
                continue
            near = suggest(key, [*of_arrays, *of_split])
            raise ValueError(
                f"{data} have no option {near}; they have: {', '.join(of_arrays)}; split "
                f"{split!r}: {', '.join(of_split)}"
            )
    config = configuration.composed([], {"split": split, **options}, ("split",))["split"]
    if has_rows and (test_rows is None or config["name"] != "official"):
        raise ValueError(
            "train_rows and test_rows are for split='official'; give test_rows, and no other split"
        )
    return config


class _Ends(NamedTuple):
    """Receiving ends of the links: the receivers, and the receiver of each link."""

    receivers: tuple[Receiver, ...]
    index: Any  # receiver of each link; None if the labels' shape tells
    uncertainties: Float[Tensor, " k"]  # deviations of the receivers' places [m]
    is_one_each: bool = False  # True if each link came with a position of its receiver

    def are_one_radio(
        self, sent: Int[Tensor, " n"], given: bool | None, remarks: list[str]
    ) -> bool:
        """True if the receivers are places of one radio: as ``given``, or by ``are_one_radio``.

        A remark is added if it is true and the user has not said so.

        Args:
            sent: Number of each link's transmitter place.
        """
        if given is not None or not self.is_one_each:
            return bool(given)
        is_one = are_one_radio(len(self.receivers), len(sent), len(sent.unique()))
        if is_one:
            remarks.append("the receivers are places of one radio; one_radio=False parts them")
        return is_one


def _find_ends(
    receivers: Any,
    names: Sequence[str],
    labels: Any,
    index: Any,
    places: Float[Tensor, "n 3"],
    task: Task,
    height: float,
    remarks: list[str],
) -> _Ends:
    """The given receivers, or receivers made from positions or the shape of labels.

    Arguments are as for ``from_arrays``. ``names`` has the names of the labels' columns, if any,
    ``places`` has the transmitters [m], and remarks are added to ``remarks``.
    """
    receivers = (receivers,) if isinstance(receivers, Receiver) else receivers
    is_list = isinstance(receivers, Sequence)
    if is_list and all(isinstance(receiver, Receiver) for receiver in receivers):
        receivers = tuple(receivers)
        ends = _Ends(receivers, index, torch.zeros(len(receivers)))
    else:
        stands = _find_stands(receivers, names, np.shape(labels), index, height, task)
        is_one_a_place = index is None and np.ndim(labels) == 1 + len(task.shape)
        ends = _make_receivers(stands, index, places, task, is_one_a_place, remarks)
    _check_names(ends.receivers)
    return ends


class _Stands(NamedTuple):
    """Names and positions of receivers [m], NaN where ``is_known`` is false."""

    names: list[str]
    positions: Float[Tensor, "k 3"]
    is_known: Bool[Tensor, " k"]


def _find_stands(
    receivers: Any,
    columns: Sequence[str],
    shape: Sequence[int],
    index: Any,
    height: float,
    task: Task,
) -> _Stands:
    """Names and positions of the receivers; positions (k, 2) get the ``height`` [m].

    Args:
        receivers: Positions; a mapping of them by name; or None for receivers without a position,
            as many as ``index`` or the labels' ``shape`` has.
        columns: Names of the labels' columns; empty without names.
    """
    names = [*columns]
    if isinstance(receivers, Mapping):
        names = names or [*receivers]
        others = [suggest(name, names) for name in receivers if name not in names]
        if others:
            raise ValueError(f"labels have no column {', '.join(others)} of receivers")
        receivers = [receivers.get(name) for name in names]
    elif receivers is None:
        numbers = as_tensor("index", 0 if index is None else index, "numbers of receivers")
        count = int(np.nanmax(numbers.numpy(), initial=0)) + 1
        if index is None and len(shape) > 1:  # labels (n, k, ...)
            count = shape[1]
        receivers = [None] * count
    if isinstance(receivers, Sequence) and any(position is None for position in receivers):
        given = [position for position in receivers if position is not None]
        # NaN of the same length, so that all positions make one array.
        nowhere = [math.nan] * (len(given[0]) if given else 3)
        receivers = [nowhere if position is None else position for position in receivers]
    positions = as_numbers("receivers", _with_height(receivers, height), "positions [m]")
    is_known = ~positions[..., :2].isnan().all(-1)  # (k,)
    positions = torch.where(is_known[..., None], positions, 0.0)
    if not is_known.all() and task.unit != "dBm":
        raise ValueError(
            f"receivers must have positions for task {task.name!r}; only levels [dBm] tell where a "
            "receiver stands"
        )
    positions = as_positions("receivers", positions).reshape(-1, 3)
    return _Stands(names, positions, is_known.reshape(-1))


def _with_height(positions: Any, height: float, remarks: list[str] | None = None) -> Any:
    """Positions (n, 2) with a height [m]; values of another shape are unchanged.

    Args:
        remarks: List to which a remark on the height is added; None for no remark.
    """
    try:
        shape = np.shape(positions)
    except ValueError:  # lists of different lengths, which have an error of their own
        return positions
    if len(shape) != 2 or shape[1] != 2:
        return positions
    if remarks is not None:
        remarks.append(f"all places are {height:g} m high (height)")
    numbers = as_numbers("positions", positions, "x and y [m]")
    return torch.nn.functional.pad(numbers, (0, 1), value=height)


def _make_receivers(
    stands: _Stands,
    index: Any,
    places: Float[Tensor, "n 3"],
    task: Task,
    is_one_a_place: bool,
    remarks: list[str],
) -> _Ends:
    """Receivers at positions, named rx0, rx1, ... without names, and the receiver of each link.

    If labels and positions are one for each transmitter place, position i is the receiver of link
    i, and equal positions are one receiver.

    Args:
        stands: Names and positions of the receivers.
        index: Receiver of each link as given by the user.
        places: Positions of the transmitters [m].
        is_one_a_place: True if there is one label for each place, and no ``index``.
        remarks: List to which remarks are added.
    """
    positions = stands.positions
    uncertainties = torch.where(stands.is_known, 0.0, math.inf)
    is_one_each = is_one_a_place and len(positions) == len(places) > 1
    is_one_each &= bool(stands.is_known.all())
    if is_one_each:
        distinct, index = number_places(positions.tolist())
        positions = torch.tensor(distinct)
        uncertainties = torch.zeros(len(distinct))
    elements = task.elements
    if elements > 1:
        remarks.append(
            f"positions of the {elements} elements are unknown: all count as standing at their "
            "receiver's"
        )
    antenna = Array(torch.zeros(elements, 3))
    names = stands.names or [f"rx{number}" for number in range(len(positions))]
    if len(names) != len(positions):
        raise ValueError(
            f"receivers must be one a column of labels, {shortened(names)}, got {len(positions)}"
        )
    poses = [Pose(position, torch.eye(3)) for position in positions]
    pairs = zip(names, poses, strict=True)
    receivers = tuple(Receiver(name, pose, antenna) for name, pose in pairs)
    return _Ends(receivers, index, uncertainties, is_one_each)


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
    """Row, receiver and label of each link.

    Args:
        labels: Labels (n, ...) with an index, or (n, k, ...) without.
        index: Number of each link's receiver, or one number for all; None without an index.
        count: Number n of rows.
        receivers: Number k of receivers.

    Raises:
        ValueError: Labels have another shape, or an index is no receiver's number.
    """
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
    if index.shape != (len(rows),) or not are_numbers(index, receivers):
        raise ValueError(
            f"index must be {count} whole numbers from 0 to {receivers - 1}, got "
            f"{index.tolist()[:5]} ..."
        )
    return _LinkArrays(rows, index, labels)


def _received(labels: Tensor, task: Task, remarks: list[str]) -> Bool[Tensor, " m"]:
    """True for links that were received: their label is neither NaN nor a channel of zeros.

    Raises:
        ValueError: No link was received, or a label is NaN or infinite in part.
    """
    values = labels.reshape(len(labels), -1)  # (m, values of a label)
    received = ~values.isnan().all(1)
    if task.dtype.is_complex:
        received &= (values != 0).any(1)
    broken = received & ~values.isfinite().all(1)
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
    """Adds a remark, and logs a warning, about levels that may mean "not heard"."""
    doubts = [remark_on_zeros(labels[received].tolist()).removeprefix("; ")]
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
    """Carrier of each link [Hz]; for channels by default the middle of the subcarriers.

    The result is None if the carrier is unknown. ``row`` has the row of each link in ``places``.
    """
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
