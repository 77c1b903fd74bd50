"""Complex channels from one file of numpy arrays; docs/data.md describes them."""

import warnings
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from gaigs.data import Links
from gaigs.geometry import FAR, WITHIN, Pose
from gaigs.io.tables import find_file, number_places, refuse
from gaigs.query import CARRIERS, Query, unit_hint
from gaigs.registry import register
from gaigs.scene import Array, Receiver
from gaigs.task.csi import Csi

KINDS = {"real": "iuf", "whole": "iu", "complex": "c"}
"""Kinds of numpy's data types that hold such numbers."""

ARRAYS = {
    "tx": ("real", ("n", 3)),
    "rx": ("real", ("k", 3)),
    "rx_index": ("whole", ("n",)),
    "frequencies": ("real", ("s",)),
    "h": ("complex", ("n", "e", "s")),
    "elements": ("real", ("e", 3)),
}
"""Numbers and shape of each array: n links, k receivers, s subcarriers, e elements."""

OPTIONAL = "elements"

STRENGTHS = 1e-18, 1e18
"""From the first to below the second lies the strongest entry of a channel: float32 holds its square."""


@register("data", "csi_npz")
def read(file: str | Path) -> Links:
    """A data set from an ``.npz`` file, which is only read: one link for each channel.

    Receivers are named ``rx0``, ``rx1`` ... by their rows in ``rx``, and look along the world's axes. The links of one
    transmitter position share a row. Links whose channel is zero throughout are left out, and so are receivers without
    links; the remarks say so. The middle of the subcarriers' band counts as the carrier. There is no official split.

    Args:
        file: Holds ``tx`` (n, 3), the transmitters' positions [m]; ``rx`` (k, 3), the receivers' [m]; ``rx_index``
            (n,), the receiver of each link, from 0; ``frequencies`` (s,), those of the subcarriers [Hz]; ``h``
            (n, e, s), complex channels in linear amplitude; and where there is one ``elements`` (e, 3), the offsets of
            an array's elements from its receiver's position along the world's axes [m]. Without it all elements count
            as standing at that position, and the remarks say so. Other arrays are named in the remarks.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: Something is wrong with the file; the message lists the defects by array and value.
    """
    file = find_file(file, "an .npz file of channels")
    defects: list[str] = []
    arrays, ignored = _load(file, defects)
    _check_shapes(arrays, defects)
    refuse(file, defects)
    _check_values(arrays, defects)
    refuse(file, defects)

    numbers = {name: torch.from_numpy(array) for name, array in arrays.items()}
    heard = (numbers["h"] != 0).flatten(1).any(1)
    present, receivers = numbers["rx_index"][heard].unique(return_inverse=True)
    transmitters = numbers["tx"].float()[heard]
    places, rows = number_places(transmitters.tolist())
    frequencies = numbers["frequencies"]
    carrier = (frequencies.min() + frequencies.max()).item() / 2
    count = numbers["h"].shape[1]
    array = Array(numbers[OPTIONAL].float() if OPTIONAL in numbers else torch.zeros(count, 3))
    poses = [Pose(position, torch.eye(3)) for position in numbers["rx"].float()]
    everyone = [Receiver(f"rx{k}", pose, array) for k, pose in enumerate(poses)]
    remarks = [f"{len(rows)} channels from {len(places)} places at {len(present)} receivers"]
    if silent := int((~heard).sum()):
        remarks.append(f"{silent} that are zero throughout are left out")
    if absent := [receiver.name for k, receiver in enumerate(everyone) if k not in present]:
        remarks.append(f"receivers without links are left out: {', '.join(absent)}")
    if count > 1 and OPTIONAL not in arrays:
        remarks.append(
            f"the file does not say where the {count} elements stand, so all count as standing at their receiver's "
            "position, and no geometry tells their phases apart"
        )
    if ignored:
        remarks.append(f"arrays ignored: {', '.join(ignored)}")
    return Links(
        query=Query(transmitters, receivers, torch.full((len(rows),), carrier)),
        receivers=tuple(everyone[k] for k in present.tolist()),
        labels=numbers["h"][heard],
        task=Csi(count, frequencies),
        rows=rows,
        remarks="; ".join(remarks),
    )


