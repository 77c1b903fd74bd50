"""Damaged files of every reader: the links are whole and within their bounds, or one error names the file."""

import io
import random
import re

import numpy as np
import pytest
import torch
from PIL import Image

from gaigs.data import csi_npz, nerf2_rssi, nerf2_spectrum, rssi_csv
from gaigs.geometry import FAR
from gaigs.query import CARRIERS
from gaigs.registry import registry

COUNT = 140
"""Damages of each reader's files."""

NUMBERS = """nan -nan inf -inf .inf .nan 0 -0 -0.0 1e300 -1e300 1e400 1e-300 -1e-300 1e38 -1e38 1e-45 99999.999 1e5 -1e5
1_0 0x10 0b1 010 -010 1:30 2024-01-01 true null ~ 1e 1,5 1;5 "5" "5 5" '5' "5"6 １ ٣ 1d3 +5 -100 -99.999 -200 127
9223372036854775808 18446744073709551616 !!float_5 !x_5 *a &a_5 {} [] [5] # : , - -- | > % @ ` \\""".replace("_5", " 5")
"""What a number of a text is replaced with, besides whole ones of hundreds and thousands of digits."""

WORDS = [*NUMBERS.split(), "", " ", "9" * 400, "9" * 5000, "1" + "0" * 399]


def table(*rows):
    return "".join(f"{row}\n" for row in rows).encode()


def spectra():
    """Three spectra, whose smooth pixels take few bytes."""
    files = {
        "tx_pos.csv": table("x,y,z", "1.5,-1,0.25", "2.5,-2,0.25", "3.5,-3,0.25"),
        "gateway_info.yml": table(
            "dataset_name: s23", "gateway1:", "  position: [5.0, 0.26, 0]", "  orientation: [0.5, -0.5, -0.5, 0.5]  # q"
        ),
        "train_index.txt": table("00003", "00001"),
        "test_index.txt": table("00002"),
        "freq.txt": table("2.4", "2.45", "2.4"),
    }
    for k in range(1, 4):
        pixels = np.add.outer(k * np.arange(90), np.arange(360)) % 256
        stream = io.BytesIO()
        Image.fromarray(pixels.astype(np.uint8)).save(stream, "png")
        files[f"spectrum/{k:05d}.png"] = stream.getvalue()
    return files


def levels():
    """Six rows at two gateways, one position as a list of lines, and a wall."""
    return {
        "tx_pos.csv": table("x,y,z", *(f"{k}.5,{-k},0.25" for k in range(6))),
        "gateway_rssi.csv": table("west,east", "-50.5,-61", "-52,-100", "-54,-65", "-100,-72", "-58.25,-69", "-60,-71"),
        "gateway_position.yml": table("east: [5.0, 1, 2]", "west:", "- 0.5", "- 1", "- 2"),
        "train_index.txt": table(4, 0, 1),
        "test_index.txt": table(5, 2),
        "layout.csv": table("0,0", "4,0", "4,3.5", "0,0"),
    }


def readings():
    """One table of two fixed receivers."""
    lines = (
        f'{k}.25,{k % 3},1.1,{3.9 if k % 2 else 0.1},2.7,2.2,-{50 + k}.5,"note, {k}"' for k in range(8)
    )  # a column of no reader's, whose cells have quotes
    return {
        "room.csv": table("tx_x,tx_y,tx_z,rx_x,rx_y,rx_z,rss_dbm,note", *lines),
        "walls.csv": table("x,y", "0,0", "4,0", "4,3.5"),
    }


def channels(**changes):
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
    stream = io.BytesIO()
    np.savez(stream, **{name: array for name, array in (arrays | changes).items() if array is not None})
    return {"room.npz": stream.getvalue()}


READERS = {
    "nerf2_spectrum": (nerf2_spectrum.read, spectra, lambda root: {"root": root}),
    "nerf2_rssi": (nerf2_rssi.read, levels, lambda root: {"root": root}),
    "rssi_csv": (rssi_csv.read, readings, lambda root: {"file": root / "room.csv", "layout": root / "walls.csv"}),
    "csi_npz": (csi_npz.read, channels, lambda root: {"file": root / "room.npz"}),
}


# --- damages: each takes bytes and a generator, and gives bytes ---


def flip(content, draw):
    at = draw.randrange(len(content))
    return content[:at] + bytes([content[at] ^ 1 << draw.randrange(8)]) + content[at + 1 :]


def truncate(content, draw):
    return content[: draw.randrange(len(content))]


def insert(content, draw):
    at = draw.randrange(len(content) + 1)
    return content[:at] + draw.choice([draw.randbytes(3), b"\0", b'"', b"[", b"\\", b"\x0c", b"\xe9"]) + content[at:]


def delete(content, draw):
    at = draw.randrange(len(content))
    return content[:at] + content[at + draw.randint(1, 8) :]


def renumber(content, draw):
    places = [match.span() for match in re.finditer(rb"-?\d+\.?\d*", content)]
    start, stop = draw.choice(places)
    return content[:start] + draw.choice(WORDS).encode() + content[stop:]


def drop_line(content, draw):
    lines = content.splitlines(keepends=True)
    lines.pop(draw.randrange(len(lines)))
    return b"".join(lines)


