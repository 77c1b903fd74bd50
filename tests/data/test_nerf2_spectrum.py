"""Reading and writing the NeRF² layout; folders are written here by hand with Pillow."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation
from skimage.io import imread
from skimage.metrics import structural_similarity

from gaigs.data import Grid, Links, Receiver
from gaigs.data.nerf2_spectrum import read, write
from gaigs.data.splits import split
from gaigs.geometry import Pose
from gaigs.registry import registry

OFFICIAL = {"protocol": "official", "validation": 0}
QUATERNION = [0.5, -0.5, -0.5, 0.5]


def image(k):
    return np.random.default_rng(k).integers(0, 256, (90, 360), dtype=np.uint8)


@pytest.fixture
def folder(tmp_path):
    """A whole data set of six spectra."""
    root = tmp_path / "room"
    (root / "spectrum").mkdir(parents=True)
    for k in range(1, 7):
        Image.fromarray(image(k)).save(root / "spectrum" / f"{k:05d}.png")
    (root / "tx_pos.csv").write_text("x,y,z\n" + "".join(f"{k}.5,{-k},0.25\n" for k in range(1, 7)))
    (root / "gateway_info.yml").write_text(
        f"dataset_name: room\ngateway1:\n  position: [5.0, 0.26, 0]\n  orientation: {QUATERNION}  # quaternion\n"
    )
    (root / "train_index.txt").write_text("00005\n00001\n00002\n00003\n")
    (root / "test_index.txt").write_text("00006\n00004\n")
    return root


def real(name):
    root = Path(os.environ.get("GAIGS_DATA", Path(__file__).parents[3] / "shared" / "data")) / name
    if not root.is_dir():
        pytest.skip(f"needs the measured data set {name}; set GAIGS_DATA to the folder that holds it")
    return root


def replace(folder, file, old, new):
    text = (folder / file).read_text()
    assert old in text
    (folder / file).write_text(text.replace(old, new, 1))


def test_everything_read_is_what_was_written(folder):
    links = read(folder, OFFICIAL)
    assert links.transmitters.dtype == torch.float32
    assert links.transmitters.tolist() == [[k + 0.5, -k, 0.25] for k in range(1, 7)]
    assert links.split.train.tolist() == [0, 1, 2, 4]
    assert links.split.test.tolist() == [3, 5]
    assert links.receiver_index.tolist() == [0] * 6
    (receiver,) = links.receivers
    assert receiver.name == "gateway1"
    assert receiver.pose.position.tolist() == pytest.approx([5, 0.26, 0])
    np.testing.assert_allclose(receiver.pose.rotation, Rotation.from_quat(QUATERNION).as_matrix(), atol=1e-6)
    assert links.grid.shape == (90, 360)
    assert torch.rad2deg(links.grid.elevations)[[0, -1]].tolist() == pytest.approx([1, 90])
    assert torch.rad2deg(links.grid.azimuths)[[0, -1]].tolist() == pytest.approx([0, 359])
    assert len(links.labels) == 6
    labels = links.labels[torch.tensor([4, 0, 4])]
    assert labels.dtype == torch.float32
    np.testing.assert_allclose(labels, np.stack([image(5), image(1), image(5)]) / 255, atol=1e-7)
    assert links.labels[torch.tensor([], dtype=torch.long)].shape == (0, 90, 360)


def test_reading_leaves_the_folder_as_it_is(folder):
    state = lambda: {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in folder.rglob("*") if p.is_file()}
    before = state()
    links = read(folder, {"protocol": "random"})
    links.labels[torch.arange(6)]
    assert state() == before


def test_an_image_is_decoded_once_and_when_asked(folder):
    labels = read(folder, OFFICIAL).labels
    first = labels[torch.tensor([0, 2])]
    for file in (folder / "spectrum").iterdir():
        file.unlink()
    assert torch.equal(labels[torch.tensor([2, 0])], first.flip(0))
    with pytest.raises(ValueError, match=r"00002\.png must be a whole PNG file"):
        labels[torch.tensor([0, 1])]


def test_the_registry_builds_it(folder):
    links = registry("data").build({"name": "nerf2_spectrum", "root": str(folder), "split": OFFICIAL})
    assert links.split.name == "official"
    with pytest.raises(ValueError, match=r"has no option 'rot' \(did you mean 'root'\?\)"):
        registry("data").build({"name": "nerf2_spectrum", "rot": str(folder), "split": OFFICIAL})


def test_no_header_blank_ends_windows_lines_and_byte_order_marks_are_fine(folder):
    plain = read(folder, OFFICIAL)
    text = (folder / "tx_pos.csv").read_text().removeprefix("x,y,z\n")
    (folder / "tx_pos.csv").write_text("\ufeff" + text.replace("\n", "\r\n").replace(",", " , ") + "\n\n \n")
    (folder / "train_index.txt").write_text("5\r\n 1\r\n2 \r\n3\r\n\r\n\r\n")
    again = read(folder, OFFICIAL)
    assert torch.equal(again.transmitters, plain.transmitters)
    assert torch.equal(again.split.train, plain.split.train)


def test_an_index_file_of_one_line_is_one_link(folder):
    (folder / "test_index.txt").write_text("00004")
    assert read(folder, OFFICIAL).split.test.tolist() == [3]


def test_index_files_are_needed_for_the_official_split_only(folder):
    (folder / "train_index.txt").unlink()
    (folder / "test_index.txt").write_text("7\n")
    assert len(read(folder, {"protocol": "runs", "length": 2, "validation": 0}).split.train) == 4


def test_small_numbers_in_yaml_are_numbers(folder):
    replace(folder, "gateway_info.yml", "0.26, 0]", "1e-3, 0]")  # a string to PyYAML
    assert read(folder, OFFICIAL).receivers[0].pose.position[1].item() == pytest.approx(1e-3)


def shorten(folder, file, keep):
    content = (folder / file).read_bytes()
    (folder / file).write_bytes(content[:keep])


def save(folder, k, array):
    Image.fromarray(array).save(folder / "spectrum" / f"{k:05d}.png")


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
        "spectrum/00002.png: expected 8-bit grey, got 8-bit colour",
    ),
    "16-bit image": (
        lambda f: save(f, 2, np.zeros((90, 360), np.uint16)),
        "spectrum/00002.png: expected 8-bit grey, got 16-bit grey",
    ),
    "no PNG": (
        lambda f: Image.fromarray(image(2)).save(f / "spectrum" / "00002.png", format="jpeg"),
        "spectrum/00002.png: no PNG file, begins with b'\\xff\\xd8\\xff\\xe0",
    ),
    "empty image": (lambda f: shorten(f, "spectrum/00002.png", 0), "spectrum/00002.png: no PNG file, begins with b''"),
    "image cut in its header": (lambda f: shorten(f, "spectrum/00002.png", 20), "spectrum/00002.png: no PNG file"),
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
    "quaternion long": (
        lambda f: replace(f, "gateway_info.yml", "0.5]", "0.6]"),
        "gateway_info.yml: gateway1: a rotation quaternion must have length 1, got 1.05",
    ),
    "quaternion of three": (
        lambda f: replace(f, "gateway_info.yml", ", 0.5]", "]"),
        "gateway_info.yml: gateway1: orientation must be 4 numbers, got [0.5, -0.5, -0.5]",
    ),
    "quaternion of words": (
        lambda f: replace(f, "gateway_info.yml", "-0.5", "half"),
        "gateway_info.yml: gateway1: orientation must be 4 numbers, got [0.5, 'half', -0.5, 0.5]",
    ),
    "position infinite": (
        lambda f: replace(f, "gateway_info.yml", "5.0", ".inf"),
        "gateway_info.yml: gateway1: a pose must be finite, got position [inf,",
    ),
    "no orientation": (
        lambda f: replace(f, "gateway_info.yml", "orientation", "rotation"),
        "gateway_info.yml: gateway1: orientation must be 4 numbers, got None",
    ),
    "no gateway": (
        lambda f: (f / "gateway_info.yml").write_text("dataset_name: room\n"),
        "gateway_info.yml: expected one gateway with position and orientation, got none",
    ),
    "two gateways": (
        lambda f: replace(f, "gateway_info.yml", "gateway1", "gateway2: {}\ngateway1"),
        "gateway_info.yml: expected one gateway with position and orientation, got ['gateway2', 'gateway1']",
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
        read(folder, OFFICIAL)
    assert str(folder) in str(caught.value)


def test_all_files_are_reported_at_once(folder):
    replace(folder, "tx_pos.csv", "-2,", "nan,")
    replace(folder, "gateway_info.yml", "0.5]", "0.6]")
    replace(folder, "test_index.txt", "00006", "9")
    save(folder, 1, np.zeros((3, 5), np.uint8))
    with pytest.raises(ValueError, match="has 4 defects") as caught:
        read(folder, OFFICIAL)
    lines = str(caught.value).splitlines()[1:]
    assert [line.split(":")[0].split(",")[0].strip() for line in lines] == [
        "tx_pos.csv",
        "gateway_info.yml",
        "spectrum/00001.png",
        "test_index.txt",
    ]


def test_many_defects_are_cut_short(folder):
    (folder / "tx_pos.csv").write_text("nan,nan,nan\n" * 6)
    (folder / "train_index.txt").write_text("0\n" * 12)
    with pytest.raises(ValueError, match="has 18 defects") as caught:
        read(folder, OFFICIAL)
    lines = str(caught.value).splitlines()
    assert len(lines) == 12
    assert lines[-1].strip() == "... and 8 more"


def test_a_line_of_nan_is_one_defect(folder):
    replace(folder, "tx_pos.csv", "2.5,-2,0.25", "nan,nan,nan")
    message = r"has 1 defect:\n  tx_pos.csv, line 3, columns x, y, z: expected .* got 'nan', 'nan', 'nan'$"
    with pytest.raises(ValueError, match=message):
        read(folder, OFFICIAL)


def test_a_missing_folder_is_no_file(folder):
    with pytest.raises(FileNotFoundError, match="elsewhere must be the folder of a data set"):
        read(folder / "elsewhere", OFFICIAL)


@pytest.mark.parametrize("keep", [40, 60, 200, 5000, 32000])
def test_a_truncated_image_is_named_when_decoded(folder, keep):
    shorten(folder, "spectrum/00002.png", keep)
    labels = read(folder, OFFICIAL).labels
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
        read(folder, OFFICIAL).labels[torch.tensor([1])]


@pytest.fixture
def links():
    generator = torch.Generator().manual_seed(2)
    transmitters = 4 * torch.rand(5, 3, generator=generator) - 2
    pose = Pose.from_xyzw((1.25, -3, 1e-6), Rotation.from_euler("xyz", (0.3, -1.2, 2.5)).as_quat())
    return Links(
        transmitters=transmitters,
        receivers=(Receiver("north", pose),),
        receiver_index=torch.zeros(5, dtype=torch.long),
        labels=torch.rand(5, 90, 360, generator=generator),
        split=split(transmitters, "random", test=0.4, validation=0.4),
        grid=Grid.degrees(),
        normalisation="none",
    )


def test_what_is_written_reads_back(links, tmp_path):
    write(tmp_path / "new" / "room", links)
    again = read(tmp_path / "new" / "room", OFFICIAL)
    assert torch.equal(again.transmitters, links.transmitters)
    assert (again.labels[torch.arange(5)] - links.labels).abs().max() <= 0.5 / 255 + 1e-6
    assert again.receivers[0].name == "north"
    torch.testing.assert_close(again.receivers[0].pose.position, links.receivers[0].pose.position)
    torch.testing.assert_close(again.receivers[0].pose.rotation, links.receivers[0].pose.rotation)
    training = torch.cat((links.split.train, links.split.validation)).sort().values
    assert torch.equal(again.split.train, training)
    assert torch.equal(again.split.test, links.split.test)


def test_nothing_is_overwritten(links, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for place in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises(FileExistsError, match="must be an empty folder or none"):
            write(place, links)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_other_grids_are_not_written(links, tmp_path):
    coarse = Links(**{**vars(links), "grid": Grid.degrees(range(1, 10)), "labels": links.labels[:, :9]})
    with pytest.raises(ValueError, match=r"90 x 360 directions at one receiver, got \(9, 360\) at 1"):
        write(tmp_path / "room", coarse)
    assert not (tmp_path / "room").exists()


def test_measured_sample_scores_as_published():
    """The mean training spectrum and the three nearest ones score 0.67 and 0.974 on the published split."""
    root = real("rfid-s23-200")
    links = read(root, OFFICIAL)
    train, test = links.split.train, links.split.test
    assert (len(train), len(test)) == (160, 40)
    assert {len(links.transmitters), len(links.labels)} == {200}
    np.testing.assert_array_equal(links.labels[torch.tensor([6])][0] * 255, imread(root / "spectrum" / "00007.png"))
    labels, known = links.labels[test], links.labels[train]
    distances, nearest = torch.cdist(links.transmitters[test], links.transmitters[train]).topk(3, largest=False)
    weights = 1 / distances
    guesses = torch.einsum("bk,bkij->bij", weights / weights.sum(1, keepdim=True), known[nearest])
    score = lambda predictions: np.median(
        [structural_similarity(a.numpy(), b.numpy(), data_range=1) for a, b in zip(labels, predictions, strict=True)]
    )
    assert score(known.mean(0).expand(40, -1, -1)) == pytest.approx(0.67, abs=0.01)
    assert score(guesses) == pytest.approx(0.974, abs=0.002)


def test_measured_data_set_has_the_published_split():
    links = read(real("rfid-s23"), OFFICIAL)
    assert (len(links.split.train), len(links.split.test)) == (4898, 1225)
