"""What is wrong with a folder of spectra is named with its file, line and value."""

import re

import numpy as np
import pytest
import torch
from PIL import Image

from gaigs.data import load


def read(folder):
    return load({"name": "nerf2_spectrum", "root": str(folder)}, {"name": "official"})


@pytest.fixture
def folder(spectrum_folder):
    return spectrum_folder


def replace(folder, file, old, new):
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new, 1))


def shorten(folder, file, keep):
    content = (folder / file).read_bytes()
    (folder / file).write_bytes(content[:keep])


def save(folder, k, array):
    Image.fromarray(array).save(folder / "spectrum" / f"{k:05d}.png")


def frequencies(folder, line, text):
    lines = ["2.4"] * 6
    lines[line - 1] = text
    (folder / "freq.txt").write_text("\n".join(lines) + "\n")


DEFECTS = {
    "position nan": (
        lambda f: replace(f, "tx_pos.csv", "2.5,-2,", "nan,-2,"),
        "tx_pos.csv, line 3, column x: expected a finite number, got 'nan'",
    ),
    "position inf": (
        lambda f: replace(f, "tx_pos.csv", ",-6,0.25", ",-6,-inf"),
        "tx_pos.csv, line 7, column z: expected a finite number, got '-inf'",
    ),
    "position word": (
        lambda f: replace(f, "tx_pos.csv", "-3,", "three,"),
        "tx_pos.csv, line 4, column y: expected a finite number, got 'three'",
    ),
    "position empty": (
        lambda f: replace(f, "tx_pos.csv", "-3,", ","),
        "tx_pos.csv, line 4, column y: expected a finite number, got ''",
    ),
    "line number without header": (
        lambda f: replace(f, "tx_pos.csv", "x,y,z\n1.5", "one"),
        "tx_pos.csv, line 1, column x: expected a finite number, got 'one'",
    ),
    "four columns": (
        lambda f: replace(f, "tx_pos.csv", "-2,0.25", "-2,0.25,7"),
        "tx_pos.csv, line 3: expected 3 columns x,y,z, got 4: '2.5,-2,0.25,7'",
    ),
    "other delimiter": (
        lambda f: (f / "tx_pos.csv").write_text((f / "tx_pos.csv").read_text().replace(",", ";")),
        "tx_pos.csv, line 2: expected 3 columns x,y,z, got 1: '1.5;-1;0.25'",
    ),
    "blank line between": (
        lambda f: replace(f, "tx_pos.csv", "3.5,", "\n3.5,"),
        "tx_pos.csv, line 4: expected 3 columns x,y,z, got 1: ''",
    ),
    "columns in another order": (
        lambda f: replace(f, "tx_pos.csv", "x,y,z", "y,x,z"),
        "tx_pos.csv, line 1, columns x, y, z: expected a finite number, got 'y', 'x', 'z'",
    ),
    "no positions": (lambda f: (f / "tx_pos.csv").unlink(), "tx_pos.csv: missing; expected x,y,z [m]"),
    "positions empty": (lambda f: (f / "tx_pos.csv").write_text("\n\n"), "tx_pos.csv: empty; expected x,y,z [m]"),
    "only a header": (lambda f: (f / "tx_pos.csv").write_text("x,y,z\n"), "tx_pos.csv: no positions below the header"),
    "positions binary": (lambda f: (f / "tx_pos.csv").write_bytes(b"\xff\xfe\x00"), "tx_pos.csv: unreadable"),
    "a row too few": (
        lambda f: replace(f, "tx_pos.csv", "6.5,-6,0.25\n", ""),
        "spectrum/00006.png: no row in tx_pos.csv, which has 5; 1 images have none",
    ),
    "no image": (
        lambda f: (f / "spectrum" / "00004.png").unlink(),
        "spectrum/00004.png: missing; row 4 of tx_pos.csv belongs to it",
    ),
    "wide image": (
        lambda f: save(f, 2, np.zeros((90, 361), np.uint8)),
        "spectrum/00002.png: expected 90 x 360 pixels, got 90 x 361",
    ),
    "image on its side": (
        lambda f: save(f, 2, np.zeros((360, 90), np.uint8)),
        "spectrum/00002.png: expected 90 x 360 pixels, got 360 x 90",
    ),
    "colour image": (
        lambda f: save(f, 2, np.zeros((90, 360, 3), np.uint8)),
        "spectrum/00002.png: expected 8-bit grey, which is Pillow's mode L, got mode RGB",
    ),
    "16-bit image": (
        lambda f: save(f, 2, np.zeros((90, 360), np.uint16)),
        "spectrum/00002.png: expected 8-bit grey, which is Pillow's mode L, got mode I;16",
    ),
    "no PNG": (
        lambda f: Image.new("L", (360, 90)).save(f / "spectrum" / "00002.png", format="jpeg"),
        "spectrum/00002.png: no readable PNG file (cannot identify image file",
    ),
    "empty image": (lambda f: shorten(f, "spectrum/00002.png", 0), "spectrum/00002.png: no readable PNG file"),
    "image cut in its header": (
        lambda f: shorten(f, "spectrum/00002.png", 20),
        "spectrum/00002.png: no readable PNG file",
    ),
    "image cut before its pixels": (
        lambda f: shorten(f, "spectrum/00002.png", 40),
        "spectrum/00002.png: no readable PNG file",
    ),
    "index beyond": (
        lambda f: replace(f, "test_index.txt", "00006", "00007"),
        "test_index.txt, line 1: expected an image number in 1..6, got 00007",
    ),
    "index from 0": (
        lambda f: replace(f, "train_index.txt", "00005", "00000"),
        "train_index.txt, line 1: expected an image number in 1..6, got 00000",
    ),
    "index negative": (
        lambda f: replace(f, "train_index.txt", "00005", "-1"),
        "train_index.txt, line 1: expected one image number, got '-1'",
    ),
    "index twice": (
        lambda f: replace(f, "train_index.txt", "00003", "1"),
        "train_index.txt, line 4: image 1 stands in train_index.txt, line 2 already",
    ),
    "index in both": (
        lambda f: replace(f, "test_index.txt", "00006", "00003"),
        "test_index.txt, line 1: image 00003 stands in train_index.txt, line 4 already",
    ),
    "several indices on one line": (
        lambda f: (f / "train_index.txt").write_text("1 2 3 5\n"),
        "train_index.txt, line 1: expected one image number, got '1 2 3 5'",
    ),
    "index a file name": (
        lambda f: replace(f, "train_index.txt", "00005", "00005.png"),
        "train_index.txt, line 1: expected one image number, got '00005.png'",
    ),
    "index blank between": (
        lambda f: replace(f, "train_index.txt", "00001\n", "\n"),
        "train_index.txt, line 2: expected one image number, got ''",
    ),
    "index empty": (lambda f: (f / "train_index.txt").write_text(""), "train_index.txt: empty; expected one image"),
    "no index": (lambda f: (f / "test_index.txt").unlink(), "test_index.txt: missing; expected one image number"),
    "frequency negative": (
        lambda f: frequencies(f, 3, "-2.4"),
        "freq.txt, line 3: expected one carrier from 1e-05 to 300 GHz, got '-2.4'",
    ),
    "frequency zero": (lambda f: frequencies(f, 1, "0"), "freq.txt, line 1: expected one carrier from 1e-05"),
    "frequency in vain": (
        lambda f: frequencies(f, 1, "1e-300"),
        "freq.txt, line 1: expected one carrier from 1e-05 to 300 GHz, got '1e-300'",
    ),
    "frequency in Hz": (
        lambda f: frequencies(f, 6, "2.4e9"),
        "line 6: expected one carrier from 1e-05 to 300 GHz, got '2.4e9'; in Hz?",
    ),
    "frequency in MHz": (
        lambda f: frequencies(f, 1, "920"),
        "freq.txt, line 1: expected one carrier from 1e-05 to 300 GHz, got '920'; in MHz?",
    ),
    "frequency just too high": (
        lambda f: frequencies(f, 1, "300.001"),
        "line 1: expected one carrier from 1e-05 to 300 GHz, got '300.001'; in MHz?",
    ),
    "frequency nan": (lambda f: frequencies(f, 2, "nan"), "freq.txt, line 2: expected one carrier from 1e-05"),
    "frequency infinite": (lambda f: frequencies(f, 2, "inf"), "freq.txt, line 2: expected one carrier from 1e-05"),
    "frequency with its unit": (
        lambda f: frequencies(f, 2, "2.4 GHz"),
        "line 2: expected one carrier from 1e-05 to 300 GHz, got '2.4 GHz'",
    ),
    "frequency blank between": (lambda f: frequencies(f, 2, ""), "freq.txt, line 2: expected one carrier"),
    "frequencies too few": (
        lambda f: (f / "freq.txt").write_text("2.4\n" * 5),
        "freq.txt: expected 6 lines, one for each row of tx_pos.csv, got 5",
    ),
    "frequencies empty": (lambda f: (f / "freq.txt").write_text("\n"), "freq.txt: empty; expected the carrier [GHz]"),
    "quaternion long": (
        lambda f: replace(f, "gateway_info.yml", "0.5]", "0.6]"),
        "gateway_info.yml, line 2: gateway1: a rotation quaternion must have length 1, got 1.05",
    ),
    "quaternion of three": (
        lambda f: replace(f, "gateway_info.yml", ", 0.5]", "]"),
        "gateway_info.yml, line 2: gateway1: orientation must be 4 finite numbers x, y, z, w, written as 1.5 or -2e-3, "
        "got '[0.5, -0.5, -0.5]'",
    ),
    "quaternion of words": (
        lambda f: replace(f, "gateway_info.yml", "-0.5", "half"),
        "orientation must be 4 finite numbers x, y, z, w, written as 1.5 or -2e-3, got '[0.5, half, -0.5, 0.5]'",
    ),
    "position infinite": (
        lambda f: replace(f, "gateway_info.yml", "5.0", ".inf"),
        "gateway_info.yml, line 2: gateway1: position must be 3 finite numbers x, y, z, written as 1.5 or -2e-3, "
        "got '[.inf,",
    ),
    "no orientation": (
        lambda f: replace(f, "gateway_info.yml", "orientation", "rotation"),
        "orientation must be 4 finite numbers x, y, z, w, written as 1.5 or -2e-3, got none",
    ),
    "no gateway": (
        lambda f: (f / "gateway_info.yml").write_text("dataset_name: room\n"),
        "gateway_info.yml: expected one gateway with position and orientation, got none",
    ),
    "two gateways": (
        lambda f: replace(f, "gateway_info.yml", "gateway1", "gateway2: {}\ngateway1"),
        "gateway_info.yml: expected one gateway with position and orientation, got gateway2, gateway1",
    ),
    "gateway no YAML": (
        lambda f: replace(f, "gateway_info.yml", "[5.0", "[[5.0"),
        "gateway_info.yml: no YAML: while parsing",
    ),
    "gateway empty": (lambda f: (f / "gateway_info.yml").write_text(""), "gateway_info.yml: empty; expected the"),
    "gateway missing": (lambda f: (f / "gateway_info.yml").unlink(), "gateway_info.yml: missing; expected the"),
}


