"""Reading and writing the NeRF² layout; the folder is written by hand with Pillow."""

import re
from dataclasses import replace as changed

import numpy as np
import pytest
import torch
from damages import replace
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation
from skimage.io import imread
from skimage.metrics import structural_similarity

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Grid, Pose
from gaigs.core.query import Query
from gaigs.core.task.rssi import Rssi
from gaigs.core.task.spectrum import Spectrum
from gaigs.data import Links, load, nerf2_spectrum
from gaigs.data.nerf2_spectrum import write
from gaigs.split.random import random
from gaigs.testing import check_data

OFFICIAL = {"name": "official", "validation": 0}


def read(folder, split=OFFICIAL, **options):
    return load({"name": "nerf2_spectrum", "root": str(folder), **options}, split)


def pixels(k):
    """The pixels of an image by its number."""
    return np.random.default_rng(k).integers(0, 256, (90, 360), dtype=np.uint8)


def test_links_are_read_as_written(spectrum_folder):
    links = read(spectrum_folder)
    assert links.query.transmitters.tolist() == [[k + 0.5, -k, 0.25] for k in range(1, 7)]
    assert links.split.train.tolist() == [0, 1, 2, 4]
    assert links.split.test.tolist() == [3, 5]
    (receiver,) = links.receivers
    assert receiver.name == "gateway1"
    assert receiver.pose.position.tolist() == pytest.approx([5, 0.26, 0])
    np.testing.assert_allclose(
        receiver.pose.rotation, Rotation.from_quat([0.5, -0.5, -0.5, 0.5]).as_matrix(), atol=1e-6
    )
    assert torch.rad2deg(links.task.directions.elevations)[[0, -1]].tolist() == pytest.approx(
        [1, 90]
    )
    assert torch.rad2deg(links.task.directions.azimuths)[[0, -1]].tolist() == pytest.approx(
        [0, 359]
    )
    labels = links.labels[torch.tensor([4, 0, 4])]
    np.testing.assert_allclose(labels, np.stack([pixels(5), pixels(1), pixels(5)]) / 255, atol=1e-7)
    check_data(links)


# --- array and carriers ---


def test_the_array_is_by_default_that_of_the_published_set(spectrum_folder):
    links = read(spectrum_folder)
    (receiver,) = links.receivers
    steps = sorted({round(value, 6) for value in receiver.array.elements.flatten().tolist()} - {0})
    half = speed_of_light / 920e6 / 2
    assert half == pytest.approx(0.163, abs=1e-3)
    assert steps == pytest.approx([step * half for step in (-1.5, -0.5, 0.5, 1.5)], abs=1e-6)
    assert (len(receiver.array), receiver.array.pattern) == (16, "isotropic")
    assert links.query.frequencies.tolist() == [920e6] * 6
    assert links.remarks == ""
    elements = read(spectrum_folder, elements=[2, 3], frequency=3e9).receivers[0].array.elements
    extents = (elements.amax(0) - elements.amin(0)) / (speed_of_light / 3e9 / 2)
    assert extents.tolist() == pytest.approx([2, 1, 0]), "columns along x, rows along y"


def test_an_unknown_array_or_carrier_is_a_single_antenna(spectrum_folder):
    links = read(spectrum_folder, elements=None)
    assert torch.equal(links.receivers[0].array.elements, Array.single().elements)
    assert links.query.frequencies.tolist() == [920e6] * 6
    links = read(spectrum_folder, frequency=None)
    assert links.query.frequencies is None
    assert torch.equal(links.receivers[0].array.elements, Array.single().elements)
    assert "the array counts as a single antenna" in links.remarks
    assert read(spectrum_folder, elements=None, frequency=None).remarks == ""


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"elements": [4]},
            r"elements must be the array's rows and columns, such as \[4, 4\], or null, got \[4\]",
        ),
        ({"bandwidth": -1.0}, "bandwidth must be that of a band, 0 or more .*, got -1"),
        ({"frequency": 0.0}, r"frequency must be a carrier in Hz, from 10000 to 3e\+11, got 0$"),
        ({"frequency": 920}, r"got 920; in MHz\?$"),
    ],
)
def test_options_out_of_range_are_refused(spectrum_folder, options, message):
    with pytest.raises(ValueError, match=message):
        read(spectrum_folder, **options)


def test_carriers_of_a_file_are_each_links_own(spectrum_folder):
    (spectrum_folder / "freq.txt").write_text("0.9\n0.915\n 9.3e-1 \n0.9\n0.915\n0.93\n\n")
    links = read(spectrum_folder)
    assert links.query.frequencies.dtype == torch.float32
    assert links.query.frequencies.tolist() == pytest.approx(2 * [900e6, 915e6, 930e6], rel=1e-7)
    assert links.scene.frequencies.tolist() == pytest.approx([900e6, 915e6, 930e6], rel=1e-7)
    assert links.remarks == "3 carriers of freq.txt, 900 to 930 MHz"
    again = read(spectrum_folder, frequency=None)
    assert torch.equal(again.query.frequencies, links.query.frequencies)
    extent = (
        again.receivers[0].array.elements[:, 0].max()
        - again.receivers[0].array.elements[:, 0].min()
    )
    assert extent.item() == pytest.approx(3 * speed_of_light / 930e6 / 2), (
        "half a wavelength of the highest"
    )
    check_data(links)


