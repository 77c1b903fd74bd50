"""Files that cannot be read, and numbers that Python reads and people do not write."""

import os
import re
import zlib

import numpy as np
import pytest
import torch
from PIL import Image

from gaigs.data import csi_npz, nerf2_rssi, nerf2_spectrum, rssi_csv
from gaigs.io.tables import LONGEST, refuse

READERS = {"rssi": nerf2_rssi.read, "spectrum": nerf2_spectrum.read}

STATES = {
    "link to nothing": lambda file: file.symlink_to("elsewhere"),
    "link to itself": lambda file: file.symlink_to(file),
    "folder": lambda file: file.mkdir(),
    "pipe": os.mkfifo,
}


@pytest.mark.parametrize("state", STATES)
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        ("rssi", "layout.csv"),
        ("rssi", "gateway_position.yml"),
        ("rssi", "tx_pos.csv"),
        ("spectrum", "freq.txt"),
        ("spectrum", "gateway_info.yml"),
    ],
)
def test_a_file_that_is_there_and_cannot_be_read_is_named(request, kind, name, state):
    folder = request.getfixturevalue(f"{kind}_folder")
    (folder / name).unlink(missing_ok=True)
    STATES[state](folder / name)
    with pytest.raises(ValueError, match=f"{name}: no file, but a folder, a device or a link to nothing; expected"):
        READERS[kind](folder)


@pytest.mark.parametrize("kind", READERS)
@pytest.mark.parametrize("root", ["x" * 300, "~nobody-of-this-name/room", "a\0b"])
def test_a_path_that_can_be_none_is_no_folder_and_no_file(kind, root):
    with pytest.raises(FileNotFoundError, match="must be the folder of a data set, and is none"):
        READERS[kind](root)
    for read in (rssi_csv.read, csi_npz.read):
        with pytest.raises(FileNotFoundError, match="and is no file; set the data's file"):
            read(root)


@pytest.mark.parametrize("kind", READERS)
@pytest.mark.parametrize("number", ["9" * 5000, "9" * 19, str(2**64)])
def test_an_index_of_any_length_is_beyond_the_last(request, kind, number):
    folder = request.getfixturevalue(f"{kind}_folder")
    (folder / "train_index.txt").write_text(f"{number}\n")
    with pytest.raises(ValueError, match=r"train_index\.txt, line 1: expected a.* in [01]\.\.\d, got 9|184") as caught:
        READERS[kind](folder).official()
    assert len(str(caught.value)) < 2 * LONGEST + len(str(folder))


@pytest.mark.parametrize("kind", READERS)
def test_an_index_may_have_many_zeros_in_front(request, kind):
    folder = request.getfixturevalue(f"{kind}_folder")
    (folder / "train_index.txt").write_text(f"{'0' * 5000}1\n")
    assert READERS[kind](folder).official()[0].tolist() == ([2, 3] if kind == "rssi" else [0])


@pytest.mark.parametrize("cell", ["1_0", "１", "0x1", "1d3", "1e", '"1"0', '"1" 0', "1 0", '"1'])
def test_a_cell_is_a_number_as_people_write_it(rssi_folder, cell):
    (rssi_folder / "layout.csv").write_text(f"0,0\n1,{cell}\n")
    with pytest.raises(ValueError, match=r"layout\.csv, line 2.*: expected .*, got "):
        nerf2_rssi.read(rssi_folder)


@pytest.mark.parametrize("cell", ["10", "+10.", "1e1", ".1E+2", '"10"', ' "10" ', "010"])
def test_a_number_may_be_written_in_many_ways(rssi_folder, cell):
    (rssi_folder / "layout.csv").write_text(f"0,0\n{cell},{cell}\n")
    assert nerf2_rssi.read(rssi_folder).edges[0, 1].tolist() == [10, 10, 0]


def test_defects_are_cut_short_and_visible(tmp_path):
    with pytest.raises(ValueError, match=re.escape("a\\x1b[31m\\u202eb")) as caught:
        refuse(tmp_path, ["a\x1b[31m\u202eb", "é" + "9" * 5000])
    assert str(caught.value).endswith("9 ...")
    assert "é9" in str(caught.value)
    assert len(str(caught.value)) < LONGEST + 200


@pytest.mark.parametrize("at", [0.2, 0.5, 0.8])
def test_a_byte_of_compressed_pixels_is_no_other_pixel(spectrum_folder, at):
    file = spectrum_folder / "spectrum" / "00002.png"
    pixels = np.add.outer(np.arange(90) ** 2, 3 * np.arange(360)) % 256
    Image.fromarray(pixels.astype(np.uint8)).save(file)
    content = bytearray(file.read_bytes())
    content[int(at * len(content))] ^= 0x10
    file.write_bytes(content)
    labels = nerf2_spectrum.read(spectrum_folder).labels
    with pytest.raises(ValueError, match=r"00002\.png must be a whole PNG file, and is damaged"):
        labels[torch.tensor([1])]


def test_a_header_of_a_vast_image_is_refused(spectrum_folder):
    file = spectrum_folder / "spectrum" / "00002.png"
    content = file.read_bytes()
    header = b"IHDR" + (10_000).to_bytes(4) + (10_000).to_bytes(4) + content[24:29]  # so many pixels that Pillow warns
    file.write_bytes(content[:12] + header + zlib.crc32(header).to_bytes(4) + content[33:])
    with pytest.raises(ValueError, match=r"spectrum/00002\.png: no readable PNG file \(Image size"):
        nerf2_spectrum.read(spectrum_folder)
