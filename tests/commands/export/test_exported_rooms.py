"""Exported rooms as readers of glTF, of meshes and of Mitsuba's scenes see them."""

import os
from dataclasses import replace
from functools import partial
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
import trimesh

import gaigs
from gaigs.commands.export import rooms
from gaigs.commands.export.rooms import itu_bsdf, mirrored_of, sheet_bsdf, write_scene
from gaigs.io.meshes import Mesh, positions, read_obj, read_ply
from gaigs.model.ensemble import Ensemble
from gaigs.model.kriging import Kriging
from gaigs.planes.materials import Material
from gaigs.planes.obstacle_surfaces import Sheet, SurfaceOptions, fit_sheets
from gaigs.splatting.placement.mirrored.obstacles import Obstacles

SIZE = 7.0, 5.0, 3.0
WALL = Mesh(
    "wall",
    "",
    ((0.0, 4.0, -9.0), (9.0, 4.0, -9.0), (9.0, 4.0, 9.0), (0.0, 4.0, 9.0)),
    ((0, 1, 2, 3),),
)


@pytest.mark.parametrize("name", ["room.glb", "room.gltf"])
def test_gltf_has_the_room_with_y_up(mirrored, tmp_path, name):
    scene = trimesh.load_scene(*gaigs.export(mirrored, tmp_path / name))
    np.testing.assert_allclose(scene.bounds, [(0, 0, -SIZE[1]), (SIZE[0], SIZE[2], 0)], atol=1e-3)
    planes = {f"plane_{plane.number}": plane for plane in mirrored.learnt_room().planes}
    assert scene.geometry.keys() == planes.keys()
    upright = scene.graph.get("room")[0]
    np.testing.assert_allclose(upright[:3, :3] @ (0, 0, 1), (0, 1, 0), atol=1e-6)
    for node in scene.graph.nodes_geometry:
        transform, key = scene.graph[node]
        np.testing.assert_allclose(transform, upright, atol=1e-6)
        assert node == key
        shape = scene.geometry[key]
        np.testing.assert_allclose(shape.vertices, planes[key].corners, atol=1e-5)
        assert shape.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
        material = shape.visual.material
        assert material.main_color.tolist() == [0, 115, 178, 89]
        assert (material.alphaMode, material.doubleSided) == ("BLEND", True)
        extras = scene.graph.transforms.edge_data["room", node]["metadata"]
        assert extras == {"share": planes[key].share}


def test_an_obj_has_names_and_geometry_in_any_reader(mirrored, tmp_path):
    (file,) = gaigs.export(mirrored, tmp_path / "room.obj")
    scene = trimesh.load_scene(file, split_objects=True, group_material=False)
    planes = {f"plane_{plane.number}": plane for plane in mirrored.learnt_room().planes}
    assert scene.geometry.keys() == planes.keys()
    for name, shape in scene.geometry.items():
        np.testing.assert_allclose(shape.bounds[0], planes[name].corners.min(0), atol=1e-5)
        np.testing.assert_allclose(shape.bounds[1], planes[name].corners.max(0), atol=1e-5)


def test_a_kriged_ensemble_has_the_room_of_its_first_member(mirrored):
    model = Kriging(mirrored.scene, Ensemble(mirrored.scene, [mirrored, mirrored]))
    assert mirrored_of("a room", model) is mirrored
    assert len(model.learnt_room().planes) == 6


def test_a_scene_has_a_material_and_a_mesh_for_each_plane(mirrored, tmp_path):
    file, *meshes = gaigs.export(mirrored, tmp_path / "room.xml")
    root = ElementTree.parse(file).getroot()
    shapes = {
        shape.find("string").get("value"): shape.find("ref").get("id")
        for shape in root.findall("shape")
    }
    assert [*shapes] == [path.relative_to(tmp_path).as_posix() for path in meshes]
    materials = {one.get("id"): one for one in root.findall("bsdf")}
    assert {*shapes.values()} == materials.keys()
    assert {one.get("type") for one in materials.values()} == {"itu-radio-material"}
    points = np.concatenate([positions(read_ply(path)[0]) for path in meshes])
    np.testing.assert_allclose([points.min(0), points.max(0)], [(0, 0, 0), SIZE], atol=1e-3)


def test_a_carrier_outside_the_tables_has_numbers(tmp_path):
    write_scene(tmp_path / "room.xml", [WALL], [itu_bsdf(Material("concrete", 0.2), 0.92e9)])
    (material,) = ElementTree.parse(tmp_path / "room.xml").getroot().findall("bsdf")
    assert material.get("type") == "radio-material"
    numbers = {one.get("name"): float(one.get("value")) for one in material}
    assert numbers == pytest.approx(
        {"thickness": 0.2, "relative_permittivity": 5.24, "conductivity": 0.0462 * 0.92**0.7822},
        rel=1e-5,
    )


def test_a_scene_that_is_read_while_another_replaces_it_keeps_its_meshes(tmp_path):
    material = [itu_bsdf(Material("concrete", 0.2), 6e9)]
    wall = replace(WALL, name="plane_0")
    other = replace(wall, vertices=tuple((x, y + 1, z) for x, y, z in wall.vertices))
    _, mesh = write_scene(tmp_path / "room.xml", [wall], material)
    file, another = write_scene(tmp_path / "room.xml", [other], material)
    assert positions(read_ply(mesh)[0])[:, 1].tolist() == [4.0] * 4
    assert f"room_meshes/{another.name}" in file.read_text()
    os.utime(mesh, (0, 0))
    write_scene(tmp_path / "room.xml", [other], material)
    assert [*mesh.parent.iterdir()] == [another], "meshes of older scenes are removed"