# --- defects ---

TX, YML, TRAIN, TEST = "tx_pos.csv", "gateway_info.yml", "train_index.txt", "test_index.txt"
VECTOR = "finite numbers x, y, z, w, written as 1.5 or -2e-3, got"

DEFECTS = [
    (TX, None, None, ": missing; expected x,y,z [m] of one spectrum a line"),
    (TX, "6.5,-6,0.25\n", "", "expected an image of each of the 5 rows of tx_pos.csv, got 0 too few and 1 too many"),
    ("spectrum/00004.png", None, None, "the 6 rows of tx_pos.csv, got 1 too few and 0 too many, the first 00004.png"),
    (TEST, "00006", "00007", ", line 1: expected one image number in 1..6, got '00007'"),
    (TRAIN, "00005", "00000", ", line 1: expected one image number in 1..6, got '00000'"),
    (TEST, "00006", "00003", ", line 1: expected each entry once, got '00003', which is in train_index.txt, line 4"),
    (TRAIN, "00005", "00005.png", ", line 1: expected one image number in 1..6, got '00005.png'"),
    ("freq.txt", None, "2.4\n" * 2 + "-2.4\n" * 4, ", line 3 and 3 other lines: expected one carrier from 1e-05"),
    *(("freq.txt", None, "2.4\n" * 5 + number, f", line 6: expected one carrier from 1e-05 to 300 GHz, got '{number}'")
      for number in ("0", "1e-300", "nan", "inf", "2.4 GHz", "920", "300.001")),
    ("freq.txt", None, "920\n" * 6, "got '920'; in MHz?"),
    ("freq.txt", None, "2.4e9\n" * 6, "got '2.4e9'; in Hz?"),
    ("freq.txt", None, "2.4\n" * 5, ": expected 6 lines, one for each row of tx_pos.csv, got 5"),
    (YML, "0.5]", "0.6]", ": gateway1: a rotation quaternion must have length 1, got 1.05"),
    (YML, "orientation", "rotation", f": gateway1: orientation must be 4 {VECTOR} none"),
    (YML, None, "dataset_name: room\n", ": expected one gateway with position [m] and orientation (quaternion"),
    (YML, "gateway1", "gateway2: {}\ngateway1", "got 'gateway2, gateway1'"),
]  # fmt: skip


@pytest.mark.parametrize(("file", "old", "new", "message"), DEFECTS)
def test_a_defect_is_named_with_its_place(spectrum_folder, file, old, new, message):
    replace(spectrum_folder / file, old, new)
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        nerf2_spectrum.read(spectrum_folder).official()
    assert str(spectrum_folder) in str(caught.value)
    assert "\n" not in str(caught.value)


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


def test_written_links_read_back(links, tmp_path):
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


def test_carriers_are_written_and_those_of_one_place_share_a_row(links, tmp_path):
    places = links.query.transmitters[[0, 1, 2, 0, 1]]
    carriers = torch.tensor([1e4, 868.3e6, 2.441e9, 6.4896e9, 3e11])
    write(
        tmp_path / "room",
        changed(links, query=changed(links.query, transmitters=places, frequencies=carriers)),
    )
    again = read(tmp_path / "room", frequency=None)
    assert torch.equal(again.query.frequencies, carriers)
    assert again.rows.tolist() == [0, 1, 2, 0, 1]


def test_other_labels_are_not_written(links, tmp_path):
    grid = Grid.degrees(range(1, 10))
    coarse = changed(
        links, task=Spectrum(grid.elevations, grid.azimuths, "none"), labels=links.labels[:, :9]
    )
    with pytest.raises(
        ValueError,
        match=r"90 x 360 directions at one receiver, got labels of spectrum \(9, 360\) at 1",
    ):
        write(tmp_path / "room", coarse)
    with pytest.raises(ValueError, match=r"got labels of rssi \(\) at 1"):
        write(tmp_path / "room", changed(links, task=Rssi(), labels=links.labels[:, 0, 0]))
    with pytest.raises(ValueError, match="index files hold a split, got links without one"):
        write(tmp_path / "room", changed(links, split=None))
    assert not (tmp_path / "room").exists()


def test_measured_sample_scores_as_published(measured):
    """The mean training spectrum and the three nearest ones score 0.67 and 0.974 on the published
    split.
    """
    root = measured("rfid-s23-200")
    links = read(root)
    train, test = links.split.train, links.split.test
    assert (len(train), len(test)) == (160, 40)
    assert {len(links), len(links.labels)} == {200}
    np.testing.assert_array_equal(
        links.labels[torch.tensor([6])][0] * 255, imread(root / "spectrum" / "00007.png")
    )
    labels, known = links.labels[test], links.labels[train]
    distances, nearest = torch.cdist(
        links.query.transmitters[test], links.query.transmitters[train]
    ).topk(3, largest=False)
    weights = 1 / distances
    guesses = torch.einsum("bk,bkij->bij", weights / weights.sum(1, keepdim=True), known[nearest])

    def score(predictions):
        return np.median(
            [
                structural_similarity(a.numpy(), b.numpy(), data_range=1)
                for a, b in zip(labels, predictions, strict=True)
            ]
        )

    assert score(known.mean(0).expand(40, -1, -1)) == pytest.approx(0.67, abs=0.01)
    assert score(guesses) == pytest.approx(0.974, abs=0.002)
