"""Complex channels in one file of numpy arrays; docs/data.md describes them."""

import warnings
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from gaigs.antenna import Array, Receiver
from gaigs.data import Links
from gaigs.geometry import FAR, WITHIN, Pose
from gaigs.io.files import atomic_write
from gaigs.io.tables import find_file, number_places
from gaigs.query import CARRIERS, Query, unit_hint
from gaigs.registry import register
from gaigs.task.csi import Csi

ARRAYS = {
    "tx": ("real", ("n", 3)),
    "rx": ("real", ("k", 3)),
    "rx_index": ("whole", ("n",)),
    "frequencies": ("real", ("s",)),
    "h": ("complex", ("n", "e", "s")),
    "elements": ("real", ("e", 3)),
}
"""Numbers and shape of each array: n links, k receivers, s subcarriers, e elements. ``elements`` is optional."""

STRENGTHS = 1e-18, 1e18
"""Range of the strongest entry of a channel, whose square float32 can hold."""


@register("data", "csi_npz")
def read(file: str | Path) -> Links:
    """A data set from an ``.npz`` file, which is only read: one link for each channel.

    Receivers are named ``rx0``, ``rx1`` ... by their rows in ``rx``, and look along the world's axes. The links of one
    transmitter position share a row. Links whose channel is zero throughout are left out, and so are receivers without
    links; the remarks count them. The middle of the subcarriers' band counts as the carrier. There is no official
    split.

    Args:
        file: Holds ``tx`` (n, 3), the transmitters' positions [m]; ``rx`` (k, 3), the receivers' [m]; ``rx_index``
            (n,), the receiver of each link, from 0; ``frequencies`` (s,), those of the subcarriers [Hz]; ``h``
            (n, e, s), complex channels in linear amplitude; and optionally ``elements`` (e, 3), the offsets of an
            array's elements from its receiver's position along the world's axes [m]. Without it all elements count as
            standing at that position, and the remarks say so. Other arrays are named in the remarks.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: The file has a defect; the message names array, row and value.
    """
    file = find_file(file, "an .npz file of channels")
    arrays, ignored = _load(file)
    _check_shapes(file, arrays)
    _check_values(file, arrays)

    numbers = {name: torch.from_numpy(array) for name, array in arrays.items()}
    heard = (numbers["h"] != 0).flatten(1).any(1)
    present, receivers = numbers["rx_index"][heard].unique(return_inverse=True)
    transmitters = numbers["tx"].float()[heard]
    places, rows = number_places(transmitters.tolist())
    frequencies = numbers["frequencies"]
    carrier = (frequencies.min() + frequencies.max()).item() / 2
    count = numbers["h"].shape[1]
    array = Array(numbers["elements"].float() if "elements" in numbers else torch.zeros(count, 3))
    poses = [Pose(position, torch.eye(3)) for position in numbers["rx"].float()]
    everyone = [Receiver(f"rx{k}", pose, array) for k, pose in enumerate(poses)]
    remarks = [f"{len(rows)} channels from {len(places)} places at {len(present)} receivers"]
    if silent := int((~heard).sum()):
        remarks.append(f"{silent} that are zero throughout are left out")
    if absent := [receiver.name for k, receiver in enumerate(everyone) if k not in present]:
        remarks.append(f"receivers without links are left out: {', '.join(absent)}")
    if count > 1 and "elements" not in arrays:
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


def write(folder: str | Path, links: Links) -> None:
    """Writes channels to one receiver as ``room.npz`` in a folder, a file that ``read`` reads.

    Raises:
        OSError: The file cannot be written.
        ValueError: There is more than one receiver.
    """
    (receiver,) = links.receivers
    with atomic_write(Path(folder) / "room.npz") as part:
        np.savez(
            part,
            tx=links.query.transmitters.numpy(),
            rx=receiver.pose.position.numpy()[None],
            rx_index=links.query.receivers.numpy(),
            frequencies=links.task.frequencies.numpy(),
            h=links.labels.numpy(),
            elements=(receiver.array.elements.double() @ receiver.pose.rotation.double().T).numpy(),
        )


