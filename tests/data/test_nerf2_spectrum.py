"""Reading and writing the NeRF² layout; the folder is written by hand with Pillow."""

import re
from dataclasses import replace as changed

import numpy as np
import pytest
import torch
from damages import replace
from PIL import Image
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation
from skimage.io import imread
from skimage.metrics import structural_similarity

from gaigs.antenna import Array, Receiver
from gaigs.data import Links, load, nerf2_spectrum
from gaigs.data.nerf2_spectrum import write
from gaigs.geometry import Grid, Pose
from gaigs.query import Query
from gaigs.split.random import random
from gaigs.task.rssi import Rssi
from gaigs.task.spectrum import Spectrum
from gaigs.testing import check_data

OFFICIAL = {"name": "official", "validation": 0}


def read(folder, split=OFFICIAL, **options):
    return load({"name": "nerf2_spectrum", "root": str(folder), **options}, split)


def pixels(k):
    """What the image of that number was drawn from."""
    return np.random.default_rng(k).integers(0, 256, (90, 360), dtype=np.uint8)


@pytest.fixture
def folder(spectrum_folder):
    return spectrum_folder


def test_everything_read_is_what_was_written(folder):
    links = read(folder)
    assert links.query.transmitters.dtype == torch.float32
    assert links.query.transmitters.tolist() == [[k + 0.5, -k, 0.25] for k in range(1, 7)]
    assert links.split.train.tolist() == [0, 1, 2, 4]
    assert links.split.test.tolist() == [3, 5]
    assert links.query.receivers.tolist() == [0] * 6
    (receiver,) = links.receivers
    assert receiver.name == "gateway1"
    assert receiver.pose.position.tolist() == pytest.approx([5, 0.26, 0])
    np.testing.assert_allclose(
        receiver.pose.rotation, Rotation.from_quat([0.5, -0.5, -0.5, 0.5]).as_matrix(), atol=1e-6
    )
    assert links.task.directions.shape == (90, 360)
    assert torch.rad2deg(links.task.directions.elevations)[[0, -1]].tolist() == pytest.approx([1, 90])
    assert torch.rad2deg(links.task.directions.azimuths)[[0, -1]].tolist() == pytest.approx([0, 359])
    assert len(links.labels) == 6
    labels = links.labels[torch.tensor([4, 0, 4])]
    assert labels.dtype == torch.float32
    np.testing.assert_allclose(labels, np.stack([pixels(5), pixels(1), pixels(5)]) / 255, atol=1e-7)
    assert links.labels[torch.tensor([], dtype=torch.long)].shape == (0, 90, 360)
    check_data(links)


def test_reading_leaves_the_folder_as_it_is(folder):
    state = lambda: {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in folder.rglob("*") if p.is_file()}
    before = state()
    links = read(folder, {"name": "random"})
    links.labels[torch.arange(6)]
    assert state() == before


def test_index_files_are_read_for_the_official_split_only(folder):
    (folder / "train_index.txt").unlink()
    (folder / "test_index.txt").write_text("7\n")
    assert len(read(folder, {"name": "runs", "length": 2, "validation": 0}).split.train) == 4
    with pytest.raises(ValueError, match=r"train_index\.txt: missing; expected one image number in 1\.\.6"):
        read(folder)


# --- array and carriers ---


def test_the_array_is_that_of_the_published_set_unless_told(folder):
    links = read(folder)
    (receiver,) = links.receivers
    steps = sorted({round(value, 6) for value in receiver.array.elements.flatten().tolist()} - {0})
    half = speed_of_light / 920e6 / 2
    assert half == pytest.approx(0.163, abs=1e-3)
    assert steps == pytest.approx([step * half for step in (-1.5, -0.5, 0.5, 1.5)], abs=1e-6)
    assert (len(receiver.array), receiver.array.pattern) == (16, "isotropic")
    assert links.query.frequencies.tolist() == [920e6] * 6
    assert links.remarks == ""


def test_the_array_is_as_told(folder):
    array = read(folder, elements=[2, 3], frequency=3e9).receivers[0].array
    assert len(array) == 6
    extents = array.elements.amax(0) - array.elements.amin(0)
    assert (extents / (speed_of_light / 3e9 / 2)).tolist() == pytest.approx([2, 1, 0])  # columns along x, rows along y


