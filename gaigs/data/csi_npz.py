"""Complex channels in one file of arrays, by numpy, MATLAB or HDF5; docs/data.md describes them."""

import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import CARRIERS, Query, unit_hint
from gaigs.core.task.csi import Csi
from gaigs.data import Links
from gaigs.data.bands import hold_out_band, in_bands
from gaigs.data.impulse_responses import from_sionna
from gaigs.data.parts import check_parts, join
from gaigs.data.readings import are_one_radio
from gaigs.io import FAR, WITHIN
from gaigs.io.arrays import ArrayFile, array_format
from gaigs.io.files import atomic_write
from gaigs.io.tables import find_file, number_places
from gaigs.registry import listed, register, suggest


class Layout(NamedTuple):
    """The expected numbers and shape of an array.

    Letters of shapes: n links, k receivers, s subcarriers, e elements, m antennas, p paths.
    """

    kind: str  # "real", "whole" or "complex"
    sizes: tuple[str | int, ...]  # sizes of the axes, or letters for any size

    def __str__(self) -> str:
        shape = str(self.sizes).replace("'", "")
        return f"{self.kind} numbers of {shape}"


ARRAYS = {
    "tx": Layout("real", ("n", 3)),
    "rx": Layout("real", ("k", 3)),
    "rx_index": Layout("whole", ("n",)),
    "frequencies": Layout("real", ("s",)),
    "h": Layout("complex", ("n", "e", "s")),
    "elements": Layout("real", ("e", 3)),
}
"""Arrays of files with channels; ``elements`` may be missing."""

RESPONSES = {
    "tx": Layout("real", ("n", 3)),
    "rx": Layout("real", ("k", 3)),
    "frequencies": Layout("real", ("s",)),
    "carrier": Layout("real", (1,)),
    "a": Layout("complex", ("k", "e", "n", "m", "p", 1)),
    "tau": Layout("real", ("k", "n", "p")),
    "elements": Layout("real", ("e", 3)),
}
"""Arrays of files with impulse responses ``a`` and ``tau`` in place of ``h``."""


@register("data", "csi_npz", task="csi", split="random")
def read(
    file: str | Path | Sequence[str | Path],
    arrays: Mapping[str, str | list] | None = None,
    phase: str = "known",
    band_train: Sequence[float] | None = None,
    band_test: Sequence[float] | None = None,
    parts: str | None = None,
    band_gap: float = 1.2,
    one_radio: bool | None = None,
) -> Links:
    """A data set from an ``.npz``, ``.mat`` or HDF5 file: one link for each channel.

    Receivers are named ``rx0``, ``rx1`` ... by their rows in ``rx``, and look along the world's
    axes. The links of one transmitter position share a row. Channels of zeros and receivers without
    links are left out; the remarks count them. The middle of the subcarriers' band counts as the
    carrier. There is no official split.

    A step of more than ``band_gap`` in frequency separates two bands, see
    ``gaigs.data.bands.in_bands``. A receiver then counts as one radio for each band, named for
    example ``rx0 2.412 GHz``. Its links are 0 in other bands.

    Args:
        file: One file, or a list of files of one site, for example one for each band. Arrays:
            ``tx`` (n, 3), positions of the transmitters [m]; ``rx`` (k, 3), positions of the
            receivers [m]; ``rx_index`` (n,), receiver of each link, from 0, optional with one
            receiver; ``frequencies`` (s,), subcarriers [Hz]; ``h`` (n, e, s), complex channels;
            optionally ``elements`` (e, 3), offsets of the elements from the receiver's position
            along the world's axes [m], by default 0. Elements (k, e, 3) are separate for each
            receiver; a missing one is NaN, and 0 in ``h``. The remarks name other arrays. In place
            of ``h`` and ``rx_index`` the file may have impulse responses, see
            ``gaigs.data.impulse_responses.from_sionna``.
        arrays: The file's names for these arrays if different, such as ``{"h": "CSI"}``. Two names
            are for real and imaginary part.
        phase: See ``gaigs.core.task.csi.Csi``.
        band_train, band_test: Subcarriers to train and to test on, as for
            ``gaigs.data.bands.hold_out_band`` [Hz].
        parts: Axis of 2, ``first`` or ``last``, along which a real ``h`` has real and imaginary
            part. None: ``h`` is complex, or two arrays.
        band_gap: Ratio of neighbouring frequencies above which a band ends.
        one_radio: True if the receivers are places of one radio. None: see
            ``gaigs.data.readings.are_one_radio``.

    Raises:
        FileNotFoundError: There is no such file.
        ImportError: The file needs h5py.
        ValueError: The file has a defect; the message names array, row and value.
    """
    paths = [file] if isinstance(file, str | Path) else file
    files = [find_file(path, "a file of channels") for path in paths]
    arrays = arrays or {}
    known = ARRAYS | RESPONSES
    if unknown := [suggest(name, known) for name in arrays if name not in known]:
        raise ValueError(f"data.arrays has no array {listed(unknown)}; it has: {listed(known)}")
    if parts not in (None, "first", "last"):
        raise ValueError(
            "data.parts must be first or last, the axis of real and imaginary part, or null, "
            f"got {parts!r}"
        )
    holds_out = band_train is not None or band_test is not None
    if not files or (len(files) > 1 and holds_out):
        raise ValueError(
            f"data.file must be one file where data.band_train is given, else one or more, got "
            f"{len(files)}"
        )
    links = [to_links(path, *_load(path, arrays, parts), phase) for path in files]
    if one_radio is not None:
        links = [replace(part, one_radio=one_radio) for part in links]
    if not holds_out:
        return _with_remark(in_bands(links, band_gap), one_radio)
    return _with_remark(hold_out_band(links[0], band_train, band_test), one_radio)


