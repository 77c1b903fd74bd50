"""Reading complex channels from one file of arrays; the arrays are made here by numpy."""

import re
import warnings
import zipfile

import h5py
import numpy as np
import pytest
import scipy.io
import torch

import gaigs
from gaigs.core.task.csi import Csi
from gaigs.data import csi_npz, load
from gaigs.data.parts import check_parts
from gaigs.testing import check_data

RANDOM = {"name": "random", "validation": 0}


def arrays():
    """Ten links from five places to two of three receivers, of 3 elements at 4 subcarriers, out of
    order.
    """
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
        np.testing.assert_array_equal(
            receiver.array.elements, content["elements"].astype(np.float32)
        )
        assert receiver.array.pattern == "isotropic"
        assert torch.equal(receiver.pose.rotation, torch.eye(3))
    assert (links.task.name, links.task.shape) == ("csi", (3, 4))
    np.testing.assert_array_equal(links.task.frequencies, content["frequencies"])
    assert links.query.frequencies.tolist() == pytest.approx([2.43e9] * 10, rel=1e-7)
    assert links.rows.tolist() == [0, 0, 1, 1, 2, 3, 4, 4, 3, 2]
    assert (
        links.remarks
        == "10 channels from 5 places at 2 receivers; receivers without links are left out: rx1"
    )
    check_data(links)


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
    assert links.remarks.startswith(
        "7 channels from 5 places at 2 receivers; 3 that are zero throughout are left out;"
    )
    check_data(links)


def test_unknown_elements_stand_at_the_receiver_with_a_remark(file):
    links = read(changed(file, elements=None))
    assert links.task.shape == (3, 4)
    assert all(torch.equal(r.array.elements, torch.zeros(3, 3)) for r in links.receivers)
    assert "positions of the 3 elements are unknown" in links.remarks
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
        {
            "h": np.clongdouble,
            "rx": np.longdouble,
            "rx_index": np.uint64,
            "frequencies": np.float32,
        },
    ],
    ids=["narrow", "big-endian", "wide"],
)
def test_arrays_of_other_types_are_read(file, types):
    links = read(
        changed(file, **{name: arrays()[name].astype(dtype) for name, dtype in types.items()})
    )
    torch.testing.assert_close(links.labels, torch.from_numpy(arrays()["h"]).to(torch.complex64))
    assert links.query.receivers.tolist() == [0, 1, 0, 1, 1, 0, 0, 1, 1, 0]
    check_data(links)


def put(name, index, value):
    array = arrays()[name].copy()
    array[index] = value
    return {name: array}


NEAR = (
    "expected positions within 1e5 m of the origin on each axis (subtract a common origin from "
    "all), got"
)
CARRIER = "expected a frequency from 10000 to 3e+11 Hz, got"
LEVEL = "expected magnitudes below 1e+18, the largest of a link 1e-18 or more unless all are 0, got"

DEFECTS = [
    ({"tx": None}, "tx: expected one array of real numbers of (n, 3), got 0"),
    ({"tx": np.ones((10, 2))}, "tx: expected the shape (n, 3), got (10, 2)"),
    ({"rx": np.ones(3)}, "rx: expected the shape (k, 3), got (3,)"),
    ({"h": np.ones((9, 3, 4), complex)}, "h: expected the shape (10, e, 4), got (9, 3, 4)"),
    ({"elements": np.ones((4, 3))}, "elements: expected the shape (3, 3), got (4, 3)"),
    (
        {"h": np.ones((10, 4), complex)},
        "(10, e, 4), got (10, 4); for one antenna add an axis, h[:, None, :]",
    ),
    (
        {"h": np.ones((10, 3, 4))},
        "h: expected complex numbers, got float64; data.arrays={h: [RE, IM]} names",
    ),
    ({"rx_index": np.zeros(10)}, "rx_index: expected whole numbers, got float64"),
    ({"h": np.ones((10, 0, 4), complex)}, "h: expected the shape (10, e, 4), got (10, 0, 4)"),
    (
        put("rx_index", [3, 5], 3),
        "rx_index[3]: expected a row of rx, counted from 0, 0..2, got 3 (in 2 of 10 rows)",
    ),
    (put("tx", (6, 1), np.nan), "tx[6, 1]: expected a number, got NaN (in 1 of 10 rows)"),
    (put("rx", (1, 0), -1e5), f"rx[1, 0]: {NEAR} -100000.0"),
    (
        {"frequencies": np.array([-3e7, -1e7, 1e7, 3e7])},
        f"frequencies[0]: {CARRIER} -30000000.0 (in 2 of 4 rows)",
    ),
    (
        {"frequencies": np.linspace(2400, 2460, 4)},
        f"frequencies[0]: {CARRIER} 2400.0; in MHz? (in 4 of 4 rows)",
    ),
    (put("frequencies", 1, 2.40e9), "frequencies: expected different ones, got one twice"),
    (put("h", (8, 1, 2), 1e19), f"h[8, 1, 2]: {LEVEL} (9.99"),
    ({"h": np.full((10, 3, 4), 1e-30j)}, f"h[0, 0, 0]: {LEVEL} 1.00000000"),
    (put("h", ([2, 8], 1, 2), np.nan), "h[2, 1, 2]: expected a number, got NaN (in 2 of 10 rows)"),
    (
        {"h": np.zeros((10, 3, 4), complex)},
        "h: expected a channel that is not zero throughout, got none",
    ),
    ({"tx": np.array([None] * 10)}, "tx: Object arrays cannot be loaded when allow_pickle=False"),
]


