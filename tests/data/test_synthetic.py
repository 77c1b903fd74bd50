"""The built-in scene: repeatable, learnable, and the same from its folder."""

import inspect
import re
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from skimage.metrics import structural_similarity

from gaigs.configuration import conf_dir
from gaigs.data import nerf2_spectrum
from gaigs.data.splits import split
from gaigs.data.synthetic import REGION, ROOM, edges, furnished_room, place, wavefront_obj
from gaigs.data.synthetic.image_source import is_free
from gaigs.registry import registry

OFFICIAL = {"protocol": "official", "validation": 0}


@pytest.fixture(scope="module", params=["band", "carrier"])
def scene(request):
    return request.param, furnished_room(OFFICIAL, spectrum=request.param)


@pytest.fixture(scope="module")
def small():
    return furnished_room(OFFICIAL, transmitters=10, seed=5)


def median_ssim(labels, predictions):
    scores = [
        structural_similarity(a.numpy(), b.numpy(), data_range=1) for a, b in zip(labels, predictions, strict=True)
    ]
    return np.median(scores)


def look_up(links):
    """Test labels with the mean of the training spectra, and with the three nearest by inverse squared distance."""
    train, test = links.split.train, links.split.test
    known = links.labels[train]
    distances, nearest = torch.cdist(links.transmitters[test], links.transmitters[train]).topk(3, largest=False)
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
    links = replace(links, split=split(links.transmitters, "blocks", edge=1.0, validation=0))
    labels, mean, nearest = look_up(links)
    assert median_ssim(labels, mean) + 0.05 < median_ssim(labels, nearest) < 0.72


def test_labels_are_those_of_measured_sets(scene):
    labels = scene[1].labels
    assert labels.dtype == torch.float32
    assert labels.shape == (500, 90, 360)
    assert labels.amin((1, 2)).tolist() == [0] * 500
    assert labels.amax((1, 2)).tolist() == [1] * 500
    assert (labels[:, -1] - labels[:, -1, :1]).abs().max() < 1e-5  # at the zenith azimuth means nothing


def test_transmitters_stand_free_in_their_region(scene):
    transmitters = scene[1].transmitters
    assert len(torch.unique(transmitters, dim=0)) == 500
    assert is_free(ROOM, transmitters).all()
    lower, upper = torch.tensor(REGION)
    assert ((transmitters >= lower) & (transmitters <= upper)).all()
    assert (transmitters.amax(0) - transmitters.amin(0) > 0.95 * (upper - lower)).all()


def test_the_scene_repeats_with_its_seed_alone(small):
    again, other = (furnished_room(OFFICIAL, transmitters=10, seed=seed) for seed in (5, 6))
    assert torch.equal(small.transmitters, again.transmitters)
    assert torch.equal(small.labels, again.labels)
    assert not torch.equal(small.transmitters, other.transmitters)


def test_there_are_as_many_places_as_asked_for():
    assert [len(place(count, 0)) for count in (2, 3, 500)] == [2, 3, 500]


def test_the_folder_reads_back_the_same(small, tmp_path):
    nerf2_spectrum.write(tmp_path / "room", small)
    again = nerf2_spectrum.read(tmp_path / "room", OFFICIAL)
    assert (again.labels[torch.arange(10)] - small.labels).abs().max() <= 0.5 / 255 + 1e-6
    assert torch.equal(again.transmitters, small.transmitters)
    torch.testing.assert_close(again.receivers[0].pose.rotation, small.receivers[0].pose.rotation)
    torch.testing.assert_close(again.receivers[0].pose.position, small.receivers[0].pose.position)
    assert torch.equal(again.split.train, small.split.train)
    assert torch.equal(again.split.test, small.split.test)
    assert again.normalisation == small.normalisation


def command(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["synthetic", *map(str, arguments)])
    runpy.run_module("gaigs.data.synthetic", run_name="__main__")


def test_the_command_writes_the_scene(small, tmp_path, monkeypatch, capsys):
    command(monkeypatch, tmp_path / "room", "--transmitters", 10, "--seed", 5)
    assert "8 training and 2 test spectra" in capsys.readouterr().out
    links = nerf2_spectrum.read(tmp_path / "room", OFFICIAL)
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
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        furnished_room(OFFICIAL, **{"transmitters": 4, **options})


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


@pytest.mark.parametrize(
    ("name", "component"), [("synthetic", furnished_room), ("nerf2_spectrum", nerf2_spectrum.read)]
)
def test_configuration_names_every_option_with_its_default(name, component):
    config = OmegaConf.to_container(OmegaConf.load(conf_dir() / "data" / f"{name}.yaml"))
    assert registry("data").get(config.pop("name")) is component
    parameters = inspect.signature(component).parameters
    assert config.keys() == parameters.keys()
    defaults = {key: p.default for key, p in parameters.items() if p.default is not p.empty}
    # PyYAML reads 1e9 without a point as a string, so the numbers are compared by type too.
    assert {key: config[key] for key in defaults} == defaults
    assert all(type(config[key]) is type(value) for key, value in defaults.items())
    parts = split(torch.rand(50, 3), official=(torch.arange(40), torch.arange(40, 50)), **config["split"])
    assert parts.name == "official, validation 0.1, seed 0"
    for option in ("test", "train", "length", "edge"):
        assert config["split"].pop(option) is None
    assert config["split"].keys() == {"protocol", "seed", "validation"}


def test_the_configured_scene_is_built(small):
    config = OmegaConf.load(conf_dir() / "data" / "synthetic.yaml")
    config.merge_with({"transmitters": 10, "seed": 5, "split": {"protocol": "blocks", "edge": 2.0}})
    links = registry("data").build(config)
    assert torch.equal(links.labels, small.labels)
    assert links.split.name == "blocks 2 m, test 0.2, validation 0.1, seed 0"
    config.order_ = 3
    with pytest.raises(ValueError, match=r"has no option 'order_' \(did you mean 'order'\?\)"):
        registry("data").build(config)


def test_the_documented_room_is_simulated_and_written(tmp_path, monkeypatch):
    text = (Path(__file__).parents[2] / "docs" / "data.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.chdir(tmp_path)
    torch.manual_seed(0)
    exec(code, {})
    links = nerf2_spectrum.read(tmp_path / "my_room", OFFICIAL)
    assert (len(links.split.train), len(links.split.test)) == (160, 40)