def repeat_line(content, draw):
    lines = content.splitlines(keepends=True)
    lines.insert(draw.randrange(len(lines) + 1), draw.choice(lines))
    return b"".join(lines)


def recode(content, draw):
    text = content.decode()
    coded = {"utf-16": text, "utf-16-le": text, "utf-32": text, "latin-1": f"é{text}", "utf-8-sig": text, "cp500": text}
    name = draw.choice([*coded])
    return coded[name].encode(name)


def nest(content, draw):
    at = content.index(b"[") if b"[" in content else draw.randrange(len(content))
    return content[:at] + 600 * draw.choice([b"[", b"{", b"- ", b'"']) + content[at:]


def change_array(content, draw):
    """Another value in one array, another type, another shape, or no such array."""
    with np.load(io.BytesIO(content)) as stored:
        name = draw.choice(stored.files)
        array = stored[name]
    value = draw.choice([np.nan, np.inf, -1, 0, 1e300, -1e300, 1e38, 1e-45, 1e20, 99999.9999, 2**63 - 1])
    dtype = draw.choice(["f2", "f4", "f8", "g", "c8", "G", "i1", "u8", "i8", "?", "U3", "S2", "M8[s]", "V8", "O"])
    match draw.randrange(4):
        case 0:
            array = array.astype(complex if name == "h" else float)
            array.flat[draw.randrange(array.size)] = value
        case 1 | 2 as kind:
            with np.errstate(all="ignore"):
                array = (array.real if dtype[0] not in "cG" else array).astype("f8" if dtype[0] in "MV" else dtype)
            array = array[draw.randrange(2) :] if kind == 1 else array.reshape(-1)
        case 3:
            return channels(**{name: None})["room.npz"]
    return channels(**{name: array})["room.npz"]


BYTES = [flip, flip, truncate, insert, delete]
TEXTS = [*BYTES, renumber, renumber, renumber, drop_line, repeat_line, recode, nest]


def damages(name):
    kinds = {"png": BYTES, "npz": [*BYTES, *[change_array] * 6]}
    return kinds.get(name[-3:], TEXTS)


# --- what is left of them ---


def within(values, low, high):
    return bool(torch.isfinite(values).all() and (values >= low).all() and (values <= high).all())


def check_links(links):
    places = [links.query.transmitters, links.edges]
    places += [place for receiver in links.receivers for place in (receiver.pose.position, receiver.array.elements)]
    assert all(within(place, -FAR, FAR) for place in places)
    assert all(within(receiver.pose.rotation, -1.001, 1.001) for receiver in links.receivers)
    assert all(receiver.name.isprintable() for receiver in links.receivers)
    assert links.query.frequencies is None or within(links.query.frequencies, *CARRIERS)
    labels = links.labels[torch.arange(len(links))]
    assert len(labels) == len(links) > 0
    match links.task.name:
        case "spectrum":
            assert within(labels, 0, 1)
        case "rssi":
            assert within(labels, rssi_csv.QUIETEST, 0)
        case "csi":
            assert within(labels.abs().flatten(1).amax(1), *csi_npz.STRENGTHS)
            assert within(links.task.frequencies, *CARRIERS)
    if links.official:
        train, test = links.official()
        assert len(train)
        assert len(test)
        assert not set(train.tolist()) & set(test.tolist())
        assert set(train.tolist()) | set(test.tolist()) <= {*range(len(links))}
    return labels


def outcome(read, options, file):
    """The labels, or what the error says."""
    try:
        return check_links(read(**options))
    except (ValueError, FileNotFoundError) as error:
        kind, message = type(error), str(error)
    assert kind in (ValueError, FileNotFoundError)
    assert file.name in message
    assert message.replace("\n", "").isprintable()
    assert len(message) < 6000
    return message


def run(root, reader, seed, count):
    """The damages one after the other, each to a file that is then whole again; yields what is left of the links."""
    read, make, options = READERS[reader]
    files = make()
    for name, content in files.items():
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).write_bytes(content)
    options = {key: str(value) for key, value in options(root).items()}
    whole = outcome(read, options, root)
    assert isinstance(whole, torch.Tensor)
    draw = random.Random(seed)
    for number in range(count):
        name = draw.choice([*files])
        damage = draw.choice(damages(name))
        content = damage(files[name], draw)
        (root / name).write_bytes(content)
        try:
            yield name, damage, whole, outcome(read, options, root / name)
        except BaseException as error:
            error.add_note(f"{reader}, seed {seed}, damage {number}, {damage.__name__} of {name}: {content[:2000]!r}")
            raise
        (root / name).write_bytes(files[name])


@pytest.mark.parametrize("reader", READERS)
def test_a_damaged_file_is_read_or_named(tmp_path, reader):
    refused = []
    for name, damage, whole, left in run(tmp_path, reader, 0, COUNT):
        refused.append(isinstance(left, str))
        # What has checksums is as it was, or refused.
        if damage in BYTES and name.endswith(("png", "npz")) and not refused[-1]:
            assert torch.equal(left, whole)
    assert 0.1 < sum(refused) / COUNT < 0.95


def test_every_reader_of_files_is_here():
    made = ("sionna", "synthetic")
    assert {*READERS} == {name for name in registry("data").names() if not name.startswith(made)}
