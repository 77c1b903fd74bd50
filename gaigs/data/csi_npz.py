"""Complex channels in one file of arrays, by numpy, MATLAB or HDF5; docs/data.md describes them."""

import contextlib
import reprlib
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import scipy.io
import torch

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import CARRIERS, Query, unit_hint
from gaigs.core.task.csi import Csi
from gaigs.data import Links
from gaigs.data.bands import hold_out_band
from gaigs.data.impulse_responses import from_sionna
from gaigs.data.parts import check_parts, join
from gaigs.io import FAR, WITHIN
from gaigs.io.files import atomic_write
from gaigs.io.tables import find_file, number_places
from gaigs.registry import listed, register, suggest

ARRAYS = {
    "tx": ("real", ("n", 3)),
    "rx": ("real", ("k", 3)),
    "rx_index": ("whole", ("n",)),
    "frequencies": ("real", ("s",)),
    "h": ("complex", ("n", "e", "s")),
    "elements": ("real", ("e", 3)),
}
"""Numbers and shape of each array: n links, k receivers, s subcarriers, e elements. ``elements``
may be missing.
"""

RESPONSES = {
    "tx": ("real", ("n", 3)),
    "rx": ("real", ("k", 3)),
    "frequencies": ("real", ("s",)),
    "carrier": ("real", (1,)),
    "a": ("complex", ("k", "e", "n", "m", "p", 1)),
    "tau": ("real", ("k", "n", "p")),
    "elements": ("real", ("e", 3)),
}
"""The same of files with impulse responses ``a`` and ``tau`` in place of ``h``."""

HDF5 = b"\x89HDF\r\n\x1a\n"
"""Signature of HDF5 files, at the start or, from MATLAB, after 512 bytes."""

STRENGTHS = 1e-18, 1e18
"""Range of the strongest entry of a channel, whose square float32 can hold."""


@register("data", "csi_npz", task="csi", split="random")
def read(
    file: str | Path,
    arrays: Mapping[str, str | list] | None = None,
    phase: str = "known",
    band_train: Sequence[float] | None = None,
    band_test: Sequence[float] | None = None,
    parts: str | None = None,
) -> Links:
    """A data set from an ``.npz``, ``.mat`` or HDF5 file: one link for each channel.

    Receivers are named ``rx0``, ``rx1`` ... by their rows in ``rx``, and look along the world's
    axes. The links of one transmitter position share a row. Channels of zeros and receivers without
    links are left out; the remarks count them. The middle of the subcarriers' band counts as the
    carrier. There is no official split.

    Args:
        file: Arrays ``tx`` (n, 3), positions of the transmitters [m]; ``rx`` (k, 3), positions of
            the receivers [m]; ``rx_index`` (n,), receiver of each link, from 0, not needed with one
            receiver; ``frequencies`` (s,), subcarriers [Hz]; ``h`` (n, e, s), complex channels,
            linear amplitude; optionally ``elements`` (e, 3), offsets of an array's elements from
            its receiver's position along the world's axes [m], by default 0. With (k, e, 3) each
            receiver has its own, and NaN for those that it lacks, where ``h`` is 0. The remarks
            name other arrays. In place of ``h`` and ``rx_index`` the file may have impulse
            responses, see ``gaigs.data.impulse_responses.from_sionna``.
        arrays: Names of these arrays in the file where they differ, such as ``{"h": "CSI"}``; two
            names are those of real and imaginary part.
        phase: Of ``gaigs.core.task.csi.Csi``.
        band_train, band_test: Subcarriers to train and to test on, as for
            ``gaigs.data.bands.hold_out_band`` [Hz].
        parts: Axis of 2, ``first`` or ``last``, along which a real ``h`` has real and imaginary
            part. None: ``h`` is complex, or two arrays.

    Raises:
        FileNotFoundError: There is no such file.
        ImportError: The file needs h5py.
        ValueError: The file has a defect; the message names array, row and value.
    """
    file = find_file(file, "a file of channels")
    arrays = arrays or {}
    known = ARRAYS | RESPONSES
    if unknown := [suggest(name, known) for name in arrays if name not in known]:
        raise ValueError(f"data.arrays has no array {listed(unknown)}; it has: {listed(known)}")
    if parts not in (None, "first", "last"):
        raise ValueError(
            f"data.parts must be first or last, the axis of real and imaginary part, or null, got {parts!r}"
        )
    loaded, ignored = _load(file, arrays, parts)
    added: list[str] = []
    if "a" in loaded:
        try:
            loaded, added = from_sionna(loaded, needs_delays=phase != "per_link_and_delay")
        except ValueError as error:
            raise ValueError(f"{file}: {error}") from None
    _check_shapes(file, loaded)
    _check_values(file, loaded)
    check_parts(f"{file}: h", loaded["h"])
    _move_missing_elements_last(file, loaded)

    numbers = {name: torch.from_numpy(array) for name, array in loaded.items()}
    heard = (numbers["h"] != 0).flatten(1).any(1)
    present, receivers = numbers["rx_index"][heard].unique(return_inverse=True)
    transmitters = numbers["tx"].float()[heard]
    places, rows = number_places(transmitters.tolist())
    frequencies = numbers["frequencies"]
    carrier = (frequencies.min() + frequencies.max()).item() / 2
    count, positions = numbers["h"].shape[1], numbers["rx"].float()
    elements = numbers.get("elements", torch.zeros(count, 3)).float().expand(len(positions), -1, -1)
    antennas = [Array(own[own.isfinite().all(1)]) for own in elements]
    poses = [Pose(position, torch.eye(3)) for position in positions]
    everyone = [
        Receiver(f"rx{k}", *parts) for k, parts in enumerate(zip(poses, antennas, strict=True))
    ]
    remarks = [
        f"{len(rows)} channels from {len(places)} places at {len(present)} receivers",
        *added,
    ]
    if silent := int((~heard).sum()):
        remarks.append(f"{silent} that are zero throughout are left out")
    if absent := [receiver.name for k, receiver in enumerate(everyone) if k not in present]:
        remarks.append(f"receivers without links are left out: {', '.join(absent)}")
    if count > 1 and "elements" not in loaded:
        remarks.append(
            f"positions of the {count} elements are unknown: all count as standing at their receiver's"
        )
    if ignored:
        remarks.append(f"arrays ignored: {', '.join(ignored)}")
    links = Links(
        query=Query(transmitters, receivers, torch.full((len(rows),), carrier)),
        receivers=tuple(everyone[k] for k in present.tolist()),
        labels=numbers["h"][heard],
        task=Csi(count, frequencies, phase),
        rows=rows,
        remarks="; ".join(remarks),
    )
    return hold_out_band(links, band_train, band_test)


