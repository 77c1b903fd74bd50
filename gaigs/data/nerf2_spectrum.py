"""Spatial spectra in the folder layout of NeRF²; docs/data.md describes the files."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch
import yaml
from jaxtyping import Float
from PIL import Image
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation
from torch import Tensor

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Grid, Pose
from gaigs.core.query import CARRIERS, Query, check_carrier, unit_hint
from gaigs.core.task.spectrum import Spectrum
from gaigs.data import Links, Parts
from gaigs.io import tables
from gaigs.io.files import atomic_write, write_text
from gaigs.io.images import GreyImages
from gaigs.io.yaml import read_mapping, to_position, to_vector
from gaigs.registry import register

SHAPE = (90, 360)
"""Elevations 1..90 deg and azimuths 0..359 deg, fixed by the format."""


@register("data", "nerf2_spectrum", task="spectrum", split="official")
def read(
    root: str | Path,
    elements: Sequence[int] | None = (4, 4),
    frequency: float | None = 920e6,
    bandwidth: float | None = None,
) -> Links:
    """A data set of spectra from its folder.

    Images are decoded on request; all other files are checked here. If each link has its own
    carrier, the links of one position share a row.

    Args:
        root: Folder with ``tx_pos.csv``, ``gateway_info.yml``, ``spectrum/``, for the official
            split ``train_index.txt`` and ``test_index.txt``, and optionally ``freq.txt``, the
            carrier of each link.
        elements: Rows and columns of the receiver's planar array, with a pitch of half a wavelength
            of the highest carrier; None if unknown.
        frequency: Carrier of all links without ``freq.txt`` [Hz]; None if unknown. Without elements
            or carrier the array counts as a single antenna.
        bandwidth: Width of the band around each carrier over which powers were averaged [Hz]. 0: a
            single carrier; None: unknown.

    Raises:
        FileNotFoundError: The folder does not exist.
        ValueError: An option is out of range, or a file has a defect; the message names file, line
            and value.

    Source: NeRF², https://github.com/XPengZhao/NeRF2. Its spectra s23 were measured by a 4 x 4
    array at about 920 MHz.
    """
    if bandwidth is not None and not 0 <= bandwidth < math.inf:
        raise ValueError(
            f"bandwidth must be that of a band, 0 or more [Hz], or null, got {bandwidth}"
        )
    if frequency is not None:
        check_carrier("frequency", frequency)
    if elements is not None:
        _check_elements(elements)
    root = tables.find_folder(root)
    positions = tables.read_points(root / "tx_pos.csv", "xyz", "x,y,z [m] of one spectrum a line")
    receiver = _read_receiver(root / "gateway_info.yml")
    files = _find_images(root, len(positions))
    carriers = root / "freq.txt"
    has_own = tables.has_file(carriers)  # each link has its own carrier
    frequencies = None if frequency is None else torch.full((len(files),), float(frequency))
    remarks = []
    if has_own:
        frequencies = _read_frequencies(carriers, len(files))
        low, high = frequencies.min().item() / 1e6, frequencies.max().item() / 1e6
        remarks.append(
            f"{len(frequencies.unique())} carriers of {carriers.name}, {low:.6g} to {high:.6g} MHz"
        )
    array = Array.single()
    if elements is not None and frequencies is not None:
        wavelength = speed_of_light / frequencies.double().max().item()
        array = Array.planar(elements[0], elements[1], wavelength / 2)
    elif elements is not None:
        remarks.append(
            "the array counts as a single antenna, since without a frequency its extent is unknown"
        )
    grid = Grid.degrees()
    return Links(
        query=Query(torch.tensor(positions), torch.zeros(len(files)).long(), frequencies),
        receivers=(replace(receiver, array=array),),
        labels=GreyImages(files, SHAPE),
        task=Spectrum(grid.elevations, grid.azimuths),
        rows=tables.number_places(positions)[1] if has_own else None,
        official=partial(_read_official, root, len(files)),
        bandwidth=bandwidth,
        remarks="; ".join(remarks),
    )


def write(folder: str | Path, links: Links) -> None:
    """Writes a data set of spectra in the layout that ``read`` reads; labels are rounded to 8 bits.

    One index file holds the training and validation links, the other the test links. ``freq.txt``
    holds known carriers. The layout cannot store the array.
    """
    folder = Path(folder)
    tables.check_empty(folder)
    if len(links.receivers) != 1 or links.task.directions is None or links.task.shape != SHAPE:
        raise ValueError(
            f"the layout holds spectra of {SHAPE[0]} x {SHAPE[1]} directions at one receiver, got "
            f"labels of {links.task.name} {links.task.shape} at {len(links.receivers)}"
        )
    split, query = links.split, links.query
    if split is None:
        raise ValueError(
            "the layout's index files hold a split, got links without one; make them by "
            "gaigs.data.load"
        )
    (folder / "spectrum").mkdir(parents=True)
    for k in range(len(links)):
        pixels = (links.labels[torch.tensor([k])][0] * 255).round().byte()
        with atomic_write(folder / "spectrum" / f"{k + 1:05d}.png") as part:
            Image.fromarray(pixels.numpy()).save(part)
    # Nine digits give the same float32.
    rows = [f"{x:.9g},{y:.9g},{z:.9g}" for x, y, z in query.transmitters.tolist()]
    write_text(folder / "tx_pos.csv", "\n".join(["x,y,z", *rows]) + "\n")
    if query.frequencies is not None:
        carriers = [f"{value / 1e9:.9g}\n" for value in query.frequencies.tolist()]
        write_text(folder / "freq.txt", "".join(carriers))
    receiver = links.receivers[0]
    quaternion = Rotation.from_matrix(receiver.pose.rotation.double().numpy()).as_quat()
    pose = {"position": receiver.pose.position.tolist(), "orientation": quaternion.tolist()}
    text = yaml.safe_dump({receiver.name: pose}, default_flow_style=None)
    write_text(folder / "gateway_info.yml", text)
    for name, index in (("train", split.known), ("test", split.test)):
        write_text(folder / f"{name}_index.txt", "".join(f"{k + 1:05d}\n" for k in index.tolist()))


def _check_elements(elements: object) -> None:
    """Raises a ``ValueError`` unless elements are two positive whole numbers."""
    if isinstance(elements, Sequence) and len(elements) == 2:
        if all(isinstance(count, int) and count > 0 for count in elements):
            return
    raise ValueError(
        f"elements must be the array's rows and columns, such as [4, 4], or null, got {elements!r}"
    )


def _read_receiver(file: Path) -> Receiver:
    """The only gateway of a file, with a single antenna; a ``ValueError`` for another number."""
    expected = "one gateway with position [m] and orientation (quaternion x, y, z, w)"
    entries = read_mapping(file, expected).items()
    gateways = [(name, pose) for name, pose in entries if isinstance(pose, dict)]
    if len(gateways) != 1:
        names = ", ".join(name for name, _ in gateways) or "none"
        raise ValueError(f"{file}: expected {expected}, got {tables.quote(names)}")
    name, pose = gateways[0]
    position = to_position(f"{file}: {name}: position", pose.get("position"))
    orientation = to_vector(f"{file}: {name}: orientation", pose.get("orientation"), "xyzw")
    try:
        return Receiver(name, Pose.from_xyzw(position, orientation))
    except ValueError as error:
        raise ValueError(f"{file}: {name}: {error}") from None


def _read_frequencies(file: Path, count: int) -> Float[Tensor, " n"]:
    """The carrier of each link [Hz]."""
    lines = tables.read_lines(file, "the carrier [GHz] of one spectrum a line")
    if len(lines) != count:
        raise ValueError(
            f"{file}: expected {count} lines, one for each row of tx_pos.csv, got {len(lines)}"
        )
    gigahertz = [tables.to_number(line) for line in lines]
    low, high = (bound / 1e9 for bound in CARRIERS)
    wrong = {}
    for number, (line, value) in enumerate(zip(lines, gigahertz, strict=True), 1):
        if not low <= value <= high:
            wrong[number] = f"{tables.described(line)}{unit_hint(value)}"
    tables.refuse(file, wrong, f"one carrier from {low:g} to {high:g} GHz")
    return (1e9 * torch.tensor(gigahertz, dtype=torch.float64)).float()


def _find_images(root: Path, count: int) -> list[Path]:
    """The image of each position; a ``ValueError`` if images are missing, repeated or too many."""
    folder = root / "spectrum"
    names = [f"{number:05d}.png" for number in range(1, count + 1)]
    images: dict[str, list[Path]] = {}
    for file in folder.glob("*"):
        if file.suffix.lower() == ".png":
            images.setdefault(file.with_suffix(".png").name, []).append(file)
    missing = [name for name in names if name not in images]
    surplus = [name for name in names if len(images.get(name, [])) > 1]
    for name in images.keys() - {*names}:
        if name.removesuffix(".png").isdecimal():
            surplus.append(name)
    if missing or surplus:
        raise ValueError(
            f"{folder}: expected an image of each of the {count} rows of tx_pos.csv, got "
            f"{len(missing)} too few and {len(surplus)} too many, the first "
            f"{(missing or sorted(surplus))[0]}"
        )
    return [images[name][0] for name in names]


def _read_official(root: Path, count: int) -> Parts:
    """Training and test links of the index files, from 0."""

    def parse(line: str) -> int | None:
        number = tables.to_index(line)
        return number - 1 if number is not None and 1 <= number <= count else None

    train, test = tables.read_parts(root, parse, f"one image number in 1..{count}")
    return torch.tensor(sorted(train)), torch.tensor(sorted(test))
