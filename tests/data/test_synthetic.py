"""The built-in scene: repeatable, learnable, and the same from its folder."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

import gaigs
from gaigs.core.geometry import Grid
from gaigs.data import load
from gaigs.data.synthetic import REGION, ROOM, meshes, spectra
from gaigs.data.synthetic.image_source import is_free
from gaigs.io.meshes import parse_obj, wavefront_obj
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


def test_labels_are_those_of_measured_sets(scene):
    check_data(scene)
    labels = scene.labels
    assert labels.dtype == torch.float32
    assert labels.shape == (500, 90, 360)
    assert labels.amin((1, 2)).tolist() == [0] * 500
    assert labels.amax((1, 2)).tolist() == [1] * 500
    assert (
        labels[:, -1] - labels[:, -1, :1]
    ).abs().max() < 1e-5  # at the zenith azimuth means nothing


def test_transmitters_stand_free_in_their_region(scene):
    transmitters = scene.query.transmitters
    assert len(torch.unique(transmitters, dim=0)) == 500
    assert is_free(ROOM, transmitters).all()
    lower, upper = torch.tensor(REGION)
    assert ((transmitters >= lower) & (transmitters <= upper)).all()
    assert (transmitters.amax(0) - transmitters.amin(0) > 0.95 * (upper - lower)).all()


# --- array and carriers ---


def test_each_place_sends_at_each_carrier():
    links = furnished_room(transmitters=6, seed=5, frequency=CARRIERS)
    places = furnished_room(transmitters=6, seed=5).query.transmitters
    assert len(links) == 18
    assert torch.equal(links.query.transmitters, places.repeat_interleave(3, 0))
    assert torch.equal(links.query.frequencies, torch.tensor(CARRIERS).repeat(6))
    assert links.rows.tolist() == [k // 3 for k in range(18)]
    assert links.split.train.tolist() == list(range(15))
    assert links.split.test.tolist() == [15, 16, 17]
    alone, lowest = (
        furnished_room(transmitters=6, seed=5, frequency=carrier)
        for carrier in (max(CARRIERS), 3.1e9)
    )
    assert torch.equal(links.receivers[0].array.elements, alone.receivers[0].array.elements)
    assert torch.equal(links.labels[1::3], alone.labels)
    assert (
        links.labels[2::3] - lowest.labels
    ).abs().max() > 0.1  # the array of the lowest carrier is twice as wide
    own = Grid.degrees(), "band", 3.1e9, 499.2e6, 2
    assert torch.equal(
        links.labels[2::3], spectra(ROOM, lowest.query.transmitters, links.receivers[0], *own)
    )
    check_data(links)


# --- geometry ---


def test_obj_faces_lie_on_the_walls_and_face_outwards():
    vertices, groups = parse_obj(wavefront_obj(meshes(ROOM)).splitlines(), "room.obj")
    cuboids = {"room": ((0, 0, 0), ROOM.size, ROOM.walls)}
    for box in ROOM.furniture:
        cuboids[box.name] = box.lower, box.upper, (f"loss_{box.loss_db}_db",) * 6
    found = set()
    for (name, material), group in groups.items():
        for face in group:
            lower, upper, materials = cuboids[name]
            corners = vertices[list(face)]
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
            axis = int(np.argmax(np.abs(normal)))
            side = int(normal[axis] > 0)
            found.add((name, axis, side))
            assert material == materials[2 * axis + side]
            np.testing.assert_allclose(corners[:, axis], (lower, upper)[side][axis])
            assert np.linalg.norm(normal) == pytest.approx(
                np.prod(np.delete(np.subtract(upper, lower), axis))
            )
            np.testing.assert_allclose(
                corners[0] + corners[2], corners[1] + corners[3]
            )  # a rectangle's diagonals
    assert len(found) == 6 * len(cuboids)


def test_the_documented_room_is_simulated_and_written(tmp_path, monkeypatch):
    text = (Path(__file__).parents[2] / "docs" / "data.md").read_text(encoding="utf-8")
    (code,) = [
        block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "my_room" in block
    ]
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    exec(code, {})
    links = read(tmp_path / "my_room")
    assert (len(links.split.train), len(links.split.test)) == (160, 40)


def test_so_many_receivers_hang_on_the_walls():
    from gaigs.data.synthetic import ROOM, default_room

    poses = default_room(0, 12).poses
    places = torch.stack([pose.position for pose in poses])
    size = torch.tensor(ROOM.size)
    to_wall = torch.minimum(places, size - places)[:, :2].amin(1)
    torch.testing.assert_close(to_wall, torch.full((12,), 0.1))
    assert torch.cdist(places, places).add(10 * torch.eye(12)).min() > 0.8
    for pose in poses:  # which face the room
        assert pose.rotation[:, 2] @ (size / 2 - pose.position) > 0
        torch.testing.assert_close(pose.rotation.det(), torch.tensor(1.0))
    links = gaigs.links("synthetic", transmitters=4, receivers=3, order=0)
    alone = gaigs.links("synthetic", transmitters=4, order=0)
    assert len(links) == 12
    assert len(alone.receivers) == 1
    assert torch.equal(links.query.transmitters[::3], alone.query.transmitters)
    channels = gaigs.links("synthetic_csi", transmitters=4, receivers=3, order=0)
    assert channels.query.receivers.tolist() == 4 * [0, 1, 2]
    with pytest.raises(ValueError, match="receivers must be at least 1"):
        gaigs.links("synthetic_rssi", transmitters=4, receivers=0)