@pytest.mark.parametrize(("changes", "message"), DEFECTS)
def test_a_defect_is_named_with_its_array(file, changes, message):
    changed(file, **changes)
    with pytest.raises(ValueError, match=re.escape(message)) as caught:
        csi_npz.read(file)
    assert str(file) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_written_links_read_back(file, tmp_path):
    links = read(changed(file, rx_index=np.zeros(10, int)))
    (tmp_path / "copy").mkdir()
    csi_npz.write(tmp_path / "copy", links)
    again = read(tmp_path / "copy" / "room.npz")
    assert torch.equal(again.labels, links.labels)
    assert torch.equal(again.query.transmitters, links.query.transmitters)
    torch.testing.assert_close(again.receivers[0].array.elements, links.receivers[0].array.elements)


def damage(file):
    with zipfile.ZipFile(file) as archive:
        start = archive.getinfo("h.npy").header_offset
    content = bytearray(file.read_bytes())
    content[start + 300] ^= 0xFF
    file.write_bytes(content)


def halve(file):
    """A header of half the precision, as one damaged byte writes it, with a correct checksum of the
    rest.
    """
    changed(
        file, rx=np.ones((2000, 3))
    )  # zipfile compares checksums at the end, and reads 4 kB ahead
    before, start, content = file.read_bytes().partition(b"rx.npy")
    assert b"'<f8'" in content[:200]
    file.write_bytes(before + start + content.replace(b"'<f8'", b"'<f4'", 1))


def single(file):
    with file.open("wb") as stream:
        np.save(stream, arrays()["h"])


def repeat(file):
    with zipfile.ZipFile(file, "a") as archive, warnings.catch_warnings(action="ignore"):
        archive.writestr("tx.npy", archive.read("tx.npy"))


@pytest.mark.parametrize(
    ("break_file", "message"),
    [
        (halve, "rx: more numbers than its shape (2000, 3) has"),
        (repeat, "tx: expected one array of real numbers of (n, 3), got 2"),
        (damage, "h: Bad CRC-32 for file 'h.npy'"),
        (single, ": a single array of shape (10, 3, 4); expected"),
        (
            lambda file: file.write_text("tx,rx\n1,2\n"),
            "; expected an .npz file as numpy.savez writes it",
        ),
    ],
)
def test_damaged_archives_are_refused(file, break_file, message):
    break_file(file)
    with pytest.raises(ValueError, match=re.escape(message)):
        read(file)


def save_mat(file, content):
    scipy.io.savemat(file, content)


def save_hdf5(file, content):
    with h5py.File(file, "w") as stored:
        for name, array in content.items():
            stored[f"room/{name}"] = array


def save_mat73(file, content):
    """As MATLAB does: reversed axes, matrices alone, doubles alone, a compound type for complex
    numbers.
    """
    with h5py.File(file, "w", userblock_size=512) as stored:
        for name, array in content.items():
            array = np.atleast_2d(array).T
            if array.dtype.kind == "c":
                pairs = np.empty(array.shape, [("real", "f8"), ("imag", "f8")])
                pairs["real"], pairs["imag"] = array.real, array.imag
                array = pairs
            else:
                array = array.astype("f8")
            stored[name] = array
            stored[name].attrs["MATLAB_class"] = np.bytes_("double")


