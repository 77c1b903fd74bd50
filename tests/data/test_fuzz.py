"""Damaged files of every reader: the links keep the contract and their bounds, or one error names
the file.
"""

import io
import random

import numpy as np
import pytest
import torch
from damages import BYTES, TEXTS
from gaigs_deepmimo.readers import read_channels

from gaigs.data import csi_npz, nerf2_rssi, nerf2_spectrum, rssi_csv, rssi_wide
from gaigs.data.readings import LOUDEST
from gaigs.io import FAR
from gaigs.io.deepmimo import Station, write_scenario
from gaigs.testing import check_data

COUNT = 100
"""Damages of each reader's files."""


def saved(arrays):
    stream = io.BytesIO()
    np.savez(stream, **arrays)
    return stream.getvalue()


def channels():
    """Ten links of an array of three elements at four subcarriers."""
    draw = np.random.default_rng(0)
    arrays = {
        "tx": draw.uniform(-3, 3, (10, 3)),
        "rx": np.array([[0.0, 0.0, 2.5], [4.0, 1.0, 2.25]]),
        "rx_index": np.arange(10) % 2,
        "frequencies": np.linspace(2.40e9, 2.46e9, 4),
        "h": draw.normal(size=(10, 3, 4)) + 1j * draw.normal(size=(10, 3, 4)),
        "elements": np.array([[-0.06, 0, 0], [0, 0, 0], [0.06, 0, 0.01]]),
    }
    return saved(arrays)


@pytest.fixture
def files(request, tmp_path, reader):
    """The function that reads a whole data set, and its files."""
    match reader:
        case "nerf2_spectrum":
            root = request.getfixturevalue("spectrum_folder")
            (root / "freq.txt").write_text("2.4\n2.45\n" * 3)

            def read():
                return nerf2_spectrum.read(str(root))

        case "nerf2_rssi":
            root = request.getfixturevalue("rssi_folder")
            (root / "layout.csv").write_text("0,0\n4,0\n4,3.5\n0,0\n")

            def read():
                return nerf2_rssi.read(str(root))

        case "rssi_csv":
            # The last column is no reader's, and its cells have quotes.
            rows = [
                f'{k}.25,{k % 3},1.1,{k % 2}.5,2.7,2.2,-{50 + k}.5,"note, {k}"' for k in range(8)
            ]
            (tmp_path / "room.csv").write_text(
                "\n".join(["tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,rss_dbm,note", *rows])
            )
            (tmp_path / "walls.csv").write_text("x,y\n0,0\n4,0\n4,3.5\n")
            read, root = (
                lambda: rssi_csv.read(tmp_path / "room.csv", tmp_path / "walls.csv"),
                tmp_path,
            )
        case "rssi_wide":
            rows = [
                f"{k}.25;{k % 3};-{50 + k},5;{-60 - k if k % 2 else 100};note {k}" for k in range(8)
            ]
            (tmp_path / "room.csv").write_text("\n".join(["x;y;door;hall;note", *rows]))
            (tmp_path / "aps.csv").write_text("name,x,y,z\ndoor,0,0,2\nhall,4,1,2\n")
            read, root = (
                lambda: rssi_wide.read(tmp_path / "room.csv", str(tmp_path / "aps.csv")),
                tmp_path,
            )
        case "csi_npz":
            (tmp_path / "room.npz").write_bytes(channels())
            read, root = lambda: csi_npz.read(tmp_path / "room.npz"), tmp_path
        case "deepmimo":
            draw, root = np.random.default_rng(0), tmp_path
            points, gains = draw.uniform(1, 3, (10, 4, 1, 3)), draw.normal(size=(10, 4)) * 1e-3j
            station = Station(np.array([0.0, 0.0, 2.5]), gains, points)
            write_scenario(root, 3.5e9, draw.uniform(-3, 3, (10, 3)), [station])
            for unread in (
                *root.glob("aoa*"),
                *root.glob("inter_pos*"),
                root / "objects.json",
                root / "vertices.npz",
            ):
                unread.unlink()

            def read():
                return read_channels(root, subcarriers=4)

    return read, sorted(file for file in root.rglob("*") if file.is_file())


def change_array(content, draw):
    """Another value in one array, another type, another shape, or no such array."""
    with np.load(io.BytesIO(content)) as stored:
        name, arrays = draw.choice(stored.files), dict(stored)
    array = arrays.pop(name)
    value = draw.choice(
        [np.nan, np.inf, -1, 0, 1e300, -1e300, 1e38, 1e-45, 1e20, 99999.9999, 2**63 - 1]
    )
    dtype = draw.choice(
        ["f2", "f4", "f8", "g", "c8", "G", "i1", "u8", "i8", "?", "U3", "S2", "M8[s]", "V8", "O"]
    )
    match draw.randrange(4):
        case 0:
            array = array.astype(complex if name == "h" else float)
            array.flat[draw.randrange(array.size)] = value
        case 1 | 2 as kind:
            with np.errstate(all="ignore"):
                array = (array.real if dtype[0] not in "cG" else array).astype(
                    "f8" if dtype[0] in "MV" else dtype
                )
            array = array[draw.randrange(2) :] if kind == 1 else array.reshape(-1)
        case 3:
            return saved(arrays)
    return saved(arrays | {name: array})


def within(values, low, high):
    return bool(torch.isfinite(values).all() and (values >= low).all() and (values <= high).all())


def check_links(links):
    check_data(links)
    places = [links.query.transmitters, links.edges]
    places += [
        place
        for receiver in links.receivers
        for place in (receiver.pose.position, receiver.array.elements)
    ]
    assert all(within(place, -FAR, FAR) for place in places)
    labels = links.labels[torch.arange(len(links))]
    if links.task.name == "rssi":
        assert within(labels, rssi_csv.QUIETEST, LOUDEST)
    if links.task.name == "csi":
        assert within(labels.abs().flatten(1).amax(1), 1e-18, 1e18)
    return labels


def outcome(read, file):
    """The labels, or the error's message."""
    try:
        return check_links(read())
    except (ValueError, FileNotFoundError) as error:
        kind, message = type(error), str(error)
    assert kind in (ValueError, FileNotFoundError)
    assert file.name in message
    assert message.isprintable()
    assert len(message) < 1000
    return message


@pytest.mark.parametrize(
    "reader", ["nerf2_spectrum", "nerf2_rssi", "rssi_csv", "rssi_wide", "csi_npz", "deepmimo"]
)
def test_a_damaged_file_is_read_or_named(files, reader):
    read, paths = files
    whole = check_links(read())
    contents = [path.read_bytes() for path in paths]
    draw = random.Random(0)
    refused = []
    for _ in range(COUNT):
        path, content = draw.choice([*zip(paths, contents, strict=True)])
        kinds = {".png": BYTES, ".npz": [*BYTES, *[change_array] * 6]}.get(path.suffix, TEXTS)
        damage = draw.choice(kinds)
        damaged = damage(content, draw)
        path.write_bytes(damaged)
        try:
            left = outcome(read, path)
        except BaseException as error:
            error.add_note(f"{damage.__name__} of {path}: {damaged[:2000]!r}")
            raise
        path.write_bytes(content)
        refused.append(isinstance(left, str))
        # Bytes with checksums are as they were, or refused.
        if damage in BYTES and path.suffix in (".png", ".npz") and not refused[-1]:
            assert torch.equal(left, whole)
    assert 0.1 < sum(refused) / COUNT < 1