def write(folder: str | Path, links: Links) -> None:
    """Writes channels to one receiver as ``room.npz`` in a folder, for ``read``."""
    (receiver,) = links.receivers
    task: Csi = links.task
    with atomic_write(Path(folder) / "room.npz") as part:
        np.savez(
            part,
            tx=links.query.transmitters.numpy(),
            rx=receiver.pose.position.numpy()[None],
            rx_index=links.query.receivers.numpy(),
            frequencies=task.frequencies.numpy(),
            h=links.labels.numpy(),
            elements=(receiver.array.elements.double() @ receiver.pose.rotation.double().T).numpy(),
        )


def _load(
    file: Path, given: Mapping[str, str | list], axis: str | None
) -> tuple[dict[str, np.ndarray], list[str]]:
    """The arrays by name, and the names of ignored arrays; ``given`` has other names of arrays in
    the file.
    """
    arrays: dict[str, np.ndarray] = {}
    place, used = "", list[str]()
    with file.open("rb") as stream:
        head = stream.read(520)
    opened, expected = _npz, "an .npz file as numpy.savez writes it"
    if HDF5 in (head[:8], head[512:520]):
        opened, expected = _hdf5, "an HDF5 file"
    elif file.suffix.lower() == ".mat":
        opened, expected = _mat, "a .mat file as MATLAB writes it"
    try:
        with opened(file) as (members, get):
            has = {*members, *given}
            for name, (kind, sizes) in (
                RESPONSES if {"a", "tau"} <= has and "h" not in has else ARRAYS
            ).items():
                place, names = f"{name}: ", given.get(name, name)
                names = [names] if isinstance(names, str) else [*names]
                if name not in given and name not in members:
                    if name == "elements":
                        continue
                    if name == "rx_index" and arrays["rx"].shape[:1] == (1,):
                        arrays[name] = np.zeros(arrays["tx"].shape[:1], np.int64)
                        continue
                    if name == "rx_index" and arrays["rx"].shape[1:] != (3,):
                        continue  # the error names the shape of rx
                if len(names) > 1 and not (name in ("h", "a") and len(names) == 2):
                    raise ValueError(f"data.arrays has {len(names)} names")
                if missing := [own for own in names if members.count(own) != 1]:
                    shape = str(sizes).replace("'", "")
                    raise ValueError(
                        f"expected one array of {kind} numbers of {shape}, got {members.count(missing[0])} called "
                        f"{missing[0]!r} among {reprlib.repr(members)}; data.arrays takes other names"
                    )
                parts, used = [get(own) for own in names], used + names
                array = join(parts, axis) if kind == "complex" else parts[0]
                if opened is not _npz and name != "a":
                    array = _from_matlab(array, kind, len(sizes))
                arrays[name] = array
    except ImportError:
        raise
    except (
        Exception
    ) as error:  # damaged files make numpy, scipy and h5py raise exceptions of many types
        raise ValueError(f"cannot parse {file}: {place}{error}; expected {expected}") from error
    return arrays, [name for name in members if name not in used]