@pytest.mark.parametrize(
    ("save", "name", "group"),
    [
        (save_mat, "a.mat", ""),
        (save_mat73, "a.mat", ""),
        (save_hdf5, "a.h5", "room/"),
        (save_hdf5, "a.hdf5", "room/"),
    ],
)
def test_matlab_and_hdf5_files_have_the_same_links(file, tmp_path, save, name, group):
    save(tmp_path / name, arrays() | {"notes": np.ones(3)})
    names = {name: group + name for name in arrays()} if group else {}
    links = csi_npz.read(tmp_path / name, names)
    expected = csi_npz.read(file)
    assert torch.equal(links.labels, expected.labels)
    assert torch.equal(links.query.transmitters, expected.query.transmitters)
    assert torch.equal(links.query.receivers, expected.query.receivers)
    assert torch.equal(links.task.frequencies, expected.task.frequencies)
    assert links.remarks == f"{expected.remarks}; arrays ignored: {group}notes"


@pytest.mark.parametrize("save", [save_mat, save_mat73])
def test_matlab_drops_the_axis_of_a_single_subcarrier(tmp_path, save):
    content = arrays() | {"frequencies": 2.4e9, "h": arrays()["h"][..., 0]}
    save(tmp_path / "room.mat", content)
    labels = csi_npz.read(tmp_path / "room.mat").labels
    np.testing.assert_array_equal(labels, arrays()["h"][..., :1].astype(np.complex64))


def test_parts_of_complex_numbers_are_joined(file):
    h, expected = arrays()["h"], csi_npz.read(file).labels
    changed(file, h=None, re=h.real, im=h.imag)
    assert torch.equal(csi_npz.read(file, {"h": ["re", "im"]}).labels, expected)
    for axis, parts in ((0, "first"), (-1, "last")):
        changed(file, h=np.stack((h.real, h.imag), axis))
        assert torch.equal(csi_npz.read(file, parts=parts).labels, expected)
        with pytest.raises(
            ValueError,
            match=r"h: expected complex numbers, got float64; .* data.parts=last or first",
        ):
            csi_npz.read(file)  # may be amplitudes at two antennas
    for parts, given in (("first", np.abs(h)), ("last", h[..., :2])):
        changed(file, h=given)
        with pytest.raises(
            ValueError,
            match=rf"data.parts={parts} is for real numbers with 2 along the {parts} axis",
        ):
            csi_npz.read(file, parts=parts)
    with pytest.raises(ValueError, match="must be first or last, the axis of"):
        csi_npz.read(file, parts="both")


@pytest.mark.parametrize("rx", [np.zeros((3, 1)), np.zeros(3), np.zeros((2, 1, 3))])
def test_receivers_of_another_shape_are_named_before_their_index(tmp_path, rx):
    content = arrays() | {"rx": rx}
    del content["rx_index"]
    for save_one, name in ((save_hdf5, "a.h5"), (save, "a.npz")):
        save_one(tmp_path / name, content)
        names = {name: f"room/{name}" for name in content} if name == "a.h5" else {}
        with pytest.raises(
            ValueError, match=rf"rx: expected the shape \(k, 3\), got {re.escape(str(rx.shape))}"
        ):
            csi_npz.read(tmp_path / name, names)


def mistaken(amplitude, phase):
    """The two numbers of each channel in place of its parts, in either order."""
    return [amplitude + 1j * phase, phase + 1j * amplitude]


@pytest.mark.parametrize("unit", ["linear", "dB"])
@pytest.mark.parametrize(
    ("phases", "word"),
    [("radians", "jp"), ("degrees", "deg2rad"), ("turn", "jp"), ("turn_deg", "deg2rad")],
)
def test_amplitude_and_phase_as_parts_are_refused(file, unit, phases, word):
    draw = np.random.default_rng(0)
    h = draw.normal(size=(10, 3, 40)) + 1j * draw.normal(size=(10, 3, 40))
    angle = np.angle(h) % (2 * np.pi) if phases.startswith("turn") else np.angle(h)
    phase = np.rad2deg(angle) if "deg" in phases else angle
    amplitude = np.abs(h) if unit == "linear" else 20 * np.log10(np.abs(h)) - 60
    factor = "a" if unit == "linear" else r"10 \*\* \(a / 20\)"
    frequencies = np.linspace(2.4e9, 2.46e9, 40)
    mend = (
        rf"as amplitude a and phase p\ngive {factor} \* np.exp\(1j \* "
        rf"{'p' if word == 'jp' else 'np.deg2rad'}"
    )
    for wrong in mistaken(amplitude, phase):
        changed(file, h=None, re=wrong.real, im=wrong.imag, frequencies=frequencies)
        with pytest.raises(ValueError, match=rf"h: (real|imaginary) parts are .*{mend}"):
            csi_npz.read(file, {"h": ["re", "im"]})
        with pytest.raises(ValueError, match=rf"labels: .*{mend}"):
            gaigs.links(
                task=Csi(3, frequencies),
                transmitters=arrays()["tx"],
                receivers=[[0, 0, 2]],
                labels=wrong,
            )


