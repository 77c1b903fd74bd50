"""Reading complex channels from one file of arrays; the arrays are made here by numpy."""

import re
import warnings
import zipfile

import numpy as np
import pytest
import torch

from gaigs.data import load
from gaigs.testing import check_data

RANDOM = {"name": "random", "validation": 0}


def arrays():
    """Ten links from five places to two of three receivers, of 3 elements at 4 subcarriers, out of order."""
    draw = np.random.default_rng(0)
    places = draw.uniform(-3, 3, (5, 3))
    return {
        "tx": places[[4, 4, 1, 1, 0, 2, 3, 3, 2, 0]],
        "rx": np.array([[0.0, 0.0, 2.5], [9.0, 9.0, 2.0], [4.0, 1.0, 2.25]]),
        "rx_index": np.array([0, 2, 0, 2, 2, 0, 0, 2, 2, 0]),
        "frequencies": np.linspace(2.40e9, 2.46e9, 4),
        "h": draw.normal(size=(10, 3, 4)) + 1j * draw.normal(size=(10, 3, 4)),
        "elements": np.array([[-0.06, 0, 0], [0, 0, 0], [0.06, 0, 0.01]]),
    }


def save(file, content):
    np.savez(file, **content)
    return file


@pytest.fixture
def file(tmp_path):
    return save(tmp_path / "room.npz", arrays())


def read(file, split=RANDOM):
    return load({"name": "csi_npz", "file": str(file)}, split)


def changed(file, **changes):
    """The file with some arrays replaced, or left out where they are None."""
    content = {name: array for name, array in (arrays() | changes).items() if array is not None}
    return save(file, content)


def test_every_channel_is_a_link(file):
    links, content = read(file), arrays()
    np.testing.assert_array_equal(links.labels, content["h"].astype(np.complex64))
    np.testing.assert_array_equal(links.query.transmitters, content["tx"].astype(np.float32))
    assert links.query.receivers.tolist() == [0, 1, 0, 1, 1, 0, 0, 1, 1, 0]
    assert [r.name for r in links.receivers] == ["rx0", "rx2"]
    assert [r.pose.position.tolist() for r in links.receivers] == [[0, 0, 2.5], [4, 1, 2.25]]
    for receiver in links.receivers:
        np.testing.assert_array_equal(receiver.array.elements, content["elements"].astype(np.float32))
        assert receiver.array.pattern == "isotropic"
        assert torch.equal(receiver.pose.rotation, torch.eye(3))
    assert (links.task.name, links.task.shape) == ("csi", (3, 4))
    np.testing.assert_array_equal(links.task.frequencies, content["frequencies"])
    assert links.query.frequencies.tolist() == pytest.approx([2.43e9] * 10, rel=1e-7)
    assert links.remarks == "10 channels from 5 places at 2 receivers; receivers without links are left out: rx1"
    check_data(links)


def test_links_of_one_place_share_a_row_and_stay_together(file):
    assert read(file).rows.tolist() == [0, 0, 1, 1, 2, 3, 4, 4, 3, 2]
    for seed in range(5):
        split = read(file, {**RANDOM, "test": 0.4, "seed": seed}).split
        tx = arrays()["tx"]
        places = [{tuple(place) for place in tx[part.numpy()]} for part in (split.train, split.test)]
        assert all(places)
        assert places[0].isdisjoint(places[1])


def test_channels_of_zeros_are_left_out_and_counted(file):
    h = arrays()["h"]
    h[[0, 7]] = 0
    h[3, :2] = 0  # one element still hears
    h[5] = 1e-60  # zero in single precision
    links = read(changed(file, h=h))
    kept = [1, 2, 3, 4, 6, 8, 9]
    np.testing.assert_array_equal(links.labels, h[kept].astype(np.complex64))
    np.testing.assert_array_equal(links.query.transmitters, arrays()["tx"][kept].astype(np.float32))
    assert links.query.receivers.tolist() == [1, 0, 1, 1, 0, 1, 0]
    assert links.remarks.startswith("7 channels from 5 places at 2 receivers; 3 that are zero throughout are left out;")
    check_data(links)