def test_what_is_unknown_of_array_and_carrier_is_left_open(folder):
    links = read(folder, elements=None)
    assert torch.equal(links.receivers[0].array.elements, Array.single().elements)
    assert links.query.frequencies.tolist() == [920e6] * 6
    links = read(folder, frequency=None)
    assert links.query.frequencies is None
    assert torch.equal(links.receivers[0].array.elements, Array.single().elements)
    assert "the array counts as a single antenna" in links.remarks
    assert read(folder, elements=None, frequency=None).remarks == ""


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"elements": [4]}, r"elements must be the array's rows and columns, such as \[4, 4\], or null, got \[4\]"),
        ({"elements": [4, 0]}, "elements must be the array's rows and columns"),
        ({"bandwidth": -1.0}, "bandwidth must be that of a band, 0 or more .*, got -1"),
        ({"frequency": 0.0}, r"frequency must be a carrier in Hz, from 10000 to 3e\+11, got 0$"),
        ({"frequency": 1e-300}, "frequency must be a carrier in Hz, .* got 1e-300$"),
        ({"frequency": 920}, r"got 920; in MHz\?$"),
        ({"frequency": 0.92}, r"got 0\.92; in GHz\?$"),
        ({"frequency": 920e9}, r"got 9\.2e\+11$"),
    ],
)
def test_options_out_of_range_are_refused(folder, options, message):
    with pytest.raises(ValueError, match=message):
        read(folder, **options)


def test_carriers_of_a_file_are_each_links_own(folder):
    (folder / "freq.txt").write_text("0.9\n0.915\n 9.3e-1 \n0.9\n0.915\n0.93\n\n")
    links = read(folder)
    assert links.query.frequencies.dtype == torch.float32
    assert links.query.frequencies.tolist() == pytest.approx(2 * [900e6, 915e6, 930e6], rel=1e-7)
    assert links.scene.frequencies.tolist() == pytest.approx([900e6, 915e6, 930e6], rel=1e-7)
    assert links.remarks == "3 carriers of freq.txt, 900 to 930 MHz"
    again = read(folder, frequency=None)
    assert torch.equal(again.query.frequencies, links.query.frequencies)
    extent = again.receivers[0].array.elements[:, 0].max() - again.receivers[0].array.elements[:, 0].min()
    assert extent.item() == pytest.approx(3 * speed_of_light / 930e6 / 2), "half a wavelength of the highest"
    check_data(links)


# --- defects ---

TX, YML, TRAIN, TEST = "tx_pos.csv", "gateway_info.yml", "train_index.txt", "test_index.txt"
VECTOR = "finite numbers x, y, z, w, written as 1.5 or -2e-3, got"

