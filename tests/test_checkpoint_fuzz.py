"""Files of models, damaged at random: refused in one sentence, or none the worse."""

import io
import random
from pathlib import Path
from zipfile import ZipFile

import pytest
import torch

import gaigs
from gaigs import checkpoint

OLD = Path(__file__).parent / "checkpoints" / "version_0_rssi.ckpt"
PLACES = [[2.0, 3.0, 1.5], [4.5, 1.0, 1.0]]


@pytest.fixture(scope="module")
def sealed(tmp_path_factory):
    content = checkpoint.read(OLD)
    content[checkpoint.KEY] |= {"version": checkpoint.VERSION}
    content[checkpoint.KEY]["model"]["rasterizer"] = {"name": "torch"}
    path = tmp_path_factory.mktemp("model") / "best.ckpt"
    checkpoint.write(content, path)
    return path


@pytest.fixture(scope="module")
def unsealed(sealed, tmp_path_factory):
    """As version 1 was written."""
    content = checkpoint.read(sealed)
    content[checkpoint.KEY] |= {"version": 1}
    path = tmp_path_factory.mktemp("model") / "best.ckpt"
    torch.save(content, path)
    return path


@pytest.fixture(scope="module")
def truth(sealed):
    return gaigs.load(sealed).predict(PLACES)


def flip(data, draw, count):
    data = bytearray(data)
    for _ in range(count):
        data[draw.randrange(len(data))] ^= 1 << draw.randrange(8)
    return bytes(data)


def repack(change):
    """An archive written anew, by another program, with its parts changed."""

    def mutate(data, draw):
        with ZipFile(io.BytesIO(data)) as archive:
            parts = [(name, archive.read(name)) for name in archive.namelist()]
            comment = archive.comment
        file = io.BytesIO()
        with ZipFile(file, "w") as archive:
            for name, part in change(parts, draw):
                archive.writestr(name, part)
            archive.comment = comment
        return file.getvalue()

    return mutate


def remove(parts, draw):
    parts.pop(draw.randrange(len(parts)))
    return parts


def rename(parts, draw):
    number = draw.randrange(len(parts))
    parts[number] = (parts[number][0] + "0", parts[number][1])
    return parts


def swap(parts, draw):
    """Two weights of one size change places."""
    by_size = {}
    for number, (name, part) in enumerate(parts):
        if "/data/" in name:
            by_size.setdefault(len(part), []).append(number)
    a, b = draw.sample(draw.choice([numbers for numbers in by_size.values() if len(numbers) > 1]), 2)
    parts[a], parts[b] = (parts[a][0], parts[b][1]), (parts[b][0], parts[a][1])
    return parts


def reorder(parts, draw):
    draw.shuffle(parts)
    return parts


MUTATIONS = {
    "one bit": (20, lambda data, draw: flip(data, draw, 1)),
    "three bits": (12, lambda data, draw: flip(data, draw, 3)),
    "one bit of the last kilobyte": (8, lambda data, draw: data[:-1024] + flip(data[-1024:], draw, 1)),
    "truncated": (6, lambda data, draw: data[: draw.randrange(len(data))]),
    "more behind it": (2, lambda data, draw: data + draw.randbytes(draw.randrange(1, 200))),
    "a part removed": (3, repack(remove)),
    "a part renamed": (3, repack(rename)),
    "parts swapped": (3, repack(swap)),
    "parts reordered": (3, repack(reorder)),
}


def refused(data, path, truth):
    """Whether a file is refused, and how it should be; one that is taken must predict as it did."""
    path.write_bytes(data)
    try:
        model, told = gaigs.load(path), ""
    except ValueError as error:
        model, told = None, str(error)
    if model is not None:
        assert torch.equal(model.predict(PLACES), truth)
        return False
    assert told.startswith(f"{path} must ")
    assert "\n" not in told
    assert "weights_only" not in told
    return True


@pytest.mark.parametrize("mutation", MUTATIONS)
def test_any_change_of_a_sealed_file_is_found(mutation, sealed, truth, tmp_path):
    count, mutate = MUTATIONS[mutation]
    data, draw = sealed.read_bytes(), random.Random(mutation)
    for _ in range(count):
        changed = mutate(data, draw)
        assert changed != data
        assert refused(changed, tmp_path / "best.ckpt", truth)


@pytest.mark.parametrize("mutation", ["one bit", "three bits", "truncated"])
def test_a_damaged_file_without_a_seal_predicts_nothing_else(mutation, unsealed, truth, tmp_path):
    """Bits that no check sum covers say nothing of the model, such as when the file was written: it is taken then."""
    _, mutate = MUTATIONS[mutation]
    data, draw = unsealed.read_bytes(), random.Random(mutation)
    found = [refused(mutate(data, draw), tmp_path / "best.ckpt", truth) for _ in range(5)]
    assert any(found)


def test_a_file_without_a_seal_is_read(unsealed, truth, tmp_path):
    assert not refused(unsealed.read_bytes(), tmp_path / "best.ckpt", truth)


def test_a_file_that_lost_its_seal_is_refused(sealed, tmp_path):
    torch.save(checkpoint.read(sealed), tmp_path / "best.ckpt")
    with pytest.raises(
        ValueError, match=r"best\.ckpt must end in its seal, and has none: .* gaigs\.checkpoint\.write$"
    ):
        gaigs.load(tmp_path / "best.ckpt")


def test_the_same_content_is_written_as_the_same_predictions(sealed, truth, tmp_path):
    checkpoint.write(checkpoint.read(sealed), tmp_path / "best.ckpt")
    assert torch.equal(gaigs.load(tmp_path / "best.ckpt").predict(PLACES), truth)
