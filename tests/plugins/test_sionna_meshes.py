"""Meshes of the rooms: closed, planar, free where they are said to be free, and drawn without
seams.
"""

import math

import numpy as np
import pytest
import torch
from gaigs_sionna.meshes import FURNITURE_MARGIN, WALL_MARGIN, Cuboid, edges
from gaigs_sionna.rooms import ROOMS
from gaigs_sionna.simulation import find_room
from matplotlib.path import Path
from scipy.spatial import ConvexHull, Delaunay

import gaigs
from gaigs.data.synthetic.image_source import Paths
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


@every_room
def test_so_many_receivers_hang_on_the_walls(room):
    name = next(name for name in ROOMS if ROOMS[name] is room)
    simulated = find_room(name, receivers=12)
    places = torch.stack([pose.position for pose in simulated.poses]).double()
    assert not room.is_furnished(places).any()
    for place, pose in zip(places, simulated.poses, strict=True):
        outline = room.outline(place[2].item())
        assert Path(outline.numpy(), closed=False).contains_point(place[:2].numpy())
        along = outline.roll(-1, 0) - outline
        share = ((place[:2] - outline) * along).sum(1) / along.square().sum(1)
        nearest = outline + share.clamp(0, 1)[:, None] * along
        assert (place[:2] - nearest).norm(dim=1).min().item() == pytest.approx(0.1, abs=1e-5)
        ahead = place + 0.5 * pose.rotation[:, 2]
        assert Path(outline.numpy()).contains_point(ahead[:2].numpy()), "it faces the room"
    apart = torch.cdist(places, places) + 10 * torch.eye(12)
    assert apart.min() > 0.4
    assert [receiver.name for receiver in simulated.gateways][:2] == ["gateway1", "gateway2"]


def test_spectra_and_channels_have_so_many_arrays(monkeypatch):
    def direct(room, receiver, transmitters, frequency, diffraction):
        return Paths(transmitters.double()[:, None], torch.ones(len(transmitters), 1).cdouble())

    monkeypatch.setattr("gaigs_sionna.simulation.find_paths", direct)
    options = {"room": "slanted", "transmitters": 4, "receivers": 3}
    channels = gaigs.links("sionna_csi", subcarriers=3, **options)
    assert channels.query.receivers.tolist() == 4 * [0, 1, 2]
    assert len({receiver.pose for receiver in channels.receivers}) == 3
    assert len(gaigs.links("sionna", **options)) == 12
    levels = gaigs.links("sionna_rssi", **options)
    assert len(levels.receivers) == 3
    for own, other in zip(levels.receivers, channels.receivers, strict=True):
        assert torch.equal(own.pose.position, other.pose.position)
    with pytest.raises(ValueError, match=r"or a number of data\.receivers"):
        gaigs.links("sionna_rssi", **options | {"receivers": [[1.0, 1.0, 1.0]]})
    with pytest.raises(ValueError, match="receivers must be at least 1"):
        gaigs.links("sionna", **options | {"receivers": 0})
    with pytest.raises(ValueError, match="got both"):
        gaigs.links("sionna", receiver=[1.0, 1.0, 1.0], **options)


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
