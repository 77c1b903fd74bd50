"""The built-in scene: repeatable, learnable, and the same from its folder."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light
from skimage.metrics import structural_similarity

from gaigs.data import load
from gaigs.data.synthetic import REGION, ROOM, edges, spectra, wavefront_obj
from gaigs.data.synthetic.image_source import is_free
from gaigs.geometry import Grid
from gaigs.io.meshes import parse_obj
from gaigs.testing import check_data

OFFICIAL = {"name": "official", "validation": 0}
CARRIERS = [5e9, 6.4896e9, 3.1e9]


def furnished_room(split=OFFICIAL, **options):
    return load({"name": "synthetic", **options}, split)


def read(folder, **options):
    return load({"name": "nerf2_spectrum", "root": str(folder), **options}, OFFICIAL)


@pytest.fixture(scope="module")
def scene():
    return furnished_room()


@pytest.fixture(scope="module")
def small():
    return furnished_room(transmitters=10, seed=5)


def median_ssim(labels, predictions):
    scores = [
        structural_similarity(a.numpy(), b.numpy(), data_range=1) for a, b in zip(labels, predictions, strict=True)
    ]
    return np.median(scores)


def look_up(links):
    """Test labels with the mean of the training spectra, and with the three nearest by inverse squared distance."""
    train, test = links.split.train, links.split.test
    known = links.labels[train]
    distances, nearest = torch.cdist(links.query.transmitters[test], links.query.transmitters[train]).topk(
        3, largest=False
    )
    weights = distances**-2
    guesses = torch.einsum("bk,bkij->bij", weights / weights.sum(1, keepdim=True), known[nearest])
    return links.labels[test], known.mean(0).expand(len(test), -1, -1), guesses


def test_a_look_up_learns_the_default_scene_and_leaves_room_above(scene):
    assert (len(scene.split.train), len(scene.split.test)) == (400, 100)
    labels, mean, nearest = look_up(scene)
    assert 0.45 < median_ssim(labels, mean) < 0.6
    assert 0.85 < median_ssim(labels, nearest) < 0.92


def test_labels_are_those_of_measured_sets(scene):
    check_data(scene)
    labels = scene.labels
    assert labels.dtype == torch.float32
    assert labels.shape == (500, 90, 360)
    assert labels.amin((1, 2)).tolist() == [0] * 500
    assert labels.amax((1, 2)).tolist() == [1] * 500
    assert (labels[:, -1] - labels[:, -1, :1]).abs().max() < 1e-5  # at the zenith azimuth means nothing


def test_transmitters_stand_free_in_their_region(scene):
    transmitters = scene.query.transmitters
    assert len(torch.unique(transmitters, dim=0)) == 500
    assert is_free(ROOM, transmitters).all()
    lower, upper = torch.tensor(REGION)
    assert ((transmitters >= lower) & (transmitters <= upper)).all()
    assert (transmitters.amax(0) - transmitters.amin(0) > 0.95 * (upper - lower)).all()


# --- array and carriers ---


def test_the_array_is_square_and_half_a_wavelength_apart(small):
    (receiver,) = small.receivers
    assert receiver.array.pattern == "cosine"
    half = speed_of_light / 6.4896e9 / 2
    elements = (receiver.array.elements / half).round(decimals=4).tolist()
    assert {tuple(element) for element in elements} == {
        (i / 2, j / 2, 0) for i in (-3, -1, 1, 3) for j in (-3, -1, 1, 3)
    }
    assert small.query.frequencies.tolist() == [6.4896e9] * 10


def test_each_place_sends_at_each_carrier():
    links = furnished_room(transmitters=6, seed=5, frequency=CARRIERS)
    places = furnished_room(transmitters=6, seed=5).query.transmitters
    assert len(links) == 18
    assert torch.equal(links.query.transmitters, places.repeat_interleave(3, 0))
    assert torch.equal(links.query.frequencies, torch.tensor(CARRIERS).repeat(6))
    assert links.rows.tolist() == [k // 3 for k in range(18)]
    assert links.split.train.tolist() == list(range(15))
    assert links.split.test.tolist() == [15, 16, 17]
    assert links.scene.has_band
    check_data(links)


def test_the_array_of_several_carriers_is_that_of_the_highest():
    links = furnished_room(transmitters=6, seed=5, frequency=CARRIERS)
    alone = furnished_room(transmitters=6, seed=5, frequency=max(CARRIERS))
    assert torch.equal(links.receivers[0].array.elements, alone.receivers[0].array.elements)
    assert torch.equal(links.labels[1::3], alone.labels)
    lowest = furnished_room(transmitters=6, seed=5, frequency=3.1e9)
    assert (links.labels[2::3] - lowest.labels).abs().max() > 0.1  # its own array would be twice as wide
    own = Grid.degrees(), "band", 3.1e9, 499.2e6, 2
    assert torch.equal(links.labels[2::3], spectra(ROOM, lowest.query.transmitters, links.receivers[0], *own))


# --- geometry ---


def test_edges_are_those_of_the_cuboids():
    lines = edges(ROOM)
    assert lines.shape == (12 * (1 + len(ROOM.furniture)), 2, 3)
    steps = (lines[:, 1] - lines[:, 0]).abs()
    assert ((steps > 0).sum(-1) == 1).all()  # each along one axis
    room = steps[:12].amax(-1).sort().values
    assert room.tolist() == pytest.approx([3] * 4 + [5] * 4 + [7] * 4)
    assert len(torch.unique(lines.flatten(1), dim=0)) == len(lines)
    for box, part in zip(ROOM.furniture, lines[12:].split(12), strict=True):
        assert part.amin((0, 1)).tolist() == pytest.approx(box.lower)
        assert part.amax((0, 1)).tolist() == pytest.approx(box.upper)


def test_obj_faces_lie_on_the_walls_and_face_outwards():
    vertices, groups = parse_obj(wavefront_obj(ROOM).splitlines(), "room.obj")
    cuboids = [((0, 0, 0), ROOM.size, ROOM.walls)]
    cuboids += [(box.lower, box.upper, (f"loss_{box.loss_db}_db",) * 6) for box in ROOM.furniture]
    found = set()
    for (_, material), group in groups.items():
        for face in group:
            lower, upper, materials = cuboids[face[0] // 8]
            corners = vertices[list(face)]
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
            axis = int(np.argmax(np.abs(normal)))
            side = int(normal[axis] > 0)
            found.add((face[0] // 8, axis, side))
            assert material == materials[2 * axis + side]
            np.testing.assert_allclose(corners[:, axis], (lower, upper)[side][axis])
            assert np.linalg.norm(normal) == pytest.approx(np.prod(np.delete(np.subtract(upper, lower), axis)))
            np.testing.assert_allclose(corners[0] + corners[2], corners[1] + corners[3])  # a rectangle's diagonals
    assert len(found) == 6 * len(cuboids)


def test_the_documented_room_is_simulated_and_written(tmp_path, monkeypatch):
    text = (Path(__file__).parents[2] / "docs" / "data.md").read_text(encoding="utf-8")
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "my_room" in block]
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    exec(code, {})
    links = read(tmp_path / "my_room")
    assert (len(links.split.train), len(links.split.test)) == (160, 40)