def _from_matlab(array: np.ndarray, kind: str, axes: int) -> np.ndarray:
    """MATLAB has no vectors, drops a last axis of 1, and stores whole numbers as doubles."""
    if axes == 1 and array.size == max(array.shape, default=0):
        array = array.reshape(-1)
    elif kind == "complex" and array.ndim == axes - 1:
        array = array[..., None]
    is_whole = kind == "whole" and array.dtype.kind == "f" and (array == np.rint(array)).all()
    return array.astype(np.int64) if is_whole else array


Opened = Iterator[tuple[list[str], Callable[[str], np.ndarray]]]


@contextlib.contextmanager
def _npz(file: Path) -> Opened:
    """Names of the arrays, and a function that reads one to the end, where zipfile compares
    checksums.
    """
    # Opened here, since numpy leaves a damaged file open; it warns of headers written by Python 2.
    with file.open("rb") as stream, warnings.catch_warnings(action="ignore"):
        content = np.load(stream, allow_pickle=False)
        if not isinstance(content, np.lib.npyio.NpzFile):
            raise ValueError(f"a single array of shape {content.shape}")

        def get(name: str) -> np.ndarray:
            with content.zip.open(f"{name}.npy") as member:
                array = np.lib.format.read_array(member, allow_pickle=False)
                if member.read(1):
                    raise ValueError(f"more numbers than its shape {array.shape} has")
            return array

        yield [name.removesuffix(".npy") for name in content.zip.namelist()], get


@contextlib.contextmanager
def _mat(file: Path) -> Opened:
    """The same of a MATLAB file before version 7.3."""
    yield (
        [name for name, *_ in scipy.io.whosmat(file)],
        lambda name: np.asarray(scipy.io.loadmat(file, variable_names=[name])[name]),
    )


@contextlib.contextmanager
def _hdf5(file: Path) -> Opened:
    """The same of an HDF5 file; those of MATLAB, with reversed axes, have an attribute."""
    try:
        import h5py
    except ModuleNotFoundError as error:
        raise ImportError(f"{file} needs h5py: pip install 'gaigs[hdf5]'") from error
    with h5py.File(file, "r") as content:
        members: list[str] = []
        content.visititems(
            lambda name, item: members.append(name) if isinstance(item, h5py.Dataset) else None
        )

        def get(name: str) -> np.ndarray:
            array = content[name][()]
            if array.dtype.names and len(array.dtype.names) == 2:  # MATLAB's complex numbers
                real, imaginary = (array[part] for part in array.dtype.names)
                array = real + 1j * imaginary
            return array.T if "MATLAB_class" in content[name].attrs else array

        yield [name for name in members if not name.startswith("#refs#")], get