def _load(file: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """The arrays by name, and the names of others, which are not read.

    Raises:
        ValueError: The file is no archive of arrays, or an array is missing, repeated or damaged.
    """
    arrays = {}
    try:
        # Opened here, since numpy leaves a damaged file open; it warns of headers written by Python 2.
        with file.open("rb") as stream, warnings.catch_warnings(action="ignore"):
            content = np.load(stream, allow_pickle=False)
            if not isinstance(content, Mapping):
                raise ValueError(f"a single array of shape {content.shape}")
            members = [name.removesuffix(".npy") for name in content.zip.namelist()]
            for name, (kind, sizes) in ARRAYS.items():
                if name in members or name != "elements":
                    arrays[name] = _read(content.zip, name, members.count(name), f"{kind} numbers of {_shape(sizes)}")
    except Exception as error:  # damaged files make numpy and zipfile raise exceptions of many types
        raise ValueError(f"cannot parse {file}: {error}; expected an .npz file as numpy.savez writes it") from error
    return arrays, [name for name in members if name not in ARRAYS]


def _read(archive: zipfile.ZipFile, name: str, count: int, expected: str) -> np.ndarray:
    """An array, read to the end of its member, where zipfile compares the checksum.

    Raises:
        ValueError: The array is not there once, or damaged.
    """
    if count != 1:
        raise ValueError(f"{name}: expected one array of {expected}, got {count}")
    try:
        with archive.open(f"{name}.npy") as stream:
            array = np.lib.format.read_array(stream, allow_pickle=False)
            if stream.read(1):
                raise ValueError(f"more numbers than its shape {array.shape} has")
    except Exception as error:
        raise ValueError(f"{name}: {error}") from error
    return array


def _check_shapes(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Raises a ``ValueError`` for an array of another kind or shape; each size is that of the first array with it."""
    known: dict[object, int] = {}
    kinds = {"real": "iuf", "whole": "iu", "complex": "c"}  # of numpy's data types
    for name, array in arrays.items():
        kind, letters = ARRAYS[name]
        if array.dtype.kind not in kinds[kind]:
            hint = "; join real and imaginary parts by re + 1j * im" if kind == "complex" else ""
            raise ValueError(f"{file}: {name}: expected {kind} numbers, got {array.dtype}{hint}")
        sizes = [known.get(letter, letter) for letter in letters]
        fits = [isinstance(size, str) or size == got for size, got in zip(sizes, array.shape, strict=False)]
        if array.ndim != len(sizes) or not all(fits) or not array.size:
            hint = "; for one antenna add an axis, h[:, None, :]" if name == "h" and array.ndim == 2 else ""
            raise ValueError(f"{file}: {name}: expected the shape {_shape(sizes)}, got {_shape(array.shape)}{hint}")
        known |= dict(zip(letters, array.shape, strict=True))


def _check_values(file: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raises a ``ValueError`` for a number out of range; arrays become of the types to compute with."""
    for name, array in arrays.items():
        with np.errstate(all="ignore"):  # numbers too large for a type become infinite, and are refused
            dtype = {"h": np.complex64, "rx_index": np.int64}.get(name, np.float64)
            arrays[name] = array = array.astype(dtype, copy=False)
        match name:
            case "h":
                low, high = STRENGTHS
                with np.errstate(over="ignore"):
                    strengths = np.abs(array)
                strongest = strengths.max((1, 2), keepdims=True)
                holds = (strengths < high) & ~((strongest > 0) & (strongest < low))
                expected = f"magnitudes below {high:g}, the largest of a link {low:g} or more unless all are 0"
            case "rx_index":
                count = len(arrays["rx"])
                holds, expected = (array >= 0) & (array < count), f"a row of rx, 0..{count - 1}"
            case "frequencies":
                low, high = CARRIERS
                holds, expected = (low <= array) & (array <= high), f"a frequency from {low:g} to {high:g} Hz"
            case _:
                holds, expected = np.abs(array) < FAR, WITHIN
        for rule, good in (("a number", ~np.isnan(array)), (expected, holds)):
            wrong = np.argwhere(~good)
            if len(wrong):
                value, rows = array[tuple(wrong[0])], len(np.unique(wrong[:, 0]))
                hint = unit_hint(value) if name == "frequencies" else ""
                got = "NaN" if np.isnan(value) else value
                raise ValueError(
                    f"{file}: {name}{wrong[0].tolist()}: expected {rule}, got {got}{hint} (in {rows} of "
                    f"{len(array)} rows)"
                )
    if len(np.unique(arrays["frequencies"])) < len(arrays["frequencies"]):
        raise ValueError(f"{file}: frequencies: expected different ones, got one twice; leave one subcarrier out")
    if not arrays["h"].any():
        raise ValueError(f"{file}: h: expected a channel that is not zero throughout, got none")


def _shape(sizes: Sequence) -> str:
    """A shape as Python writes it; a letter stands for any size."""
    return f"({', '.join(map(str, sizes))}{',' if len(sizes) == 1 else ''})"
