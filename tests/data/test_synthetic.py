"""The built-in scene: repeatable, learnable, and the same from its folder."""

import re
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.constants import speed_of_light
from scipy.spatial.transform import Rotation
from skimage.metrics import structural_similarity

from gaigs.data import load, nerf2_spectrum
from gaigs.data.synthetic import POSE, REGION, ROOM, edges, patch_array, place, spectra, wavefront_obj
from gaigs.data.synthetic.image_source import is_free
from gaigs.directions import Grid
from gaigs.split.blocks import blocks
from gaigs.testing import check_data

OFFICIAL = {"name": "official", "validation": 0}
CARRIERS = [5e9, 6.4896e9, 3.1e9]


def furnished_room(split=OFFICIAL, **options):
    return load({"name": "synthetic", **options}, split)


def read(folder, **options):
    return load({"name": "nerf2_spectrum", "root": str(folder), **options}, OFFICIAL)


@pytest.fixture(scope="module", params=["band", "carrier"])
def scene(request):
    return request.param, furnished_room(spectrum=request.param)


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
    spectrum, links = scene
    assert (len(links.split.train), len(links.split.test)) == (400, 100)
    labels, mean, nearest = look_up(links)
    assert 0.45 < median_ssim(labels, mean) < 0.6
    low, high = {"band": (0.85, 0.92), "carrier": (0.73, 0.82)}[spectrum]
    assert low < median_ssim(labels, nearest) < high


def test_held_out_space_is_harder_than_held_out_links(scene):
    links = scene[1]
    links = replace(links, split=blocks(links, edge=1.0, validation=0))
    labels, mean, nearest = look_up(links)
    assert median_ssim(labels, mean) + 0.05 < median_ssim(labels, nearest) < 0.72


def test_labels_are_those_of_measured_sets(scene):
    labels = scene[1].labels
    assert labels.dtype == torch.float32
    assert labels.shape == (500, 90, 360)
    assert labels.amin((1, 2)).tolist() == [0] * 500
    assert labels.amax((1, 2)).tolist() == [1] * 500
    assert (labels[:, -1] - labels[:, -1, :1]).abs().max() < 1e-5  # at the zenith azimuth means nothing


def test_the_default_scene_keeps_the_contract(scene):
    check_data(scene[1])


def test_transmitters_stand_free_in_their_region(scene):
    transmitters = scene[1].query.transmitters
    assert len(torch.unique(transmitters, dim=0)) == 500
    assert is_free(ROOM, transmitters).all()
    lower, upper = torch.tensor(REGION)
    assert ((transmitters >= lower) & (transmitters <= upper)).all()
    assert (transmitters.amax(0) - transmitters.amin(0) > 0.95 * (upper - lower)).all()


def test_the_scene_repeats_with_its_seed_alone(small):
    again, other = (furnished_room(transmitters=10, seed=seed) for seed in (5, 6))
    assert torch.equal(small.query.transmitters, again.query.transmitters)
    assert torch.equal(small.labels, again.labels)
    assert not torch.equal(small.query.transmitters, other.query.transmitters)


def test_there_are_as_many_places_as_asked_for():
    assert [len(place(count, 0)) for count in (2, 3, 500)] == [2, 3, 500]


def test_the_folder_reads_back_the_same(small, tmp_path):
    nerf2_spectrum.write(tmp_path / "room", small)
    again = read(tmp_path / "room")
    assert (again.labels[torch.arange(10)] - small.labels).abs().max() <= 0.5 / 255 + 1e-6
    assert torch.equal(again.query.transmitters, small.query.transmitters)
    torch.testing.assert_close(again.receivers[0].pose.rotation, small.receivers[0].pose.rotation)
    torch.testing.assert_close(again.receivers[0].pose.position, small.receivers[0].pose.position)
    assert torch.equal(again.split.train, small.split.train)
    assert torch.equal(again.split.test, small.split.test)
    assert again.task.normalisation == small.task.normalisation


def command(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["synthetic", *map(str, arguments)])
    runpy.run_module("gaigs.data.synthetic", run_name="__main__")


