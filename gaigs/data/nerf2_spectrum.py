"""Spatial spectra in the folder layout of NeRF²; docs/data.md describes the files."""

import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
import yaml
from jaxtyping import Float, Int
from PIL import Image
from scipy.spatial.transform import Rotation
from torch import Tensor

from gaigs.data import Grid, Links, Receiver
from gaigs.data._files import find_folder, read_lines, read_points, refuse
from gaigs.data.splits import split as split_links
from gaigs.geometry import Pose
from gaigs.registry import register

SHAPE = (90, 360)
"""Elevations 1..90 deg and azimuths 0..359 deg, fixed by the format."""

NORMALISATION = "min-max of each spectrum's amplitude"

PNG_COLOURS = {0: "grey", 2: "colour", 3: "palette", 4: "grey with alpha", 6: "colour with alpha"}
"""What the colour type in a PNG file's header means."""


@register("data", "nerf2_spectrum")
def read(root: str | Path, split: Mapping) -> Links:
    """A data set from its folder, which is only read.

    Everything but the pixels is checked here; images are decoded when their labels are first asked for.

    Args:
        root: Folder with ``tx_pos.csv``, ``gateway_info.yml``, ``spectrum/`` and, for the official split,
            ``train_index.txt`` and ``test_index.txt``.
        split: Options of ``gaigs.data.splits.split``.

    Raises:
        FileNotFoundError: There is no such folder.
        ValueError: Something is wrong with the files; the message lists the defects by file, line and value.

    Source: NeRF², https://github.com/XPengZhao/NeRF2.
    """
    root = find_folder(root)
    defects: list[str] = []
    positions = read_points(root / "tx_pos.csv", "xyz", "x,y,z [m] of one spectrum a line", defects)
    receiver = _read_receiver(root, defects)
    files = [root / "spectrum" / f"{k:05d}.png" for k in range(1, len(positions) + 1)]
    defects += _image_defects(root, files)
    official = None
    if split.get("protocol", "official") == "official":
        official = _read_official(root, len(files), defects)
    refuse(root, defects)
    transmitters = torch.tensor(positions)
    return Links(
        transmitters=transmitters,
        receivers=(receiver,),
        receiver_index=torch.zeros(len(files), dtype=torch.long),
        labels=Spectra(files),
        split=split_links(transmitters, official=official, **split),
        grid=Grid.degrees(),
        normalisation=NORMALISATION,
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

    The index files hold the split's training and validation links together, and its test links.

    Raises:
        FileExistsError: There is something in the folder.
        ValueError: There is more than one receiver, or the labels are not spectra on the format's grid.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise FileExistsError(f"{folder} must be an empty folder or none, and is not; choose another name")
    if len(links.receivers) != 1 or links.grid is None or links.grid.shape != SHAPE:
        raise ValueError(
            f"the layout holds spectra of {SHAPE[0]} x {SHAPE[1]} directions at one receiver, got "
            f"{links.grid and links.grid.shape} at {len(links.receivers)}"
        )
    (folder / "spectrum").mkdir(parents=True)
    for k in range(len(links.transmitters)):
        pixels = (links.labels[torch.tensor([k])][0] * 255).round().byte()
        Image.fromarray(pixels.numpy()).save(folder / "spectrum" / f"{k + 1:05d}.png")
    # Nine digits bring the same float32 back.
    rows = ["x,y,z", *(",".join(f"{value:.9g}" for value in row) for row in links.transmitters.tolist())]
    (folder / "tx_pos.csv").write_text("\n".join(rows) + "\n")
    receiver = links.receivers[0]
    quaternion = Rotation.from_matrix(receiver.pose.rotation.double().numpy()).as_quat()
    pose = {"position": receiver.pose.position.tolist(), "orientation": quaternion.tolist()}
    (folder / "gateway_info.yml").write_text(yaml.safe_dump({receiver.name: pose}, default_flow_style=None))
    split = links.split
    for name, part in (("train", torch.cat((split.train, split.validation))), ("test", split.test)):
        text = "".join(f"{k + 1:05d}\n" for k in part.tolist())
        (folder / f"{name}_index.txt").write_text(text)


def _read_receiver(root: Path, defects: list[str]) -> Receiver | None:
    file = "gateway_info.yml"
    lines = read_lines(root / file, "the gateway's position [m] and orientation (quaternion x, y, z, w)", defects)
    if not lines:
        return None
    try:
        content = yaml.safe_load("\n".join(lines))
    except yaml.YAMLError as error:
        defects.append(f"{file}: no YAML: {' '.join(str(error).split())}")
        return None
    content = content if isinstance(content, dict) else {}
    gateways = {name: value for name, value in content.items() if isinstance(value, dict)}
    if len(gateways) != 1:
        defects.append(f"{file}: expected one gateway with position and orientation, got {list(gateways) or 'none'}")
        return None
    name, gateway = gateways.popitem()
    vectors = []
    for key, length in (("position", 3), ("orientation", 4)):
        try:
            vector = [float(value) for value in gateway[key]]  # PyYAML takes 1e-3, without a point, for a string
        except (KeyError, TypeError, ValueError):
            vector = []
        if len(vector) != length:
            defects.append(f"{file}: {name}: {key} must be {length} numbers, got {gateway.get(key)}")
        vectors.append(vector)
    try:
        return Receiver(str(name), Pose.from_xyzw(*vectors)) if all(vectors) else None
    except ValueError as error:
        defects.append(f"{file}: {name}: {error}")
        return None


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
        with file.open("rb") as stream:
            head = stream.read(26)
        # Signature, then the first chunk: length, "IHDR", width, height, bits, colour type.
        if len(head) < 26 or head[:8] != b"\x89PNG\r\n\x1a\n" or head[12:16] != b"IHDR":
            yield f"{place}: no PNG file, begins with {head[:8]!r}"
            continue
        width, height, bits, colour = struct.unpack(">IIBB", head[16:])
        if (bits, colour) != (8, 0):
            yield f"{place}: expected 8-bit grey, got {bits}-bit {PNG_COLOURS.get(colour, colour)}"
        if (height, width) != SHAPE:
            yield f"{place}: expected {SHAPE[0]} x {SHAPE[1]} pixels, got {height} x {width}"


def _read_official(root: Path, count: int, defects: list[str]) -> tuple[Tensor, Tensor]:
    """Training and test links of the index files, from 0."""
    seen: dict[int, str] = {}
    parts = []
    for file in ("train_index.txt", "test_index.txt"):
        part = []
        for number, line in enumerate(read_lines(root / file, "one image number from 1 a line", defects), 1):
            place, text = f"{file}, line {number}", line.strip()
            if not (text.isascii() and text.isdecimal()):
                defects.append(f"{place}: expected one image number, got {line!r}")
            elif count and not 1 <= int(text) <= count:
                defects.append(f"{place}: expected an image number in 1..{count}, got {text}")
            elif int(text) in seen:
                defects.append(f"{place}: image {text} stands in {seen[int(text)]} already")
            else:
                seen[int(text)] = place
                part.append(int(text) - 1)
        parts.append(torch.tensor(part, dtype=torch.long))
    return parts[0], parts[1]


def _decode(file: Path) -> Tensor:
    try:
        with Image.open(file) as image:
            return torch.from_numpy(np.array(image))
    except (OSError, SyntaxError) as error:  # Pillow reports a broken chunk as a SyntaxError
        raise ValueError(f"{file} must be a whole PNG file, and is damaged ({error}); copy it again") from error
