"""Scene files of one's own: free space, paths by a known image, and defects."""

import numpy as np
import pytest
import torch
from gaigs_sionna.meshes import Cuboid
from gaigs_sionna.readers import traced_room, traced_room_csi, traced_room_rssi
from gaigs_sionna.simulation import find_room
from scipy.constants import speed_of_light

from gaigs.io.meshes import wavefront_obj

MATERIAL = (
    '<bsdf type="itu-radio-material" id="{0}"><string name="type" value="{0}"/>'
    '<float name="thickness" value="0.2"/></bsdf>'
)
SHAPE = (
    '<shape type="obj" id="{0}"><string name="filename" value="{0}.obj"/>'
    '<boolean name="face_normals" value="true"/><ref id="{1}" name="bsdf"/></shape>'
)


def write(folder, **cuboids):
    """A scene of cuboids of a material, (material, lower, upper) each."""
    for name, (material, lower, upper) in cuboids.items():
        (folder / f"{name}.obj").write_text(
            wavefront_obj([Cuboid(name, material, lower, upper).mesh()])
        )
    materials = "".join(
        MATERIAL.format(material) for material in sorted({own[0] for own in cuboids.values()})
    )
    shapes = "".join(SHAPE.format(name, own[0]) for name, own in cuboids.items())
    (folder / "room.xml").write_text(f'<scene version="2.1.0">{materials}{shapes}</scene>')
    return str(folder / "room.xml")


@pytest.fixture
def scene(tracer, tmp_path):
    return write(
        tmp_path,
        shell=("concrete", (0, 0, 0), (5, 4, 3)),
        chest=("wood", (1, 1, 0), (2.5, 2.6, 1.8)),
    )


def test_transmitters_stand_in_the_free_space_alone(scene):
    receivers = [[0.3, 0.3, 2.5], [4.7, 3.7, 1.0]]
    room = find_room("", scene, "receivers", receivers, None, [0.5, 1.5])
    places = room.place(40, 0)
    low, high = places.new_tensor([0.1, 0.1, 0.5]), places.new_tensor([4.9, 3.9, 1.5])
    assert ((places >= low) & (places <= high)).all()
    near = (places > places.new_tensor([0.9, 0.9, 0])) & (
        places < places.new_tensor([2.6, 2.7, 1.9])
    )
    assert not near.all(1).any()
    assert [receiver.pose.position.tolist() for receiver in room.gateways] == torch.tensor(
        receivers
    ).tolist()
    assert len(room.edges) == 24


def test_paths_are_those_over_a_plate_of_metal(tracer, tmp_path):
    """Channels at the middle of the array's elements against the direct wave and its image in the
    floor.
    """
    scene = write(tmp_path, floor=("metal", (-20, -20, -0.5), (20, 20, 0)))
    links = traced_room_rssi(
        scene=scene,
        receivers=[[0.0, 0.0, 2.0]],
        transmitters=10,
        heights=[0.5, 1.5],
        noise=0.0,
        sensitivity=-200.0,
    )
    images = links.query.transmitters.double()[:, None] * torch.tensor([[1.0, 1, 1], [1, 1, -1]])
    lengths = (images - torch.tensor([0.0, 0, 2])).norm(dim=-1).numpy()
    frequencies = 2.441e9 + np.linspace(-39e6, 39e6, 101)
    waves = speed_of_light / (4 * np.pi * frequencies) / lengths[..., None]
    waves = waves * np.exp(-2j * np.pi * frequencies * lengths[..., None] / speed_of_light)
    expected = 10 * np.log10((np.abs(waves.sum(1)) ** 2).mean(1))
    assert np.median(np.abs(links.labels.numpy() - expected)) < 1.0


def test_places_without_a_path_are_left_out(tracer, tmp_path):
    """The array looks up, away from all transmitters: nothing is heard."""
    scene = write(tmp_path, floor=("metal", (-5, -5, -0.5), (5, 5, 0)))
    options = {
        "scene": scene,
        "receiver": [0, 0, 1.9],
        "facing": [0, 0, 9],
        "heights": [0.3, 1.0],
        "transmitters": 4,
    }
    with pytest.raises(ValueError, match="paths must lead to two of 4 transmitters"):
        traced_room_csi(**options, bandwidth=1e6, subcarriers=2)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "cannot load .*room.xml: no element found"),
        (
            "<scene version='2.1.0'></scene>",
            "no surfaces; expected a scene that sionna.rt.load_scene loads",
        ),
        (MATERIAL.format("kryptonite").join(("<scene version='2.1.0'>", "</scene>")), "kryptonite"),
    ],
)
def test_damaged_scenes_are_named(scene, text, message):
    with open(scene, "w") as file:
        file.write(text)
    with pytest.raises(ValueError, match=message):
        traced_room(scene=scene, receiver=[0.3, 0.3, 2.5], transmitters=2)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"receiver": None}, r"data\.receivers must be x, y, z of each receiver"),
        (
            {"receiver": [300, 300, 2500]},
            "receivers must stand in the scene, whose surfaces lie from",
        ),
        ({"heights": [2, 1]}, "heights must be the lowest and the highest z"),
        ({"heights": [5, 6]}, "expected free space at z from 5 to 6 m"),
        ({"scene": None}, r"data\.receiver is an option of data\.scene"),
        ({"frequency": 5e8}, "no materials at 5e\\+08 Hz"),
    ],
)
def test_unsuitable_options_of_a_scene_are_refused(scene, options, message):
    with pytest.raises(ValueError, match=message):
        traced_room(**{"scene": scene, "receiver": [0.3, 0.3, 2.5], "transmitters": 2} | options)


def test_a_missing_scene_is_named(tracer, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no scene at .*none\.xml; set data\.scene"):
        traced_room(scene=str(tmp_path / "none.xml"), receiver=[0.3, 0.3, 2.5])