def test_a_receiver_that_hears_nothing_is_left_out(file):
    content = arrays()
    content["h"][content["rx_index"] == 0] = 0
    links = read(changed(file, h=content["h"]))
    assert [r.name for r in links.receivers] == ["rx2"]
    assert links.query.receivers.tolist() == [0] * 5
    assert links.remarks.endswith("receivers without links are left out: rx0, rx1")


def test_a_single_antenna_needs_no_elements(file):
    links = read(changed(file, elements=None, h=arrays()["h"][:, :1]))
    assert links.task.shape == (1, 4)
    assert all(torch.equal(r.array.elements, torch.zeros(1, 3)) for r in links.receivers)
    assert "elements" not in links.remarks
    check_data(links)


def test_elements_in_unknown_places_stand_at_the_receiver_and_that_is_said(file):
    links = read(changed(file, elements=None))
    assert links.task.shape == (3, 4)
    assert all(torch.equal(r.array.elements, torch.zeros(3, 3)) for r in links.receivers)
    assert "the file does not say where the 3 elements stand, so all count as standing at" in links.remarks
    check_data(links)


def test_other_arrays_are_named_and_not_read(file):
    content = arrays() | {"snr": np.ones(10), "notes": np.array(["a", None], dtype=object)}
    links = read(save(file, content))
    assert links.remarks.endswith("; arrays ignored: snr, notes")


@pytest.mark.parametrize(
    "types",
    [
        {"h": np.complex64, "tx": np.float32, "rx_index": np.uint8},
        {"h": ">c16", "tx": ">f8", "rx_index": ">i2", "frequencies": np.int64},
        {"h": np.clongdouble, "rx": np.longdouble, "rx_index": np.uint64, "frequencies": np.float32},
    ],
    ids=["narrow", "big-endian", "wide"],
)
def test_arrays_of_other_types_are_read(file, types):
    links = read(changed(file, **{name: arrays()[name].astype(dtype) for name, dtype in types.items()}))
    torch.testing.assert_close(links.labels, torch.from_numpy(arrays()["h"]).to(torch.complex64))
    assert links.query.receivers.tolist() == [0, 1, 0, 1, 1, 0, 0, 1, 1, 0]
    check_data(links)


def test_compressed_files_are_read_and_stay_as_they_are(file):
    np.savez_compressed(file, **arrays())
    before = file.read_bytes()
    assert len(read(file)) == 10
    assert file.read_bytes() == before


def test_the_configuration_reads_a_file(file, configured):
    config = configured("data=csi_npz", f"data.file={file}")
    links = load(config.data, config.split)
    assert links.split.name == "random, test 0.2, validation 0.1, seed 0"
    assert config.task.name == links.task.name


def test_there_is_no_official_split(file):
    with pytest.raises(ValueError, match="no official split; choose split=random"):
        read(file, {"name": "official"})


def put(name, index, value):
    array = arrays()[name].copy()
    array[index] = value
    return {name: array}