def _with_remark(links: Links, one_radio: bool | None) -> Links:
    """Links with a remark if their receivers are places of one radio.

    Raises:
        ValueError: ``one_radio`` is true, but the channels are of several bands, each of which
            counts as a radio.
    """
    if one_radio and not links.one_radio:
        raise ValueError("data.one_radio=true takes channels of one band; leave it out")
    added = "; the receivers are places of one radio" if links.one_radio else ""
    return replace(links, remarks=links.remarks + added)


def to_links(
    file: Path, arrays: dict[str, np.ndarray], ignored: Sequence[str], phase: str
) -> Links:
    """Links of the arrays that ``read`` describes, by name.

    Args:
        file: File of the arrays, or a word for them in messages.
        ignored: Names of other arrays.
        phase: See ``read``.
    """
    added: list[str] = []
    if "a" in arrays:
        try:
            arrays, added = from_sionna(arrays, needs_delays=phase != "per_link_and_delay")
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None
    _check_shapes(file, arrays)
    _check_values(file, arrays)
    check_parts(f"{file}: h", arrays["h"])
    _move_missing_elements_last(file, arrays)
    return _to_links(arrays, phase, added, ignored)


def _to_links(
    arrays: Mapping[str, np.ndarray], phase: str, added: Sequence[str], ignored: Sequence[str]
) -> Links:
    """Links of checked arrays, without channels of zeros.

    Args:
        added: Remarks on how the arrays were made.
        ignored: Names of other arrays in the file.
    """
    numbers = {name: torch.from_numpy(array) for name, array in arrays.items()}
    has_signal = (numbers["h"] != 0).flatten(1).any(1)  # (n,)
    present, receivers = numbers["rx_index"][has_signal].unique(return_inverse=True)
    transmitters = numbers["tx"].float()[has_signal]
    places, rows = number_places(transmitters.tolist())
    frequencies = numbers["frequencies"]
    carrier = (frequencies.min() + frequencies.max()).item() / 2
    count = numbers["h"].shape[1]
    elements = numbers.get("elements", torch.zeros(count, 3))
    candidates = _to_receivers(numbers["rx"].float(), elements.float())  # also without links

    remarks = [
        f"{len(rows)} channels from {len(places)} places at {len(present)} receivers",
        *added,
    ]
    if silent := int((~has_signal).sum()):
        remarks.append(f"{silent} that are zero throughout are left out")
    if absent := [receiver.name for k, receiver in enumerate(candidates) if k not in present]:
        remarks.append(f"receivers without links are left out: {', '.join(absent)}")
    if count > 1 and "elements" not in arrays:
        remarks.append(
            f"positions of the {count} elements are unknown: "
            "all count as standing at their receiver's"
        )
    if ignored:
        remarks.append(f"arrays ignored: {', '.join(ignored)}")
    one_radio = are_one_radio(len(present), len(rows), len(places))
    return Links(
        query=Query(transmitters, receivers, torch.full((len(rows),), carrier)),
        receivers=tuple(candidates[k] for k in present.tolist()),
        one_radio=one_radio,
        labels=numbers["h"][has_signal],
        task=Csi(count, frequencies, phase),
        rows=rows,
        remarks="; ".join(remarks),
    )