@pytest.mark.parametrize("scale", [1e-4, 1.0, 3.0, 100.0])
def test_parts_of_true_channels_are_no_amplitudes(scale):
    """Random phases; phases near 0, as after calibration; channels of one sign; few numbers."""
    draw = np.random.default_rng(0)
    h = scale * (draw.normal(size=2000) + 1j * draw.normal(size=2000))
    aligned = scale * np.exp(1j * draw.uniform(-1.5, 1.5, 2000))
    for channels in (
        h,
        aligned,
        scale * (1 + 0.1 * h),
        np.abs(h.real) + 1j * np.abs(h.imag),
        h[:50],
    ):
        check_parts("h", channels)


def test_a_single_receiver_needs_no_index(file):
    changed(file, rx=arrays()["rx"][:1], rx_index=None)
    assert csi_npz.read(file).query.receivers.tolist() == [0] * 10
    changed(file, rx_index=None)
    with pytest.raises(ValueError, match="rx_index: expected one array of whole numbers"):
        csi_npz.read(file)


def test_wrong_names_of_arrays_are_refused(file):
    for names, message in (
        (
            {"H": "CSI"},
            "data.arrays has no array 'H'; it has: tx, rx, rx_index, frequencies, h, elements",
        ),
        (
            {"h": "CSI"},
            "h: expected one array of complex numbers of (n, e, s), got 0 called 'CSI' among "
            "['tx',",
        ),
        ({"tx": ["x", "y"]}, "tx: data.arrays has 2 names"),
    ):
        with pytest.raises(ValueError, match=re.escape(message)):
            csi_npz.read(file, names)