DEFECTS = {
    "no tx": ({"tx": None}, "tx: missing; expected real numbers of shape (n, 3)"),
    "no index": ({"rx_index": None}, "rx_index: missing; expected whole numbers of shape (n,)"),
    "no channels": ({"h": None}, "h: missing; expected complex numbers of shape (n, e, s)"),
    "tx of another shape": ({"tx": np.ones((10, 2))}, "tx: expected the shape (n, 3), got (10, 2)"),
    "tx of another length": ({"tx": np.ones((9, 3))}, "rx_index: expected the shape (9,), got (10,)"),
    "flat receivers": ({"rx": np.ones(3)}, "rx: expected the shape (k, 3), got (3,)"),
    "index of another length": ({"rx_index": np.zeros(9, int)}, "rx_index: expected the shape (10,), got (9,)"),
    "channels of another length": (
        {"h": np.ones((9, 3, 4), complex)},
        "h: expected the shape (10, e, 4), got (9, 3, 4)",
    ),
    "subcarriers of another number": ({"frequencies": np.ones(5)}, "h: expected the shape (10, e, 5), got (10, 3, 4)"),
    "a single frequency": ({"frequencies": np.float64(2.4e9)}, "frequencies: expected the shape (s,), got ()"),
    "elements of another number": ({"elements": np.ones((4, 3))}, "elements: expected the shape (3, 3), got (4, 3)"),
    "channels of one antenna": (
        {"h": np.ones((10, 4), complex)},
        "h: expected the shape (10, e, 4), got (10, 4); for one antenna add an axis, h[:, None, :]",
    ),
    "real channels": (
        {"h": np.ones((10, 3, 4))},
        "h: expected complex numbers, got float64; join real and imaginary parts by re + 1j * im",
    ),
    "fractional index": ({"rx_index": np.zeros(10)}, "rx_index: expected whole numbers, got float64"),
    "positions in words": ({"tx": np.full((10, 3), "near")}, "tx: expected real numbers, got <U4"),
    "no links": (
        {"tx": np.ones((0, 3)), "rx_index": np.ones(0, int), "h": np.ones((0, 3, 4), complex)},
        "tx: expected the shape (n, 3) with no size of 0, got (0, 3)",
    ),
    "no elements": ({"h": np.ones((10, 0, 4), complex)}, "h: expected the shape (10, e, 4) with no size of 0"),
    "index beyond": (put("rx_index", [3, 5], 3), "rx_index[3]: expected a row of rx, 0..2, got 3; 2 of 10 such rows"),
    "index from 1": ({"rx_index": np.array([1, 3] * 5)}, "rx_index[1]: expected a row of rx, 0..2, got 3"),
    "index negative": (put("rx_index", 0, -1), "rx_index[0]: expected a row of rx, 0..2, got -1; 1 of 10 such rows"),
    "tx nan": (put("tx", (6, 1), np.nan), "tx[6]: expected positions within 1e5 m of the origin on each axis"),
    "tx infinite": (put("tx", (6, 1), np.inf), "(subtract a common origin from all), got inf; 1 of 10 such rows"),
    "rx far": (put("rx", (1, 0), -1e5), "rx[1]: expected positions within 1e5 m of the origin on each axis"),
    "element far": (put("elements", (2, 2), 5e6), "elements[2]: expected positions within 1e5 m"),
    "frequency zero": (
        put("frequencies", 0, 0),
        "frequencies[0]: expected a frequency from 10000 to 3e+11 Hz, got 0.0",
    ),
    "frequency nan": (
        put("frequencies", 3, np.nan),
        "frequencies[3]: expected a frequency from 10000 to 3e+11 Hz, got nan",
    ),
    "offsets for frequencies": (
        {"frequencies": np.array([-3e7, -1e7, 1e7, 3e7])},
        "frequencies[0]: expected a frequency from 10000 to 3e+11 Hz, got -30000000.0; 2 of 4 such rows",
    ),
    "frequency in GHz": (
        put("frequencies", 1, 2.4),
        "frequencies[1]: expected a frequency from 10000 to 3e+11 Hz, got 2.4; 1 of 4 such rows; in GHz?",
    ),
    "frequencies in MHz": (
        {"frequencies": np.linspace(2400, 2460, 4)},
        "frequencies[0]: expected a frequency from 10000 to 3e+11 Hz, got 2400.0; 4 of 4 such rows; in MHz?",
    ),
    "frequency too high": (put("frequencies", 1, 920e9), "3e+11 Hz, got 920000000000.0; 1 of 4 such rows"),
    "frequency vast": (put("frequencies", 1, 1e300), "3e+11 Hz, got 1e+300; 1 of 4 such rows"),
    "frequency twice": (put("frequencies", 1, 2.40e9), "frequencies: expected different ones, got one twice"),
    "channel whose square is infinite": (
        put("h", (8, 1, 2), 1e19),
        "h[8]: expected numbers below 1e+18, the largest of a link 1e-18 or more unless all are 0, got (9.99",
    ),
    "channel whose square is zero": (
        {"h": np.full((10, 3, 4), 1e-30j)},
        "the largest of a link 1e-18 or more unless all are 0, got 1.00000000",
    ),
    "channel nan": (put("h", (8, 1, 2), np.nan), "unless all are 0, got (nan+0j)"),
    "channel beyond float32": (put("h", (8, 1, 2), 1e60), "unless all are 0, got (inf+0j)"),
    "zeros": (
        {"h": np.zeros((10, 3, 4), complex)},
        "h: expected a channel that is not zero throughout, got none",
    ),
    "objects": (
        {"tx": np.array([None] * 10)},
        "tx: unreadable (Object arrays cannot be loaded when allow_pickle=False)",
    ),
}