def test_the_command_writes_the_scene(small, tmp_path, monkeypatch, capsys):
    command(monkeypatch, tmp_path / "room", "--transmitters", 10, "--seed", 5)
    printed = capsys.readouterr().out
    assert "8 training and 2 test spectra" in printed
    links = read(tmp_path / "room")
    assert (links.labels[torch.arange(10)] - small.labels).abs().max() <= 0.5 / 255 + 1e-6
    assert (tmp_path / "room" / "geometry.obj").read_text() == wavefront_obj(ROOM)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--transmitters", 5], "must be an empty folder or none"),
        (["--transmitters", 1], "transmitters must be at least 2"),
        (["--frequency", 920e6], "frequency must lie in 1e9..40e9 Hz"),
        (["--spectrum", "lobes"], "invalid choice: 'lobes'"),
        (["--wavelength", 3], "unrecognized arguments: --wavelength 3"),
    ],
)
def test_the_command_refuses(tmp_path, monkeypatch, capsys, arguments, message):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SystemExit) as caught:
        command(monkeypatch, tmp_path, *arguments)
    assert caught.value.code == 2
    assert message in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"spectrum": "lobes"}, "spectrum must be 'band' or 'carrier', got 'lobes'"),
        ({"bandwidth": 0}, "bandwidth must be positive"),
        ({"order": -1}, "order must be the largest number of reflections"),
        ({"transmitters": 1}, "transmitters must be at least 2"),
        ({"frequency": []}, r"frequency must be a carrier or several different ones \[Hz\], got \[\]"),
        ({"frequency": [5e9, 5e9]}, "frequency must be a carrier or several different ones"),
        ({"frequency": [5e9, -1.0]}, "frequency must be a carrier in Hz, .* got -1$"),
        ({"frequency": [5e9, 50e9]}, r"frequency must lie in 1e9\.\.40e9 Hz"),
        ({"frequency": 6.4896}, r"frequency must be a carrier in Hz, .* got 6\.4896; in GHz\?$"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        furnished_room(**{"transmitters": 4, **options})


@pytest.mark.parametrize("frequency", ["6e9", [6e9, "5e9"], None, float("nan")])
def test_frequencies_are_numbers(frequency):
    with pytest.raises(TypeError, match=r"frequency'.* must be a (finite )?number"):
        furnished_room(transmitters=4, frequency=frequency)


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


def test_the_array_looks_down_into_the_room(small):
    """Its normal is the quaternion's turn of z; every transmitter is in front of it, and heard."""
    turn = Rotation.from_quat((-0.15403, 0.87354, 0.23087, 0.39989))
    normal = turn.apply([0, 0, 1])
    rays = small.query.transmitters.double().numpy() - (0.2, 0.2, 2.5)
    assert (rays @ normal > 0).all()
    assert normal[2] < 0 < min(normal[:2])


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


def test_one_carrier_in_a_list_is_one_carrier(small):
    again = furnished_room(transmitters=10, seed=5, frequency=[6.4896e9])
    assert torch.equal(again.labels, small.labels)


@pytest.mark.parametrize("frequency", [6e9, 4.5e9, 3e9])
def test_a_fixed_array_has_wider_lobes_at_a_lower_carrier(frequency):
    """Against the array factor, sin(2 psi) / (4 sin(psi / 2)) along each side, of a wave from straight ahead."""
    ahead = POSE.world(torch.tensor([[0.0, 0.0, 4.0]]))
    spectrum = spectra(ROOM, ahead, patch_array(6e9), Grid.degrees(), "carrier", frequency, 499.2e6, 0)[0].numpy()
    elevations, azimuths = np.deg2rad(np.arange(1, 91))[:, None], np.deg2rad(np.arange(360))
    psi = np.pi * frequency / 6e9 * np.stack([np.cos(azimuths), np.sin(azimuths)])[:, None] * np.cos(elevations)
    psi = np.where(np.abs(psi) < 1e-9, 1e-9, psi)
    expected = np.abs(np.prod(np.sin(2 * psi) / (4 * np.sin(psi / 2)), 0))
    assert np.abs(spectrum - expected).max() < 0.02


def test_the_folder_of_several_carriers_reads_back_the_same(tmp_path):
    links = furnished_room(transmitters=6, seed=5, frequency=CARRIERS)
    nerf2_spectrum.write(tmp_path / "room", links)
    again = read(tmp_path / "room", frequency=max(CARRIERS))
    assert torch.equal(again.query.frequencies, links.query.frequencies)
    assert torch.equal(again.receivers[0].array.elements, links.receivers[0].array.elements)
    assert torch.equal(again.split.test, links.split.test)


def test_the_command_writes_several_carriers(tmp_path, monkeypatch, capsys):
    command(monkeypatch, "--frequency", 5e9, "--frequency", 3.1e9, "--transmitters", 3, tmp_path / "room")
    assert "4 training and 2 test spectra" in capsys.readouterr().out
    assert (tmp_path / "room" / "freq.txt").read_text().split() == ["5", "3.1"] * 3


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
    vertices, material, faces = [], "", []
    for line in wavefront_obj(ROOM).splitlines():
        word, *rest = line.split()
        if word == "v":
            vertices.append([float(value) for value in rest])
        elif word == "usemtl":
            (material,) = rest
        elif word == "f":
            faces.append((material, np.array([vertices[int(k) - 1] for k in rest])))
    cuboids = [((0, 0, 0), ROOM.size, ROOM.walls)] + [
        (box.lower, box.upper, (f"loss_{box.loss_db}_db",) * 6) for box in ROOM.furniture
    ]
    for number, (lower, upper, materials) in enumerate(cuboids):
        for wall in range(6):
            axis, side = divmod(wall, 2)
            material, corners = faces[6 * number + wall]
            assert material == materials[wall]
            np.testing.assert_allclose(corners[:, axis], (lower, upper)[side][axis])
            normal = np.cross(corners[1] - corners[0], corners[2] - corners[1])
            assert np.argmax(np.abs(normal)) == axis
            assert np.sign(normal[axis]) == (-1, 1)[side]
            area = np.prod(np.delete(np.subtract(upper, lower), axis))
            assert np.linalg.norm(normal) == pytest.approx(area)
            np.testing.assert_allclose(corners[0] + corners[2], corners[1] + corners[3])  # a rectangle's diagonals


def test_the_documented_room_is_simulated_and_written(tmp_path, monkeypatch):
    text = (Path(__file__).parents[2] / "docs" / "data.md").read_text(encoding="utf-8")
    (code,) = [block for block in re.findall(r"```python\n(.*?)```", text, re.DOTALL) if "my_room" in block]
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    exec(code, {})
    links = read(tmp_path / "my_room")
    assert (len(links.split.train), len(links.split.test)) == (160, 40)