def _check_shapes(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Raises a ``ValueError`` for other kinds and shapes of arrays; the first array with a size
    fixes it.
    """
    known: dict[object, int] = {}
    kinds = {"real": "iuf", "whole": "iu", "complex": "c"}  # of numpy's data types
    for name, array in arrays.items():
        kind, letters = ARRAYS[name]
        letters = ("k", *letters) if name == "elements" and array.ndim == 3 else letters
        if array.dtype.kind not in kinds[kind]:
            hint = "; data.arrays={h: [RE, IM]} names real and imaginary part, data.parts=last or first their axis of 2"
            hint += "; amplitudes alone have no phase"
            got = f"{array.dtype}{hint}" if kind == "complex" else array.dtype
            raise ValueError(f"{file}: {name}: expected {kind} numbers, got {got}")
        sizes = tuple(known.get(letter, letter) for letter in letters)
        fits = [
            isinstance(size, str) or size == got
            for size, got in zip(sizes, array.shape, strict=False)
        ]
        if array.ndim != len(sizes) or not all(fits) or not array.size:
            is_flat = name == "h" and (
                array.ndim == 2 or array.shape[-1] == 1
            )  # MATLAB's arrays get a last axis of 1
            hint = "; for one antenna add an axis, h[:, None, :]" if is_flat else ""
            expected = str(sizes).replace("'", "")
            raise ValueError(
                f"{file}: {name}: expected the shape {expected}, got {array.shape}{hint}"
            )
        known |= dict(zip(letters, array.shape, strict=True))


def _check_values(file: Path, arrays: dict[str, np.ndarray]) -> None:
    """Converts arrays to the types of the computation; a ``ValueError`` for a number out of range."""
    for name, array in arrays.items():
        with np.errstate(
            all="ignore"
        ):  # numbers too large for a type become infinite, which fails below
            dtype = {"h": np.complex64, "rx_index": np.int64}.get(name, np.float64)
            arrays[name] = array = array.astype(dtype, copy=False)
            match name:
                case "h":
                    (low, high), strengths = STRENGTHS, np.abs(array)
                    strongest = strengths.max((1, 2), keepdims=True)
                    holds = (strengths < high) & ~((strongest > 0) & (strongest < low))
                    expected = f"magnitudes below {high:g}, the largest of a link {low:g} or more unless all are 0"
                case "rx_index":
                    count = len(arrays["rx"])
                    holds, expected = (
                        (array >= 0) & (array < count),
                        f"a row of rx, counted from 0, 0..{count - 1}",
                    )
                case "frequencies":
                    low, high = CARRIERS
                    holds, expected = (
                        (low <= array) & (array <= high),
                        f"a frequency from {low:g} to {high:g} Hz",
                    )
                case _:
                    # An element that a receiver lacks has no position.
                    array = (
                        np.where(np.isnan(array).all(-1, keepdims=True), 0, array)
                        if array.ndim == 3
                        else array
                    )
                    holds, expected = np.abs(array) < FAR, WITHIN
        for rule, good in (("a number", ~np.isnan(array)), (expected, holds)):
            wrong = np.argwhere(~good)
            if len(wrong):
                value, rows = array[tuple(wrong[0])], len(np.unique(wrong[:, 0]))
                got = (
                    "NaN"
                    if np.isnan(value)
                    else f"{value}{unit_hint(value) if name == 'frequencies' else ''}"
                )
                count = f"in {rows} of {len(array)} rows"
                raise ValueError(
                    f"{file}: {name}{wrong[0].tolist()}: expected {rule}, got {got} ({count})"
                )
    if len(np.unique(arrays["frequencies"])) < len(arrays["frequencies"]):
        raise ValueError(
            f"{file}: frequencies: expected different ones, got one twice; leave one subcarrier out"
        )
    if not arrays["h"].any():
        raise ValueError(f"{file}: h: expected a channel that is not zero throughout, got none")


def _move_missing_elements_last(file: Path, arrays: dict[str, np.ndarray]) -> None:
    """Sorts the elements of each receiver, so that labels end with those that it lacks."""
    if arrays.get("elements", np.zeros(0)).ndim < 3:
        return
    missing = np.isnan(arrays["elements"]).all(-1)
    if len(bare := np.flatnonzero(missing.all(1))):
        raise ValueError(
            f"{file}: elements[{bare[0]}]: expected an element of each receiver, got NaN alone"
        )
    wrong = np.argwhere(arrays["h"].any(2) & missing[arrays["rx_index"]])
    if len(wrong):
        raise ValueError(
            f"{file}: h{wrong[0].tolist()}: expected 0 at an element without a position"
        )
    order = missing.argsort(1, kind="stable")
    arrays["elements"] = np.take_along_axis(arrays["elements"], order[..., None], 1)
    arrays["h"] = np.take_along_axis(arrays["h"], order[arrays["rx_index"]][..., None], 1)