@pytest.mark.parametrize("save", [save_mat, save_mat73])
def test_damaged_matlab_files_are_refused(tmp_path, save):
    path = tmp_path / "room.mat"
    save(path, arrays())
    content = path.read_bytes()
    for part in (content[: len(content) // 2], content[:600], b"no file of MATLAB"):
        path.write_bytes(part)
        with pytest.raises(ValueError, match=r"cannot parse .*room\.mat"):
            csi_npz.read(path)


def test_the_reader_declares_the_phase(file):
    assert (
        load({"name": "csi_npz", "file": str(file), "phase": "per_link"}, RANDOM).task.phase
        == "per_link"
    )


def test_receivers_may_have_different_numbers_of_elements(file):
    """The third receiver lacks its first element."""
    content = arrays()
    elements, h = np.stack([content["elements"]] * 3), content["h"]
    elements[2, 0] = np.nan
    at_third = content["rx_index"] == 2
    with pytest.raises(ValueError, match=r"h\[1, 0\]: expected 0 at an element without a position"):
        csi_npz.read(changed(file, elements=elements))
    h[at_third, 0] = 0
    links = read(changed(file, elements=elements, h=h))
    assert [len(receiver.array) for receiver in links.receivers] == [3, 2]
    np.testing.assert_array_equal(
        links.receivers[1].array.elements, elements[2, 1:].astype(np.float32)
    )
    np.testing.assert_array_equal(
        links.labels[at_third][:, :2], h[at_third][:, 1:].astype(np.complex64)
    )
    assert not links.labels[at_third][:, 2].any()
    check_data(links)
    elements[1] = np.nan
    with pytest.raises(
        ValueError, match=r"elements\[1\]: expected an element of each receiver, got NaN alone"
    ):
        read(changed(file, elements=elements, h=h))


def test_real_and_imaginary_part_have_one_shape(tmp_path):
    content = arrays()
    channels = content.pop("h")
    parts = {"re": channels.real, "im": channels.imag[..., :1]}
    np.savez(tmp_path / "parts.npz", **content, **parts)
    with pytest.raises(
        ValueError, match="real and imaginary part of h must be real and of one shape"
    ):
        load(
            {"name": "csi_npz", "file": str(tmp_path / "parts.npz"), "arrays": {"h": ["re", "im"]}},
            RANDOM,
        )


def in_band(frequency, seed):
    """Five places to two receivers with one element at two subcarriers."""
    draw = np.random.default_rng(seed)
    return {
        "tx": draw.uniform(-3, 3, (5, 3)).repeat(2, 0),
        "rx": np.array([[0.0, 0.0, 2.5], [4.0, 1.0, 2.25]]),
        "rx_index": np.tile([0, 1], 5),
        "frequencies": frequency + np.array([1e6, 0.0]),
        "h": draw.normal(size=(10, 1, 2)) + 1j * draw.normal(size=(10, 1, 2)),
    }


def test_files_of_two_bands_have_a_radio_for_each(tmp_path):
    low, high = in_band(2.4e9, 0), in_band(5.8e9, 1)
    high["rx"] = high["rx"][::-1]  # the same receivers in another order
    files = [save(tmp_path / "low.npz", low), save(tmp_path / "high.npz", high)]
    links = load({"name": "csi_npz", "file": [str(file) for file in files]}, RANDOM)
    names = [receiver.name for receiver in links.receivers]
    assert names == ["rx0 2.401 GHz", "rx1 2.401 GHz", "rx1 5.801 GHz", "rx0 5.801 GHz"]
    assert links.task.frequencies.tolist() == [2.4e9, 2.401e9, 5.8e9, 5.801e9]
    for content, receivers, own in ((low, (0, 1), slice(0, 2)), (high, (2, 3), slice(2, 4))):
        for number, receiver in enumerate(receivers):
            rows = links.query.receivers == receiver
            expected = content["h"][number::2][..., ::-1].astype(np.complex64)
            np.testing.assert_array_equal(links.labels[rows][..., own], expected)
            assert links.labels[rows].count_nonzero() == expected.size
            places = content["tx"][number::2].astype(np.float32)
            np.testing.assert_array_equal(links.query.transmitters[rows], places)
    check_data(links)


def test_one_file_of_two_bands_is_divided(tmp_path):
    low = in_band(2.4e9, 0)
    high = in_band(5.8e9, 1)
    low["h"][:4] = 0  # these links are measured in the other band alone
    both = low | {
        "h": np.concatenate((low["h"], high["h"]), 2),
        "frequencies": np.concatenate((low["frequencies"], high["frequencies"])),
    }
    links = read(save(tmp_path / "both.npz", both))
    assert links.query.receivers.bincount().tolist() == [3, 3, 5, 5]
    assert len(links.rows.unique()) == 5
    model = gaigs.train("friis", links)
    predicted = model.predict([[1.0, 1.0, 1.0]])
    assert {name: part.shape for name, part in predicted.items()} == {
        receiver.name: (1, 1, 2) for receiver in links.receivers
    }
    one = model.predict([[1.0, 1.0, 1.0]], receiver="rx0 5.801 GHz")
    assert torch.equal(one, predicted["rx0 5.801 GHz"])
    assert one.abs().min() > 0


def test_subcarriers_of_one_band_must_agree(tmp_path):
    contents = in_band(2.4e9, 0), in_band(2.42e9, 1)
    files = [save(tmp_path / f"{k}.npz", content) for k, content in enumerate(contents)]
    with pytest.raises(ValueError, match=r"same subcarriers, got 2 of 4 near 2.4 GHz"):
        load({"name": "csi_npz", "file": [str(file) for file in files]}, RANDOM)


@pytest.mark.parametrize(
    ("frequencies", "options"),
    [(np.linspace(3.1e9, 10.6e9, 8), {}), (np.array([2.4e9, 5.8e9]), {"band_gap": 3.0})],
)
def test_sweeps_and_carriers_of_one_channel_are_one_band(tmp_path, frequencies, options):
    content = in_band(2.4e9, 0) | {"frequencies": frequencies, "h": np.ones((10, 1, 1)) + 0j}
    content["h"] = content["h"].repeat(len(frequencies), 2)
    file = save(tmp_path / "sweep.npz", content)
    links = load({"name": "csi_npz", "file": str(file), **options}, RANDOM)
    assert [receiver.name for receiver in links.receivers] == ["rx0", "rx1"]
    assert links.labels.all()


def test_arrays_that_move_hear_a_few_beacons(tmp_path):
    draw = np.random.default_rng(0)
    content = {
        "tx": draw.uniform(-3, 3, (4, 3)).repeat(20, 0),
        "rx": draw.uniform(-3, 3, (20, 3)),
        "rx_index": np.tile(np.arange(20), 4),
        "frequencies": np.array([2.4e9, 2.5e9]),
        "h": draw.normal(size=(80, 1, 2)) + 1j,
    }
    config = {"name": "csi_npz", "file": str(save(tmp_path / "a.npz", content))}
    links = load(config, RANDOM)
    assert links.one_radio
    assert "places of one radio" in links.remarks
    assert not load(config | {"one_radio": False}, RANDOM).one_radio
    with pytest.raises(ValueError, match="channels of one band"):
        load(config | {"one_radio": True, "band_gap": 1.01}, RANDOM)
