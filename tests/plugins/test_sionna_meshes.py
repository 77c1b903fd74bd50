"""Meshes of the rooms: closed, planar, free where they are said to be free, and drawn without
seams.
"""

import math

import numpy as np
import pytest
import torch
from gaigs_sionna.meshes import FURNITURE_MARGIN, WALL_MARGIN, Cuboid, edges
from gaigs_sionna.rooms import ROOMS
from matplotlib.path import Path
from scipy.spatial import ConvexHull, Delaunay

from gaigs.io.meshes import parse_obj, wavefront_obj

TURNED = Cuboid("desk", "wood", (1.0, 2.0, 0.5), (3.0, 2.6, 0.9), 30.0)

every_room = pytest.mark.parametrize("room", ROOMS.values(), ids=ROOMS)


def shell(room):
    return room.meshes()[: len(room.meshes()) - len(room.furniture)]


def test_a_turned_cuboid_keeps_its_size_and_faces_outwards():
    mesh = TURNED.mesh()
    corners, middle = np.array(mesh.vertices), np.array((2.0, 2.3, 0.7))
    assert ConvexHull(corners).volume == pytest.approx(
        np.prod(np.subtract(TURNED.upper, TURNED.lower)), rel=1e-5
    )
    for a, b, c in corners[np.array(mesh.triangles())]:
        assert np.cross(b - a, c - a) @ (a - middle) > 0
    along = corners[1] - corners[0]
    assert np.linalg.norm(along) == pytest.approx(2.0, abs=1e-5)
    assert math.degrees(math.atan(along[1] / along[0])) == pytest.approx(30.0, abs=1e-3)


def test_a_cuboid_contains_the_points_of_its_hull():
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [4.0, 4.0, 1.5]
    )
    hull = Delaunay(np.array(TURNED.mesh().vertices))
    inside = hull.find_simplex(points.double().numpy()) >= 0
    assert 50 < inside.sum() < 500
    np.testing.assert_array_equal(TURNED.contains(points, 0.0).numpy(), inside)
    assert (TURNED.contains(points, 0.1) >= TURNED.contains(points, 0.0)).all()


@pytest.mark.parametrize("name", ["slanted", "furnished"])
def test_free_places_of_a_convex_room_keep_their_distance_from_its_hull(name):
    room = ROOMS[name]
    points = (
        torch.rand(3000, 3, generator=torch.Generator().manual_seed(0))
        * torch.tensor([8.0, 6.0, 2.6])
        + 0.02
    )
    planes = ConvexHull(
        np.array([corner for mesh in shell(room) for corner in mesh.vertices])
    ).equations
    upright = np.linalg.norm(planes[:, :2], axis=1) > 0.5
    horizontal = (
        planes[upright] / np.linalg.norm(planes[upright, :2], axis=1)[:, None]
    )  # distances within a level
    depths = -(points.double().numpy() @ horizontal[:, :3].T + horizontal[:, 3]).max(1)
    clear = np.ones(len(points), dtype=bool)
    for cuboid in room.furniture:
        clear &= ~cuboid.contains(points, FURNITURE_MARGIN).numpy()
    certain = np.abs(depths - WALL_MARGIN) > 1e-4
    np.testing.assert_array_equal(
        room.is_free(points).numpy()[certain], (clear & (depths > WALL_MARGIN))[certain]
    )


def test_free_places_of_the_l_lie_in_it():
    room = ROOMS["l_shape"]
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [9.0, 7.0, 2.5]
    )
    inside = Path([*room.floor, room.floor[0]]).contains_points(points[:, :2].double().numpy())
    free = room.is_free(points).numpy()
    assert (inside | ~free).all()
    corner = torch.tensor(
        [[3.8 - 0.2, 3.4 - 0.2, 1.0], [3.8 - 0.22, 3.4 - 0.22, 1.0], [4.2, 3.8, 1.0]]
    )
    assert room.is_free(corner).tolist() == [False, True, False], (
        "the margin is a circle about the inner corner"
    )


@every_room
def test_furniture_and_receivers_stand_in_the_room(room):
    inside = Path([*room.floor, room.floor[0]]).contains_points
    for cuboid in room.furniture:
        corners = np.array(cuboid.mesh().vertices)
        assert inside(corners[:, :2]).all(), cuboid.name
        assert corners[:, 2].min() >= 0
        assert corners[:, 2].max() < room.height
    positions = torch.tensor([room.antenna[0], *room.gateways.values()])
    assert inside(positions[:, :2].double().numpy()).all()
    assert not any(cuboid.contains(positions, 0.01).any() for cuboid in room.furniture)
    assert inside([room.antenna[1][:2]]).all()


# --- outlines and files ---


def test_outlines_have_no_seam_within_a_plane_and_each_edge_once():
    """The L's floor and ceiling are two faces each, its corner walls meet in an edge."""
    lines = edges(shell(ROOMS["l_shape"]))
    assert lines.dtype == torch.float32
    steps = (lines[:, 1] - lines[:, 0]).abs()
    assert ((steps > 0).sum(1) == 1).all(), "none is a diagonal"
    upright = steps[:, 2] > 0
    assert (int(upright.sum()), int((~upright).sum())) == (6, 12)


def test_the_obj_file_has_the_meshes():
    meshes = ROOMS["slanted"].meshes()
    vertices, groups = parse_obj(wavefront_obj(meshes).splitlines(), "room.obj")
    assert [*groups] == [(mesh.name.replace(" ", "_"), mesh.material) for mesh in meshes]
    for mesh, faces in zip(meshes, groups.values(), strict=True):
        for found, face in zip(faces, mesh.faces, strict=True):
            np.testing.assert_allclose(
                vertices[list(found)], [mesh.vertices[k] for k in face], atol=1e-5
            )