@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_is_named_with_its_place(folder, name):
    damage, message = DEFECTS[name]
    damage(folder)
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        read(folder)
    assert str(folder) in str(caught.value)


def test_all_files_are_reported_at_once(folder):
    replace(folder, "tx_pos.csv", "-2,", "nan,")
    replace(folder, "gateway_info.yml", "0.5]", "0.6]")
    save(folder, 1, np.zeros((3, 5), np.uint8))
    frequencies(folder, 4, "-1")
    with pytest.raises(ValueError, match="has 4 defects") as caught:
        read(folder)
    lines = str(caught.value).splitlines()[1:]
    assert [line.split(":")[0].split(",")[0].strip() for line in lines] == [
        "tx_pos.csv",
        "gateway_info.yml",
        "spectrum/00001.png",
        "freq.txt",
    ]


def test_many_defects_are_cut_short(folder):
    (folder / "train_index.txt").write_text("0\n" * 12)
    (folder / "test_index.txt").write_text("7\n" * 6)
    with pytest.raises(ValueError, match="has 18 defects") as caught:
        read(folder)
    lines = str(caught.value).splitlines()
    assert len(lines) == 12
    assert lines[-1].strip() == "... and 8 more"


def test_a_line_of_nan_is_one_defect(folder):
    replace(folder, "tx_pos.csv", "2.5,-2,0.25", "nan,nan,nan")
    message = r"has 1 defect:\n  tx_pos.csv, line 3, columns x, y, z: expected .* got 'nan', 'nan', 'nan'$"
    with pytest.raises(ValueError, match=message):
        read(folder)


def test_a_missing_folder_is_no_file(folder):
    with pytest.raises(FileNotFoundError, match="elsewhere must be the folder of a data set"):
        read(folder / "elsewhere")


@pytest.mark.parametrize("keep", [60, 200, 5000, 32000])
def test_a_truncated_image_is_named_when_decoded(folder, keep):
    shorten(folder, "spectrum/00002.png", keep)
    labels = read(folder).labels
    labels[torch.tensor([0])]
    with pytest.raises(ValueError, match=r"00002\.png must be a whole PNG file, and is damaged .*; copy it again"):
        labels[torch.tensor([0, 1])]


@pytest.mark.parametrize("place", [45, 100, 20000])
def test_a_damaged_image_is_named_when_decoded(folder, place):
    file = folder / "spectrum" / "00002.png"
    content = bytearray(file.read_bytes())
    content[place] ^= 0xFF
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"00002\.png must be a whole PNG file"):
        read(folder).labels[torch.tensor([1])]
