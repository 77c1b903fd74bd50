"""Spatial spectra in the folder layout of NeRF²; docs/data.md describes the files."""

import math
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
import yaml
from jaxtyping import Float, Int
from PIL import Image
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation
from torch import Tensor

from gaigs.data import Links, Parts
from gaigs.directions import Grid
from gaigs.geometry import Pose
from gaigs.io.files import atomic_write, write_text
from gaigs.io.tables import (
    find_folder,
    has_file,
    number_places,
    read_lines,
    read_points,
    refuse,
    to_index,
    to_number,
)
from gaigs.io.yaml import read_mapping, to_entries, to_position, to_vector
from gaigs.query import CARRIERS, Query, check_carrier, unit_hint
from gaigs.registry import register
from gaigs.scene import Array, Receiver
from gaigs.task.spectrum import Spectrum

SHAPE = (90, 360)
"""Elevations 1..90 deg and azimuths 0..359 deg, fixed by the format."""

NORMALISATION = "min-max of each spectrum's amplitude"

FREQUENCIES = "freq.txt"
"""Carrier of each link [GHz]; most folders have none."""


@register("data", "nerf2_spectrum")
def read(
    root: str | Path,
    elements: Sequence[int] | None = (4, 4),
    frequency: float | None = 920e6,
    bandwidth: float | None = None,
) -> Links:
    """A data set from its folder, which is only read.

    Everything but the pixels is checked here; images are decoded when their labels are first asked for. Where links
    have carriers of their own, those of one position share a row.

    Args:
        root: Folder with ``tx_pos.csv``, ``gateway_info.yml``, ``spectrum/``, for the official split
            ``train_index.txt`` and ``test_index.txt``, and where links have carriers of their own ``freq.txt``.
        elements: Rows and columns of the receiver's planar array, half a wavelength of the highest carrier apart; None
            where they are unknown.
        frequency: Carrier of all links where there is no ``freq.txt`` [Hz]; None where it is unknown, and with it how
            far apart the elements stand. What is unknown of the array counts as a single antenna.
        bandwidth: Of the band around each carrier that powers were averaged over, 0 for a carrier alone [Hz]; None
            where it is unknown.

    Raises:
        FileNotFoundError: There is no such folder.
        ValueError: An option is out of range, or something is wrong with the files; the message lists the defects by
            file, line and value.

    Source: NeRF², https://github.com/XPengZhao/NeRF2; its spectra s23 are of a 4 x 4 array at about 920 MHz.
    """
    _check_options(elements, frequency, bandwidth)
    root = find_folder(root)
    defects: list[str] = []
    positions = read_points(root / "tx_pos.csv", "xyz", "x,y,z [m] of one spectrum a line", defects)
    receiver = _read_receiver(root, defects)
    files = [root / "spectrum" / f"{k:05d}.png" for k in range(1, len(positions) + 1)]
    defects += _image_defects(root, files)
    frequencies = None if frequency is None else torch.full((len(files),), float(frequency))
    has_own = has_file(root / FREQUENCIES)
    if has_own:
        frequencies = _read_frequencies(root, len(files), defects)
    refuse(root, defects)
    grid = Grid.degrees()
    remarks = []
    if has_own:
        low, high = (frequencies.min().item() / 1e6, frequencies.max().item() / 1e6)
        remarks.append(f"{len(frequencies.unique())} carriers of {FREQUENCIES}, {low:.6g} to {high:.6g} MHz")
    array = Array.single()
    if elements is not None and frequencies is not None:
        array = Array.planar(*elements, speed_of_light / frequencies.double().max().item() / 2)
    elif elements is not None:
        remarks.append("the array counts as a single antenna, since without a frequency its extent is unknown")
    return Links(
        query=Query(torch.tensor(positions), torch.zeros(len(files), dtype=torch.long), frequencies),
        receivers=(replace(receiver, array=array),),
        labels=Spectra(files),
        task=Spectrum(grid.elevations, grid.azimuths, NORMALISATION),
        rows=number_places(positions)[1] if has_own else None,
        official=partial(_read_official, root, len(files)),
        bandwidth=bandwidth,
        remarks="; ".join(remarks),
    )


