"""Complex channels in one file of numpy arrays; docs/data.md describes them."""

import warnings
from collections.abc import Mapping
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
    """A data set from an ``.npz`` file: one link for each channel.

    Receivers are named ``rx0``, ``rx1`` ... by their rows in ``rx``, and look along the world's axes. The links of one
    transmitter position share a row. Channels of zeros and receivers without links are left out; the remarks count
    them. The middle of the subcarriers' band counts as the carrier. There is no official split.

    Args:
        file: Arrays ``tx`` (n, 3), positions of the transmitters [m]; ``rx`` (k, 3), positions of the receivers [m];
            ``rx_index`` (n,), receiver of each link, from 0; ``frequencies`` (s,), subcarriers [Hz]; ``h`` (n, e, s),
            complex channels, linear amplitude; optionally ``elements`` (e, 3), offsets of an array's elements from
            its receiver's position along the world's axes [m], by default 0. The remarks name other arrays.

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
        remarks.append(f"positions of the {count} elements are unknown: all count as standing at their receiver's")
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


def _load(file: Path) -> tuple[dict[str, np.ndarray], list[str]]:
    """The arrays by name, read to the end where zipfile compares checksums, and the names of ignored arrays."""
    arrays, place = {}, ""
    try:
        # Opened here, since numpy leaves a damaged file open; it warns of headers written by Python 2.
        with file.open("rb") as stream, warnings.catch_warnings(action="ignore"):
            content = np.load(stream, allow_pickle=False)
            if not isinstance(content, np.lib.npyio.NpzFile):
                raise ValueError(f"a single array of shape {content.shape}")
            members = [name.removesuffix(".npy") for name in content.zip.namelist()]
            for name, (kind, sizes) in ARRAYS.items():
                if name == "elements" and name not in members:
                    continue
                place = f"{name}: "
                if (count := members.count(name)) != 1:
                    shape = str(sizes).replace("'", "")
                    raise ValueError(f"expected one array of {kind} numbers of {shape}, got {count}")
                with content.zip.open(f"{name}.npy") as member:
                    arrays[name] = np.lib.format.read_array(member, allow_pickle=False)
                    if member.read(1):
                        raise ValueError(f"more numbers than its shape {arrays[name].shape} has")
    except Exception as error:  # damaged files make numpy and zipfile raise exceptions of many types
        expected = "an .npz file as numpy.savez writes it"
        raise ValueError(f"cannot parse {file}: {place}{error}; expected {expected}") from error
    return arrays, [name for name in members if name not in ARRAYS]


def _check_shapes(file: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Raises a ``ValueError`` for other kinds and shapes of arrays; the first array with a size fixes it."""
    known: dict[object, int] = {}
    kinds = {"real": "iuf", "whole": "iu", "complex": "c"}  # of numpy's data types
    for name, array in arrays.items():
        kind, letters = ARRAYS[name]
        if array.dtype.kind not in kinds[kind]:
            hint = "; join real and imaginary parts by re + 1j * im" if kind == "complex" else ""
            raise ValueError(f"{file}: {name}: expected {kind} numbers, got {array.dtype}{hint}")
        sizes = tuple(known.get(letter, letter) for letter in letters)
        fits = [isinstance(size, str) or size == got for size, got in zip(sizes, array.shape, strict=False)]
        if array.ndim != len(sizes) or not all(fits) or not array.size:
            hint = "; for one antenna add an axis, h[:, None, :]" if name == "h" and array.ndim == 2 else ""
            expected = str(sizes).replace("'", "")
            raise ValueError(f"{file}: {name}: expected the shape {expected}, got {array.shape}{hint}")
        known |= dict(zip(letters, array.shape, strict=True))


def _check_values(file: Path, arrays: dict[str, np.ndarray]) -> None:
    """Converts arrays to the types of the computation; a ``ValueError`` for a number out of range."""
    for name, array in arrays.items():
        with np.errstate(all="ignore"):  # numbers too large for a type become infinite, which fails below
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
                got = "NaN" if np.isnan(value) else f"{value}{unit_hint(value) if name == 'frequencies' else ''}"
                count = f"in {rows} of {len(array)} rows"
                raise ValueError(f"{file}: {name}{wrong[0].tolist()}: expected {rule}, got {got} ({count})")
    if len(np.unique(arrays["frequencies"])) < len(arrays["frequencies"]):
        raise ValueError(f"{file}: frequencies: expected different ones, got one twice; leave one subcarrier out")
    if not arrays["h"].any():
        raise ValueError(f"{file}: h: expected a channel that is not zero throughout, got none")