def _to_receivers(positions: Tensor, elements: Tensor) -> list[Receiver]:
    """Receivers at positions (k, 3), with the same elements (e, 3) or their own (k, e, 3) [m]."""
    receivers = []
    for k, offsets in enumerate(elements.expand(len(positions), -1, -1)):
        array = Array(offsets[offsets.isfinite().all(1)])  # elements of NaN are missing
        receivers.append(Receiver(f"rx{k}", Pose(positions[k], torch.eye(3)), array))
    return receivers


def write(folder: str | Path, links: Links) -> None:
    """Writes channels to one receiver as ``room.npz`` in a folder, for ``read``."""
    (receiver,) = links.receivers
    task: Csi = links.task
    # Offsets of the elements along the world's axes, as the file has no rotation.
    elements = receiver.array.elements.double() @ receiver.pose.rotation.double().T
    with atomic_write(Path(folder) / "room.npz") as part:
        np.savez(
            part,
            tx=links.query.transmitters.numpy(),
            rx=receiver.pose.position.numpy()[None],
            rx_index=links.query.receivers.numpy(),
            frequencies=task.frequencies.numpy(),
            h=links.labels.numpy(),
            elements=elements.numpy(),
        )


def _load(
    file: Path, given: Mapping[str, str | list], axis: str | None
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The arrays of a file by gaigs's names, and the names of ignored arrays.

    A ``ValueError`` names the array that could not be read.

    Args:
        given: Names of arrays in the file where they differ from gaigs's.
        axis: Axis of real and imaginary part, "first" or "last"; None for complex numbers.
    """
    arrays: dict[str, np.ndarray] = {}
    used: set[str] = set()
    place = ""  # start of an error: the array that is read
    form = array_format(file)
    try:
        with form.open(file) as content:
            present = {*content.names, *given}
            has_responses = {"a", "tau"} <= present and "h" not in present
            layouts = RESPONSES if has_responses else ARRAYS
            for name, layout in layouts.items():
                place = f"{name}: "
                if name not in present and _is_optional(name, arrays):
                    continue
                names = _names_in_file(name, given)
                array = _read_array(content, names, layout, axis)
                if form.is_matlab and name != "a":
                    array = _from_matlab(array, layout)
                arrays[name] = array
                used.update(names)
    except ImportError:
        raise
    # Damaged files make numpy, scipy and h5py raise exceptions of many types.
    except Exception as error:
        expected = form.description
        raise ValueError(f"cannot parse {file}: {place}{error}; expected {expected}") from error
    if "rx_index" not in arrays and "h" in arrays and arrays["rx"].shape[:1] == (1,):
        arrays["rx_index"] = np.zeros(arrays["tx"].shape[:1], np.int64)
    return arrays, [name for name in content.names if name not in used]


def _is_optional(name: str, arrays: Mapping[str, np.ndarray]) -> bool:
    """True if a file may lack an array.

    Args:
        arrays: Arrays that were read before it, such as ``rx`` before ``rx_index``.
    """
    if name == "rx_index":
        # One receiver needs no index. A wrong shape of rx gets its error elsewhere.
        return arrays["rx"].shape[:1] == (1,) or arrays["rx"].shape[1:] != (3,)
    return name == "elements"


def _names_in_file(name: str, given: Mapping[str, str | list]) -> list[str]:
    """The file's name for an array, or its two names for real and imaginary part."""
    names = given.get(name, name)
    names = [names] if isinstance(names, str) else [*names]
    if len(names) > 1 and not (name in ("h", "a") and len(names) == 2):
        raise ValueError(f"data.arrays has {len(names)} names")
    return names


def _read_array(
    content: ArrayFile, names: Sequence[str], layout: Layout, axis: str | None
) -> np.ndarray:
    """An array of a file, with real and imaginary part joined.

    Args:
        names: Name of the array, or names of real and imaginary part.
        axis: As for ``_load``.

    Raises:
        ValueError: The file has no array, or several arrays, of a name.
    """
    for name in names:
        count = content.names.count(name)
        if count != 1:
            raise ValueError(
                f"expected one array of {layout}, got {count} called {name!r} among "
                f"{reprlib.repr(content.names)}; data.arrays takes other names"
            )
    parts = [content.read(name) for name in names]
    return join(parts, axis) if layout.kind == "complex" else parts[0]


def _from_matlab(array: np.ndarray, layout: Layout) -> np.ndarray:
    """An array of MATLAB as numpy writes it.

    MATLAB has no vectors, drops a last axis of 1, and stores whole numbers as doubles.
    """
    axes = len(layout.sizes)
    if axes == 1 and array.size == max(array.shape, default=0):
        array = array.reshape(-1)
    elif layout.kind == "complex" and array.ndim == axes - 1:
        array = array[..., None]
    is_whole = layout.kind == "whole" and array.dtype.kind == "f"
    return array.astype(np.int64) if is_whole and (array == np.rint(array)).all() else array


def _check_shapes(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Raises a ``ValueError`` for arrays with another type or shape than their layout.

    The first array with a letter in its shape fixes the letter's size.
    """
    known: dict[object, int] = {}  # size of each letter
    kinds = {"real": "iuf", "whole": "iu", "complex": "c"}  # numpy's letters of data types
    for name, array in arrays.items():
        kind, letters = ARRAYS[name]
        if name == "elements" and array.ndim == 3:
            letters = ("k", *letters)
        if array.dtype.kind not in kinds[kind]:
            got = str(array.dtype)
            if kind == "complex":
                got += (
                    "; data.arrays={h: [RE, IM]} names real and imaginary part, "
                    "data.parts=last or first their axis of 2; amplitudes alone have no phase"
                )
            raise ValueError(f"{file}: {name}: expected {kind} numbers, got {got}")
        sizes = tuple(known.get(letter, letter) for letter in letters)
        if not array.size or not _fits(array.shape, sizes):
            # Channels of one antenna without the axis of elements: (n, s), or (n, s, 1) by MATLAB.
            is_flat = name == "h" and (array.ndim == 2 or array.shape[-1] == 1)
            hint = "; for one antenna add an axis, h[:, None, :]" if is_flat else ""
            expected = str(sizes).replace("'", "")
            raise ValueError(
                f"{file}: {name}: expected the shape {expected}, got {array.shape}{hint}"
            )
        known |= dict(zip(letters, array.shape, strict=True))


def _fits(shape: Sequence[int], sizes: Sequence[str | int]) -> bool:
    """True if a shape has given sizes, where letters stand for any size."""
    if len(shape) != len(sizes):
        return False
    return all(isinstance(size, str) or size == got for size, got in zip(sizes, shape, strict=True))


def _check_values(file: Path, arrays: dict[str, np.ndarray]) -> None:
    """Converts arrays in place to the types of the computation.

    Raises:
        ValueError: A number is NaN or out of range, frequencies repeat, or all channels are 0.
    """
    dtypes = {"h": np.complex64, "rx_index": np.int64}
    for name, array in arrays.items():
        # Numbers too large for a type become infinite, which fails below.
        with np.errstate(all="ignore"):
            array = array.astype(dtypes.get(name, np.float64), copy=False)
            arrays[name] = array
            if name == "elements" and array.ndim == 3:
                # An element that a receiver lacks has no position.
                array = np.where(np.isnan(array).all(-1, keepdims=True), 0, array)
            expected, holds = _rule(name, array, len(arrays["rx"]))
        _require(file, name, array, "a number", ~np.isnan(array))
        _require(file, name, array, expected, holds)
    if len(np.unique(arrays["frequencies"])) < len(arrays["frequencies"]):
        raise ValueError(
            f"{file}: frequencies: expected different ones, got one twice; leave one subcarrier out"
        )
    if not arrays["h"].any():
        raise ValueError(f"{file}: h: expected a channel that is not zero throughout, got none")


def _rule(name: str, array: np.ndarray, receivers: int) -> tuple[str, np.ndarray]:
    """The rule for the numbers of an array: a text for errors, and True for each allowed number.

    Args:
        receivers: Number of receivers.
    """
    if name == "h":
        low, high = 1e-18, 1e18  # float32 can hold their squares
        sizes = np.abs(array)
        strongest = sizes.max((1, 2), keepdims=True)  # (n, 1, 1)
        is_faint = (strongest > 0) & (strongest < low)
        words = f"magnitudes below {high:g}, the largest of a link {low:g} or more unless all are 0"
        return words, (sizes < high) & ~is_faint
    if name == "rx_index":
        words = f"a row of rx, counted from 0, 0..{receivers - 1}"
        return words, (array >= 0) & (array < receivers)
    if name == "frequencies":
        low, high = CARRIERS
        return f"a frequency from {low:g} to {high:g} Hz", (low <= array) & (array <= high)
    return WITHIN, np.abs(array) < FAR


def _require(file: Path, name: str, array: np.ndarray, expected: str, holds: np.ndarray) -> None:
    """Raises a ``ValueError`` that names the first number for which a rule does not hold.

    Args:
        expected: The rule as text.
        holds: True for each number that satisfies the rule.
    """
    wrong = np.argwhere(~holds)
    if not len(wrong):
        return
    value = array[tuple(wrong[0])]
    got = "NaN" if np.isnan(value) else f"{value}"
    if name == "frequencies" and not np.isnan(value):
        got += unit_hint(value)
    rows = len(np.unique(wrong[:, 0]))
    raise ValueError(
        f"{file}: {name}{wrong[0].tolist()}: expected {expected}, got {got} "
        f"(in {rows} of {len(array)} rows)"
    )


def _move_missing_elements_last(file: Path, arrays: dict[str, np.ndarray]) -> None:
    """Sorts the elements of each receiver in place: the elements that it lacks come last.

    Raises:
        ValueError: A receiver has no element, or a channel is not 0 at a lacking one.
    """
    if arrays.get("elements", np.zeros(0)).ndim < 3:
        return
    missing = np.isnan(arrays["elements"]).all(-1)  # (k, e)
    if len(bare := np.flatnonzero(missing.all(1))):
        raise ValueError(
            f"{file}: elements[{bare[0]}]: expected an element of each receiver, got NaN alone"
        )
    wrong = np.argwhere(arrays["h"].any(2) & missing[arrays["rx_index"]])
    if len(wrong):
        raise ValueError(
            f"{file}: h{wrong[0].tolist()}: expected 0 at an element without a position"
        )
    order = missing.argsort(1, kind="stable")  # (k, e), the missing ones last
    of_links = order[arrays["rx_index"]]  # (n, e)
    arrays["elements"] = np.take_along_axis(arrays["elements"], order[..., None], 1)
    arrays["h"] = np.take_along_axis(arrays["h"], of_links[..., None], 1)