DEFECTS = [
    (TX, "2.5,-2,", "nan,-2,", ", line 3: expected a finite number, got 'nan' in column x"),
    (TX, "-2,0.25", "-2,0.25,7", ", line 3: expected 3 columns 'x,y,z', got 4: '2.5,-2,0.25,7'"),
    (TX, "3.5,", "\n3.5,", ", line 4: expected 3 columns 'x,y,z', got 1: ''"),
    (TX, "x,y,z", "y,x,z", ", line 1: expected a finite number, got 'y' in column x"),
    (TX, None, None, ": missing; expected x,y,z [m] of one spectrum a line"),
    (TX, "6.5,-6,0.25\n", "", "expected an image of each of the 5 rows of tx_pos.csv, got 0 too few and 1 too many"),
    ("spectrum/00004.png", None, None, "the 6 rows of tx_pos.csv, got 1 too few and 0 too many, the first 00004.png"),
    ("spectrum/00002.png", None, "no image", "cannot parse"),
    (TEST, "00006", "00007", ", line 1: expected one image number in 1..6, got '00007'"),
    (TRAIN, "00005", "00000", ", line 1: expected one image number in 1..6, got '00000'"),
    (TRAIN, "00005", "-1", ", line 1: expected one image number in 1..6, got '-1'"),
    (TRAIN, "00003", "1", ", line 4: expected each entry once, got '1', which is in train_index.txt, line 2 already"),
    (TEST, "00006", "00003", ", line 1: expected each entry once, got '00003', which is in train_index.txt, line 4"),
    (TRAIN, None, "1 2 3 5\n", ", line 1: expected one image number in 1..6, got '1 2 3 5'"),
    (TRAIN, "00005", "00005.png", ", line 1: expected one image number in 1..6, got '00005.png'"),
    (TRAIN, "00001\n", "\n", ", line 2: expected one image number in 1..6, got ''"),
    (TRAIN, None, "0\n" * 12, ", line 1 and 11 other lines: expected one image number in 1..6, got '0'"),
    (TEST, None, None, ": missing; expected one image number in 1..6"),
    ("freq.txt", None, "2.4\n" * 2 + "-2.4\n" * 4, ", line 3 and 3 other lines: expected one carrier from 1e-05"),
    *(("freq.txt", None, "2.4\n" * 5 + number, f", line 6: expected one carrier from 1e-05 to 300 GHz, got '{number}'")
      for number in ("0", "1e-300", "nan", "inf", "2.4 GHz", "920", "300.001")),
    ("freq.txt", None, "920\n" * 6, "got '920'; in MHz?"),
    ("freq.txt", None, "2.4e9\n" * 6, "got '2.4e9'; in Hz?"),
    ("freq.txt", None, "2.4\n\n" + "2.4\n" * 4, ", line 2: expected one carrier"),
    ("freq.txt", None, "2.4\n" * 5, ": expected 6 lines, one for each row of tx_pos.csv, got 5"),
    ("freq.txt", None, "\n", ": empty; expected the carrier [GHz] of one spectrum a line"),
    (YML, "0.5]", "0.6]", ": gateway1: a rotation quaternion must have length 1, got 1.05"),
    (YML, ", 0.5]", "]", f": gateway1: orientation must be 4 {VECTOR} ['0.5', '-0.5', '-0.5']"),
    (YML, "orientation", "rotation", f": gateway1: orientation must be 4 {VECTOR} none"),
    (YML, "5.0", ".inf", ": gateway1: position must be 3 finite numbers x, y, z"),
    (YML, "5.0", "1e5", ": gateway1: position: expected positions within 1e5 m"),
    (YML, "orientation", "position", "cannot parse"),
    (YML, None, "dataset_name: room\n", ": expected one gateway with position [m] and orientation (quaternion"),
    (YML, "gateway1", "gateway2: {}\ngateway1", "got 'gateway2, gateway1'"),
    (YML, None, None, ": missing; expected one gateway"),
]  # fmt: skip


@pytest.mark.parametrize(("file", "old", "new", "message"), DEFECTS)
def test_a_defect_is_named_with_its_place(folder, file, old, new, message):
    replace(folder / file, old, new)
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        nerf2_spectrum.read(folder).official()
    assert str(folder) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_image_of_another_kind_is_named(folder):
    Image.fromarray(np.zeros((90, 361), np.uint8)).save(folder / "spectrum" / "00002.png")
    with pytest.raises(ValueError, match=r"00002\.png: expected 8-bit grey .* got mode L of 90 x 361"):
        read(folder)


# --- writing ---


@pytest.fixture
def links():
    generator = torch.Generator().manual_seed(2)
    transmitters = 4 * torch.rand(5, 3, generator=generator) - 2
    pose = Pose.from_xyzw((1.25, -3, 1e-6), Rotation.from_euler("xyz", (0.3, -1.2, 2.5)).as_quat())
    grid = Grid.degrees()
    links = Links(
        query=Query(transmitters, torch.zeros(5, dtype=torch.long)),
        receivers=(Receiver("north", pose),),
        labels=torch.rand(5, 90, 360, generator=generator),
        task=Spectrum(grid.elevations, grid.azimuths, "none"),
    )
    return changed(links, split=random(links, test=0.4, validation=0.4))