@pytest.mark.parametrize("frequency", [0.92e9, 6e9])
def test_the_ray_tracer_reflects_at_the_material(frequency, tracer, tmp_path):
    file, _ = write_scene(
        tmp_path / "room.xml", [WALL], [itu_bsdf(Material("concrete", 1.0), frequency)]
    )
    scene = tracer.open_scene(frequency, file)
    paths = tracer.trace_scene(
        scene, torch.tensor([5.0, 0.0, 0.0]), torch.tensor([[3.0, 0.0, 0.0]]), depth=1
    )
    gains = {
        round(image[1].item()): gain
        for image, gain in zip(paths.images[0], paths.gains[0], strict=True)
    }
    permittivity = complex(
        5.24, -0.0462 * (frequency / 1e9) ** 0.7822 / (2 * np.pi * 8.8542e-12 * frequency)
    )
    cosine = 8 / np.hypot(8, 2)
    root = np.sqrt(permittivity - (1 - cosine**2))
    assert gains[0].item() == pytest.approx(1, abs=1e-2)
    assert gains[8].item() == pytest.approx((cosine - root) / (cosine + root), abs=1e-2)


@pytest.mark.parametrize("frequency", [1e9, 30e9])
def test_the_ray_tracer_passes_a_sheet_without_a_turn_or_a_reflection(frequency, tracer, tmp_path):
    file, _ = write_scene(
        tmp_path / "room.xml", [WALL], [sheet_bsdf(Sheet(3.0, np.zeros((0, 3)), np.zeros((0, 3))))]
    )
    scene, receiver = tracer.open_scene(frequency, file), torch.tensor([5.0, 3.0, 0.0])
    through = tracer.trace_scene(
        scene, receiver, torch.tensor([[3.0, 5.0, 0.0]]), depth=1, reflections=1
    )
    assert through.gains[0].tolist() == pytest.approx(
        [1 / (1 + 1.5 * 2**0.5)], abs=3e-2
    )  # TE at 45 degrees
    beside = tracer.trace_scene(
        scene, receiver, torch.tensor([[3.0, 3.0, 0.0]]), depth=1, reflections=1
    )
    assert beside.gains[0].abs().tolist() == pytest.approx([1.0], abs=1e-3)


def test_obstacles_are_surfaces_and_the_gain_of_channels_is_told(mirrored, tmp_path, monkeypatch):
    options = SurfaceOptions(voxels=50_000, candidates=3, paths=300)
    monkeypatch.setattr(rooms, "fit_sheets", partial(fit_sheets, options=options))
    placement = mirrored.placement
    placement.obstacles = Obstacles(1, -placement.middle, placement.middle)
    with torch.no_grad():
        placement.obstacles.places.zero_()
        placement.obstacles.log_widths.fill_(np.log(0.3))
        placement.obstacles.log_densities.fill_(np.log(4.0))
    file, *meshes = gaigs.export(mirrored, tmp_path / "room.xml")
    pieces = [positions(read_ply(path)[0]) for path in meshes if path.stem.startswith("obstacle")]
    radii = [np.linalg.norm(piece - placement.middle.numpy(), axis=1) for piece in pieces]
    assert radii
    assert all(np.ptp(radius) < 0.01 and 0.2 < radius.mean() < 1.0 for radius in radii)
    assert "Channels of gateway1 are those traced times" in file.read_text()
    gaigs.export(mirrored, tmp_path / "room.obj")
    _, faces = read_obj(tmp_path / "room.obj")
    assert len(faces) == 6 + len(pieces)
    scene = trimesh.load_scene(*gaigs.export(mirrored, tmp_path / "room.glb"))
    assert len(scene.geometry) == 6 + len(pieces)


def test_obj_and_kriging_on_top(mirrored, tmp_path):
    links = gaigs.links("synthetic_csi", transmitters=10, order=0)
    kriging = gaigs.registries["model"].build(
        {"name": "kriging", "trend": mirrored}, scene=links.scene
    )
    gaigs.export(kriging, tmp_path / "room.obj")
    vertices, faces = read_obj(tmp_path / "room.obj")
    assert len(faces) == 6
    np.testing.assert_allclose(vertices.max(0), SIZE, atol=1e-3)


def test_materials_need_a_carrier(tmp_path):
    scene = replace(
        gaigs.links("synthetic_rssi", transmitters=10, order=0).scene, frequencies=torch.zeros(0)
    )
    options = {"name": "mirrored", "placement": {"name": "mirrored", "obstacles": 0}}
    rssi = gaigs.registries["model"].build(options, scene=scene)
    with pytest.raises(ValueError, match="materials depend on the carrier"):
        gaigs.export(rssi, tmp_path / "room.xml")
    assert len(gaigs.export(rssi, tmp_path / "room.xml", frequency=2.4e9)) > 1
    with pytest.raises(FileNotFoundError, match="missing/room_meshes"):
        gaigs.export(rssi, tmp_path / "missing/room.xml", frequency=2.4e9)