class Spectra:
    """Labels that are decoded when first asked for, and then kept at one byte a pixel.

    Args:
        files: An 8-bit grey PNG of 90 x 360 pixels for each link.
    """

    def __init__(self, files: Sequence[Path]):
        self.files = files
        self._pixels = torch.empty(len(files), *SHAPE, dtype=torch.uint8)
        self._decoded = torch.zeros(len(files), dtype=torch.bool)

    def __len__(self) -> int:
        return len(self.files)

    def __getitem__(self, indices: Int[Tensor, "k"]) -> Float[Tensor, "k 90 360"]:
        """Spectra in [0, 1], float32.

        Raises:
            ValueError: A file cannot be decoded.
        """
        for k in indices[~self._decoded[indices]].tolist():
            self._pixels[k] = _decode(self.files[k])
            self._decoded[k] = True
        return self._pixels[indices].float() / 255


def write(folder: str | Path, links: Links) -> None:
    """Writes a data set of spectra in the layout that ``read`` reads; labels are rounded to 8 bits.

    The index files hold the split's training and validation links together, and its test links. ``freq.txt`` holds the
    carriers where they are known; the layout has no place for the array.

    Raises:
        FileExistsError: There is something in the folder.
        OSError: A file cannot be written, e.g. as the disk is full.
        ValueError: There is more than one receiver, the labels are not spectra on the format's grid, or there is no
            split.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder} must be an empty folder or none, and is not; choose another name")
    if len(links.receivers) != 1 or not isinstance(links.task, Spectrum) or links.task.shape != SHAPE:
        raise ValueError(
            f"the layout holds spectra of {SHAPE[0]} x {SHAPE[1]} directions at one receiver, got labels of "
            f"{links.task.name} {links.task.shape} at {len(links.receivers)}"
        )
    split = links.split
    if split is None:
        raise ValueError("the layout's index files hold a split, got links without one; make them by gaigs.data.load")
    (folder / "spectrum").mkdir(parents=True)
    for k in range(len(links)):
        pixels = (links.labels[torch.tensor([k])][0] * 255).round().byte()
        with atomic_write(folder / "spectrum" / f"{k + 1:05d}.png") as part:
            Image.fromarray(pixels.numpy()).save(part)
    # Nine digits bring the same float32 back.
    rows = ["x,y,z", *(",".join(f"{value:.9g}" for value in row) for row in links.query.transmitters.tolist())]
    write_text(folder / "tx_pos.csv", "\n".join(rows) + "\n")
    frequencies = links.query.frequencies
    if frequencies is not None:
        write_text(folder / FREQUENCIES, "".join(f"{value / 1e9:.9g}\n" for value in frequencies.tolist()))
    receiver = links.receivers[0]
    quaternion = Rotation.from_matrix(receiver.pose.rotation.double().numpy()).as_quat()
    pose = {"position": receiver.pose.position.tolist(), "orientation": quaternion.tolist()}
    write_text(folder / "gateway_info.yml", yaml.safe_dump({receiver.name: pose}, default_flow_style=None))
    for name, part in (("train", torch.cat((split.train, split.validation))), ("test", split.test)):
        text = "".join(f"{k + 1:05d}\n" for k in part.tolist())
        write_text(folder / f"{name}_index.txt", text)


def _check_options(elements: Sequence[int] | None, frequency: float | None, bandwidth: float | None) -> None:
    if bandwidth is not None and not 0 <= bandwidth < math.inf:
        raise ValueError(f"bandwidth must be that of a band, 0 or more [Hz], or null, got {bandwidth}")
    if frequency is not None:
        check_carrier("frequency", frequency)
    is_pair = isinstance(elements, Sequence) and len(elements) == 2
    if elements is not None and not (is_pair and all(isinstance(count, int) and count > 0 for count in elements)):
        raise ValueError(f"elements must be the array's rows and columns, such as [4, 4], or null, got {elements!r}")


def _read_receiver(root: Path, defects: list[str]) -> Receiver | None:
    file = root / "gateway_info.yml"
    expected = "the gateway's position [m] and orientation (quaternion x, y, z, w)"
    content = read_mapping(file, expected, defects)
    gateways = {name: entry for name, entry in content.items() if entry.is_mapping}
    if content and len(gateways) != 1:
        got = ", ".join(gateways) or "none"
        defects.append(f"{file.name}: expected one gateway with position and orientation, got {got}")
    if len(gateways) != 1:
        return None
    ((name, gateway),) = gateways.items()
    place = f"{file.name}, line {gateway.line}: {name}"
    before, pose = len(defects), to_entries(file.name, gateway.node, defects)
    position = to_position(place, pose.get("position"), defects)
    orientation = to_vector(f"{place}: orientation", pose.get("orientation"), "xyzw", defects)
    if len(defects) > before:
        return None
    try:
        return Receiver(name, Pose.from_xyzw(position, orientation))
    except ValueError as error:
        defects.append(f"{place}: {error}")
        return None


def _read_frequencies(root: Path, count: int, defects: list[str]) -> Float[Tensor, "n"]:
    """The carrier of each link [Hz]."""
    lines = read_lines(root / FREQUENCIES, "the carrier [GHz] of one spectrum a line", defects)
    if lines and count and len(lines) != count:
        defects.append(f"{FREQUENCIES}: expected {count} lines, one for each row of tx_pos.csv, got {len(lines)}")
    gigahertz = [to_number(line) for line in lines]
    low, high = (bound / 1e9 for bound in CARRIERS)
    for number, value in enumerate(gigahertz, 1):
        if not low <= value <= high:
            expected = f"one carrier from {low:g} to {high:g} GHz"
            got = f"{lines[number - 1]!r}{unit_hint(value)}"
            defects.append(f"{FREQUENCIES}, line {number}: expected {expected}, got {got}")
    return (1e9 * torch.tensor(gigahertz, dtype=torch.float64)).float()


def _image_defects(root: Path, files: list[Path]) -> Iterator[str]:
    if not files:
        return
    expected = {file.name for file in files}
    found = {file.name for file in (root / "spectrum").glob("*.png")}
    surplus = sorted(name for name in found - expected if name.removesuffix(".png").isdecimal())
    if surplus:
        yield f"spectrum/{surplus[0]}: no row in tx_pos.csv, which has {len(files)}; {len(surplus)} images have none"
    for number, file in enumerate(files, 1):
        place = f"spectrum/{file.name}"
        if file.name not in found:
            yield f"{place}: missing; row {number} of tx_pos.csv belongs to it"
            continue
        try:
            with _opened(file) as image:  # reads the header, decodes nothing
                mode, (width, height) = image.mode, image.size
        except ValueError as error:
            yield f"{place}: no readable PNG file ({error})"
            continue
        if mode != "L":
            yield f"{place}: expected 8-bit grey, which is Pillow's mode L, got mode {mode}"
        if (height, width) != SHAPE:
            yield f"{place}: expected {SHAPE[0]} x {SHAPE[1]} pixels, got {height} x {width}"


def _read_official(root: Path, count: int) -> Parts:
    """Training and test links of the index files, from 0.

    Raises:
        ValueError: Something is wrong with the files; the message lists the defects by file, line and value.
    """
    defects: list[str] = []
    seen: dict[int, str] = {}
    parts = []
    for file in ("train_index.txt", "test_index.txt"):
        part = []
        for number, line in enumerate(read_lines(root / file, "one image number from 1 a line", defects), 1):
            place, text = f"{file}, line {number}", line.strip()
            image = to_index(text)
            if image is None:
                defects.append(f"{place}: expected one image number, got {line!r}")
            elif not 1 <= image <= count:
                defects.append(f"{place}: expected an image number in 1..{count}, got {text}")
            elif image in seen:
                defects.append(f"{place}: image {text} stands in {seen[image]} already")
            else:
                seen[image] = place
                part.append(image - 1)
        parts.append(torch.tensor(sorted(part), dtype=torch.long))
    refuse(root, defects)
    return parts[0], parts[1]


def _decode(file: Path) -> Tensor:
    try:
        with _opened(file) as image:
            image.verify()  # compares the checksums, which decoding does not
        with _opened(file) as image:
            return torch.from_numpy(np.array(image))
    except ValueError as error:
        raise ValueError(f"{file} must be a whole PNG file, and is damaged ({error}); copy it again") from error


@contextmanager
def _opened(file: Path) -> Iterator[Image.Image]:
    """A PNG file whose header is read.

    Raises:
        ValueError: It cannot be read, or Pillow warns of it.
    """
    try:
        with warnings.catch_warnings(action="error"), Image.open(file, formats=["PNG"]) as image:
            yield image
    except Exception as error:  # whatever a damaged file makes Pillow raise
        raise ValueError(str(error)) from error