def test_what_is_written_reads_back(links, tmp_path):
    write(tmp_path / "new" / "room", links)
    again = read(tmp_path / "new" / "room")
    assert torch.equal(again.query.transmitters, links.query.transmitters)
    assert (again.labels[torch.arange(5)] - links.labels).abs().max() <= 0.5 / 255 + 1e-6
    assert again.receivers[0].name == "north"
    torch.testing.assert_close(again.receivers[0].pose.position, links.receivers[0].pose.position)
    torch.testing.assert_close(again.receivers[0].pose.rotation, links.receivers[0].pose.rotation)
    training = torch.cat((links.split.train, links.split.validation)).sort().values
    assert torch.equal(again.split.train, training)
    assert torch.equal(again.split.test, links.split.test)


def test_carriers_of_one_place_are_never_parted(links, tmp_path):
    """A place that is measured at another carrier in training would give its labels away."""
    places = links.query.transmitters[[0, 1, 2, 0, 1]]
    query = changed(links.query, transmitters=places, frequencies=torch.tensor([2e9, 2e9, 2e9, 3e9, 3e9]))
    write(tmp_path / "room", changed(links, query=query))
    assert read(tmp_path / "room").rows.tolist() == [0, 1, 2, 0, 1]


@pytest.mark.parametrize(
    "carriers",
    [[2.4e9] * 5, [6.4896e9, 868.3e6, 2.441e9, 868.3e6, 39e9], [1e4, 3e11, 1e4, 3e11, 3e11]],
    ids=["one", "several", "lowest and highest"],
)
def test_carriers_are_written(links, tmp_path, carriers):
    frequencies = torch.tensor(carriers)
    write(tmp_path / "room", changed(links, query=changed(links.query, frequencies=frequencies)))
    again = read(tmp_path / "room", frequency=None)
    assert torch.equal(again.query.frequencies, frequencies)


def test_nothing_is_overwritten(links, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    for place in (tmp_path, tmp_path / "notes.txt"):
        with pytest.raises(FileExistsError, match="must be an empty folder or missing"):
            write(place, links)
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


def test_other_labels_are_not_written(links, tmp_path):
    grid = Grid.degrees(range(1, 10))
    coarse = changed(links, task=Spectrum(grid.elevations, grid.azimuths, "none"), labels=links.labels[:, :9])
    with pytest.raises(
        ValueError, match=r"90 x 360 directions at one receiver, got labels of spectrum \(9, 360\) at 1"
    ):
        write(tmp_path / "room", coarse)
    with pytest.raises(ValueError, match=r"got labels of rssi \(\) at 1"):
        write(tmp_path / "room", changed(links, task=Rssi(), labels=links.labels[:, 0, 0]))
    with pytest.raises(ValueError, match="index files hold a split, got links without one"):
        write(tmp_path / "room", changed(links, split=None))
    assert not (tmp_path / "room").exists()


def test_measured_sample_scores_as_published(measured):
    """The mean training spectrum and the three nearest ones score 0.67 and 0.974 on the published split."""
    root = measured("rfid-s23-200")
    links = read(root)
    train, test = links.split.train, links.split.test
    assert (len(train), len(test)) == (160, 40)
    assert {len(links), len(links.labels)} == {200}
    np.testing.assert_array_equal(links.labels[torch.tensor([6])][0] * 255, imread(root / "spectrum" / "00007.png"))
    labels, known = links.labels[test], links.labels[train]
    distances, nearest = torch.cdist(links.query.transmitters[test], links.query.transmitters[train]).topk(
        3, largest=False
    )
    weights = 1 / distances
    guesses = torch.einsum("bk,bkij->bij", weights / weights.sum(1, keepdim=True), known[nearest])
    score = lambda predictions: np.median(
        [structural_similarity(a.numpy(), b.numpy(), data_range=1) for a, b in zip(labels, predictions, strict=True)]
    )
    assert score(known.mean(0).expand(40, -1, -1)) == pytest.approx(0.67, abs=0.01)
    assert score(guesses) == pytest.approx(0.974, abs=0.002)


def test_measured_data_set_has_the_published_split(measured):
    links = read(measured("rfid-s23"))
    check_data(links)
    assert (len(links.split.train), len(links.split.test)) == (4898, 1225)