def _load(file: Path, defects: list[str]) -> tuple[dict[str, np.ndarray], list[str]]:
    """The arrays by name, and the names of others, which stay unread."""
    arrays, ignored = {}, []
    expected = "expected an .npz file, as numpy.savez writes it"
    try:
        # Opened here, since numpy would not close a file that it cannot read; it warns of headers written by Python 2.
        with file.open("rb") as stream, warnings.catch_warnings(action="ignore"):
            content = np.load(stream, allow_pickle=False)
            if not isinstance(content, Mapping):
                defects.append(f"{expected}, got a single array of shape {content.shape}")
                return arrays, ignored
            members = [name.removesuffix(".npy") for name in content.zip.namelist()]
            for name, (kind, sizes) in ARRAYS.items():
                if members.count(name) == 1:
                    try:
                        arrays[name] = _read(content.zip, f"{name}.npy")
                    except Exception as error:  # whatever a damaged array makes numpy and zipfile raise
                        defects.append(f"{name}: unreadable ({error})")
                elif name in members:
                    defects.append(f"{name}: stands there {members.count(name)} times; expected it once")
                elif name != OPTIONAL:
                    defects.append(f"{name}: missing; expected {kind} numbers of shape {_shape(sizes)}")
            ignored += [name for name in members if name not in ARRAYS]
    except Exception as error:  # whatever a file of another kind makes them raise
        defects.append(f"{expected}, which numpy cannot read ({error})")
    return arrays, ignored


def _read(archive: zipfile.ZipFile, member: str) -> np.ndarray:
    """An array, read to the end of its member, where zipfile compares the checksum.

    Raises:
        ValueError: The member goes on behind the array.
    """
    with archive.open(member) as stream:
        array = np.lib.format.read_array(stream, allow_pickle=False)
        if stream.read(1):
            raise ValueError(f"more numbers than its shape {array.shape} has")
    return array


def _check_shapes(arrays: Mapping[str, np.ndarray], defects: list[str]) -> None:
    """Kinds and shapes; each size is that of the first array that has it."""
    known: dict[object, int] = {}
    for name, array in arrays.items():
        kind, letters = ARRAYS[name]
        if array.dtype.kind not in KINDS[kind]:
            hint = "; join real and imaginary parts by re + 1j * im" if kind == "complex" else ""
            defects.append(f"{name}: expected {kind} numbers, got {array.dtype}{hint}")
        sizes = [known.get(letter, letter) for letter in letters]
        fits = [isinstance(size, str) or size == got for size, got in zip(sizes, array.shape, strict=False)]
        if array.ndim != len(sizes) or not all(fits):
            hint = "; for one antenna add an axis, h[:, None, :]" if name == "h" and array.ndim == 2 else ""
            defects.append(f"{name}: expected the shape {_shape(sizes)}, got {_shape(array.shape)}{hint}")
        elif not array.size:
            defects.append(f"{name}: expected the shape {_shape(sizes)} with no size of 0, got {_shape(array.shape)}")
        else:
            known |= dict(zip(letters, array.shape, strict=True))


def _check_values(arrays: dict[str, np.ndarray], defects: list[str]) -> None:
    """Ranges; arrays become those of the types that are reckoned with."""
    for name, array in arrays.items():
        with np.errstate(all="ignore"):  # what is too large for a type becomes infinite, and is refused
            dtype = {"h": np.complex64, "rx_index": np.int64}.get(name, np.float64)
            arrays[name] = array = array.astype(dtype, copy=False)
        match name:
            case "h":
                low, high = STRENGTHS
                with np.errstate(over="ignore"):
                    strengths = np.abs(array)
                strongest = strengths.max((1, 2), keepdims=True)
                holds = (strengths < high) & ~((strongest > 0) & (strongest < low))
                expected = f"numbers below {high:g}, the largest of a link {low:g} or more unless all are 0"
            case "rx_index":
                count = len(arrays["rx"])
                holds, expected = (array >= 0) & (array < count), f"a row of rx, 0..{count - 1}"
            case "frequencies":
                low, high = CARRIERS
                holds, expected = (low <= array) & (array <= high), f"a frequency from {low:g} to {high:g} Hz"
            case _:
                holds, expected = np.abs(array) < FAR, WITHIN
        wrong = np.flatnonzero(~holds.reshape(len(array), -1).all(1))
        if len(wrong):
            first, entries = wrong[0], f"{len(wrong)} of {len(array)} such rows"
            value = array[first][~holds[first]] if array.ndim > 1 else array[first]
            value = np.atleast_1d(value)[0]
            hint = unit_hint(value) if name == "frequencies" else ""
            defects.append(f"{name}[{first}]: expected {expected}, got {value}; {entries}{hint}")
        elif name == "frequencies" and len(np.unique(array)) < len(array):
            defects.append("frequencies: expected different ones, got one twice; leave one of its subcarriers out")
        elif name == "h" and not array.any():
            defects.append("h: expected a channel that is not zero throughout, got none")


def _shape(sizes: Sequence) -> str:
    """A shape as Python writes it; a letter stands for any size."""
    return f"({', '.join(map(str, sizes))}{',' if len(sizes) == 1 else ''})"