@pytest.mark.parametrize("name", DEFECTS)
def test_a_defect_is_named_with_its_array(file, name):
    changes, message = DEFECTS[name]
    changed(file, **changes)
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        read(file)
    assert str(caught.value).startswith(f"{file} has")


def test_defects_are_reported_at_once(file):
    changed(file, tx=None, h=np.ones((10, 3, 5)), frequencies=np.array(["a"] * 4))
    with pytest.raises(ValueError, match="has 4 defects:"):
        read(file)
    changed(file, **put("tx", 0, np.nan), **put("frequencies", 0, -1), **put("rx_index", 0, 9))
    with pytest.raises(ValueError, match="has 3 defects:"):
        read(file)


UNREADABLE = "expected an .npz file, as numpy.savez writes it, which numpy cannot read"


def cut(file):
    file.write_bytes(file.read_bytes()[:400])


def damage(file):
    with zipfile.ZipFile(file) as archive:
        start = archive.getinfo("h.npy").header_offset
    content = bytearray(file.read_bytes())
    content[start + 300] ^= 0xFF
    file.write_bytes(content)


def store(file, member, content):
    """The file with one member of such bytes, whose checksum is right."""
    with zipfile.ZipFile(file) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    members[member] = content(members[member])
    with zipfile.ZipFile(file, "w") as archive:
        for name, stored in members.items():
            archive.writestr(name, stored)


def halve(file):
    """A header of half the precision, as one damaged byte writes it, whose checksum is that of the whole."""
    changed(file, rx=np.ones((2000, 3)))  # zipfile compares what it has read to the end, and reads 4 kB ahead
    before, start, content = file.read_bytes().partition(b"rx.npy")
    assert b"'<f8'" in content[:200]
    file.write_bytes(before + start + content.replace(b"'<f8'", b"'<f4'", 1))


def repeat(file):
    with zipfile.ZipFile(file, "a") as archive, warnings.catch_warnings(action="ignore"):
        archive.writestr("tx.npy", archive.read("tx.npy"))


@pytest.mark.parametrize(
    ("break_file", "message"),
    [
        (halve, "rx: unreadable (more numbers than its shape (2000, 3) has)"),
        (repeat, "tx: stands there 2 times; expected it once"),
        (lambda f: store(f, "tx.npy", lambda old: old + b"0"), "tx: unreadable (more numbers than its shape"),
        (lambda f: store(f, "tx.npy", lambda old: old.replace(b"(10, 3)", b"(10*3) ")), "tx: unreadable ("),
        (lambda f: store(f, "tx.npy", lambda old: old.replace(b"(10, 3)", b"(9**9,)")), "tx: unreadable ("),
        (lambda f: store(f, "tx.npy", lambda old: old.replace(b"        ", b"0" * 8)), "tx: unreadable ("),
        (
            lambda f: f.write_text("tx,rx\n1,2\n"),
            UNREADABLE,
        ),
        (lambda f: f.write_bytes(b""), UNREADABLE),
        (cut, UNREADABLE),
        (damage, "h: unreadable (Bad CRC-32 for file 'h.npy')"),
        (
            lambda f: f.write_bytes(np.ones((2, 3)).dumps()),
            UNREADABLE,
        ),
    ],
    ids=["half", "twice", "longer", "no shape", "power", "header", "text", "empty", "cut", "damaged", "pickle"],
)
def test_files_that_are_no_whole_archive_are_refused(file, break_file, message):
    break_file(file)
    with pytest.raises(ValueError, match=re.escape(message)):
        read(file)


def test_a_single_array_is_refused(tmp_path):
    np.save(tmp_path / "h.npy", arrays()["h"])
    with pytest.raises(ValueError, match=r"got a single array of shape \(10, 3, 4\)"):
        read(tmp_path / "h.npy")


def test_a_missing_file_is_named(file):
    with pytest.raises(FileNotFoundError, match=r"none\.npz must be an \.npz file of channels, and is no file"):
        read(file.with_name("none.npz"))
