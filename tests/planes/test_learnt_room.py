"""Export of a learnt room against known rooms: tables, shapes, files."""

from collections import Counter

import numpy as np
import pytest
import torch
from plyfile import PlyData

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Pose, semi_axes
from gaigs.core.query import Query
from gaigs.core.task.rssi import Rssi
from gaigs.data import Links, Split
from gaigs.planes.learnt_room import build_room, outline_planes
from gaigs.planes.room_files import summarize, write_room
from gaigs.planes.room_paths import trace_paths
from gaigs.splatting.placement.mirrored.paths import Mirrored

SIZE = np.array([6.0, 4.0, 3.0])
PERMITTIVITY = 5.0 - 0.4j


@pytest.fixture
def links():
    generator = torch.Generator().manual_seed(3)
    places = 0.3 + torch.rand(40, 3, generator=generator) * (torch.tensor(SIZE).float() - 0.6)
    receivers = tuple(
        Receiver(name, Pose(torch.tensor(place), torch.eye(3)))
        for name, place in {"low": [0.2, 0.2, 0.3], "high": [5.7, 3.6, 2.8]}.items()
    )
    split = Split(
        "random", torch.arange(50), torch.zeros(0, dtype=torch.long), torch.arange(50, 80)
    )
    query = Query(places.repeat_interleave(2, 0), torch.arange(80) % 2)
    return Links(query, receivers, torch.zeros(80), Rssi(), split=split)


@pytest.fixture
def build(links):
    def build(planes=6, order=2, obstacles=0):
        """A placement whose first six planes are the room's faces; every second normal points
        inwards.
        """
        torch.manual_seed(0)
        placement = Mirrored(links.scene, 2, planes, order, obstacles)
        with torch.no_grad():
            for k, axis in enumerate(torch.eye(3)):
                placement.place(k, torch.tensor([*axis, SIZE[k]]))
                placement.place(k + 3, torch.tensor([*axis, 0.0]))
            placement.log_permittivities.fill_(np.log(PERMITTIVITY.real - 1))
            placement.log_conductivities.fill_(np.log(-PERMITTIVITY.imag))
            placement.log_extents.fill_(np.log(1e3))
        return placement

    return build


def add(placement, normal, offset):
    """Puts the seventh plane somewhere, and keeps all paths."""
    with torch.no_grad():
        placement.place(6, torch.tensor([*normal, offset]))
        placement.kept.fill_(True)
    return placement


def training(links):
    return links.query[links.split.train]


def newell(corners):
    """A polygon's normal times its area."""
    return sum(np.cross(a, b) for a, b in zip(corners, np.roll(corners, -1, 0), strict=True)) / 2


def test_planes_face_outwards_with_their_loss_and_paths(links, build):
    placement = build()
    with torch.no_grad():
        placement.plane_gains[1] = -0.3
    planes = {plane["number"]: plane for plane in summarize(placement, training(links))["planes"]}
    assert planes.keys() == set(range(6))
    root = np.sqrt(PERMITTIVITY)
    loss = -20 * np.log10(abs((root - 1) / (root + 1)))
    for k, plane in planes.items():
        axis = np.eye(3)[k % 3]
        np.testing.assert_allclose(plane["normal"], axis if k < 3 else -axis, atol=1e-4)
        assert plane["offset_m"] == pytest.approx(SIZE[k] if k < 3 else 0, abs=1e-4)
        assert plane["loss_db"] == pytest.approx(
            loss + (20 * np.log10(np.e) * 0.3 if k == 1 else 0), abs=0.02
        )
        assert plane["paths"] == 1 + 5 + 5  # alone, before each other one, behind each
    shares = [plane["share"] for plane in planes.values()]
    assert shares == sorted(shares, reverse=True)


def test_shares_are_those_of_image_sources(links, build):
    placement = build(order=1)
    with torch.no_grad():
        placement.kept.copy_((placement.sequences[:, 0] == 0) | (placement.sequences[:, 0] == -1))
    found = summarize(placement, training(links))
    direct, mirrored = [], []

    def root(cosine):
        return np.sqrt(PERMITTIVITY - (1 - cosine**2))

    for place, receiver in zip(
        *(part.numpy() for part in (training(links).transmitters, training(links).receivers)),
        strict=True,
    ):
        heard = links.receivers[receiver].pose.position.numpy()
        image = place * (-1, 1, 1) + (2 * SIZE[0], 0, 0)
        length = np.linalg.norm(image - heard)
        cosine = abs(image - heard)[0] / length
        direct.append(1 / np.linalg.norm(place - heard) ** 2)
        mirrored.append(abs((cosine - root(cosine)) / (cosine + root(cosine))) ** 2 / length**2)
    share = np.mean(np.array(mirrored) / np.add(direct, mirrored))
    assert found["planes"][0]["share"] == pytest.approx(share, rel=1e-3)
    assert found["paths"] == [
        {"bounces": 0, "kept": 1, "share": pytest.approx(1 - share, rel=1e-3)},
        {"bounces": 1, "kept": 1, "share": pytest.approx(share, rel=1e-3)},
    ]


def test_a_loss_is_that_where_the_plane_reflects_best(links, build):
    placement = add(build(planes=7), [0.6, 0.0, 0.8], 2.0)
    middle, extents = np.array([1.0, 2.0, 0.5]), np.array([0.7, 0.9, 1.2])
    with torch.no_grad():
        placement.middles[6] = torch.tensor(middle) - placement.middle
        placement.log_extents[6] = torch.tensor(np.log(extents))
    planes = {plane["number"]: plane for plane in summarize(placement, training(links))["planes"]}
    u, v = np.array([0.8, 0, -0.6]), np.array([0, 1.0, 0])
    steps = np.linspace(-4, 4, 801)
    points = 2.0 * np.array([0.6, 0, 0.8]) + steps[:, None, None] * u + steps[:, None] * v
    least = (((points - middle) / extents) ** 2).sum(-1).min() / 2
    gained = planes[6]["loss_db"] - planes[5]["loss_db"]
    assert gained == pytest.approx(20 * np.log10(np.e) * least, abs=0.02)


def test_walls_close_to_a_box(links, build):
    placement = build()
    planes = outline_planes(placement, trace_paths(placement, training(links)))
    assert [plane.share for plane in planes] == sorted(
        (plane.share for plane in planes), reverse=True
    )
    ends = Counter()
    for plane in planes:
        area = SIZE.prod() / SIZE[plane.number % 3]
        np.testing.assert_allclose(newell(plane.corners), area * plane.normal, atol=1e-3)
        corners = [tuple(corner) for corner in plane.corners.round(3)]
        ends.update(
            frozenset(edge) for edge in zip(corners, corners[1:] + corners[:1], strict=True)
        )
    assert len(ends) == 12
    assert set(ends.values()) == {2}  # each edge belongs to two walls


def test_a_wall_without_others_ends_beyond_the_paths_ends(links, build):
    placement = build(order=1)
    with torch.no_grad():
        placement.kept.copy_((placement.sequences[:, 0] == 0) | (placement.sequences[:, 0] == -1))
    found = trace_paths(placement, training(links))
    (plane,) = outline_planes(placement, found)
    rim = plane.corners[:, 1:]
    np.testing.assert_allclose(plane.corners[:, 0], SIZE[0], atol=1e-4)
    assert (rim.min(0) < found.ends.min(0)[1:]).all()
    assert (rim.max(0) > found.ends.max(0)[1:]).all()
    assert np.ptp(rim, 0).max() < 2 * SIZE.max()


def test_a_plane_within_the_room_spans_its_bounces(links, build):
    placement = add(build(planes=7), [0.6, 0.8, 0.0], 3.2)
    found = trace_paths(placement, training(links))
    (plane,) = (plane for plane in outline_planes(placement, found) if plane.number == 6)
    np.testing.assert_allclose(
        plane.normal, [-0.6, -0.8, 0], atol=1e-6
    )  # away from the room's middle
    np.testing.assert_allclose(plane.corners @ plane.normal, -3.2, atol=1e-4)
    assert (plane.corners >= -1e-4).all()
    assert (plane.corners <= SIZE + 1e-4).all()
    link, path = np.nonzero((found.sequences == (-1, 6)).all(1) & (found.shares > 0))
    bounces = found.bounces[link, path, -1]
    for axis in ([-0.8, 0.6, 0.0], [0.0, 0, 1]):
        drawn, met = plane.corners @ axis, bounces @ axis
        assert drawn.min() < np.quantile(met, 0.1)
        assert drawn.max() > np.quantile(met, 0.9)
    assert newell(plane.corners) @ plane.normal > 0
    walls = [other for other in outline_planes(placement, found) if other.number != 6]
    assert sum(np.linalg.norm(newell(wall.corners)) for wall in walls) == pytest.approx(
        2 * (24 + 18 + 12), abs=0.01
    )


def test_a_window_ends_a_wall(links, build):
    placement = build()
    with torch.no_grad():
        placement.middles[0] = torch.tensor([6.0, 1.5, 1.0]) - placement.middle
        placement.log_extents[0, 1] = np.log(0.4)
    planes = outline_planes(placement, trace_paths(placement, training(links)))
    (wall,) = (plane for plane in planes if plane.number == 0)
    np.testing.assert_allclose(wall.corners[:, 1].min(), 1.5 - 0.8, atol=1e-3)
    np.testing.assert_allclose(wall.corners[:, 1].max(), 1.5 + 0.8, atol=1e-3)


def test_a_plane_far_off_is_left_out(links, build):
    placement = add(build(planes=7), [1.0, 0.0, 0.0], 60.0)
    with torch.no_grad():
        placement.plane_gains[6] = -5
    found = trace_paths(placement, training(links))
    assert 6 in [plane["number"] for plane in summarize(placement, training(links))["planes"]]
    assert {plane.number for plane in outline_planes(placement, found)} == set(range(6))


def test_paths_are_as_long_as_to_their_images(links, build):
    placement = build(obstacles=3)
    room = build_room(placement, links)
    first = links.query[links.split.test[:2]]  # one place, two receivers
    lengths = placement(None, first).lengths.detach().numpy().ravel()
    powers = [path.power_db for path in room.paths]
    assert powers[0] == 0
    assert powers == sorted(powers, reverse=True)
    heard = {tuple(np.round(path.points[-1], 3)) for path in room.paths}
    assert len(heard) == 2
    for path in room.paths:
        np.testing.assert_allclose(path.points[0], first.transmitters[0])
        length = np.linalg.norm(np.diff(path.points, axis=0), axis=1).sum()
        assert np.abs(lengths - length).min() < 1e-4
        for before, bounce, after in zip(
            path.points, path.points[1:], path.points[2:], strict=False
        ):
            (axis,) = np.nonzero(np.minimum(abs(bounce), abs(bounce - SIZE)) < 1e-4)[0]
            come, gone = (part / np.linalg.norm(part) for part in (bounce - before, after - bounce))
            come[axis] *= -1
            np.testing.assert_allclose(come, gone, atol=1e-4)
    assert len(room.matter.centres) == 3


def test_the_direct_path_alone_makes_no_room(links, build):
    placement = build(order=0)
    room = build_room(placement, links)
    assert room.planes == []
    assert room.matter is None
    assert [len(path.points) for path in room.paths] == [2, 2]
    assert summarize(placement, training(links)) == {
        "planes": [],
        "paths": [{"bounces": 0, "kept": 1, "share": 1.0}],
    }


def parsed(text):
    """Objects of a Wavefront OBJ file: corners of the face of each."""
    vertices, faces, name = [], {}, None
    for line in text.splitlines():
        kind, _, rest = line.partition(" ")
        if kind == "o":
            name = rest
        elif kind == "v":
            vertices.append([float(number) for number in rest.split()])
        elif kind == "f":
            faces[name] = np.array([vertices[int(number) - 1] for number in rest.split()])
        else:
            assert kind == "#", line
    return faces


def test_planes_are_written_as_wavefront_obj(links, build, tmp_path):
    placement = build()
    write_room(placement, training(links), tmp_path)
    assert [file.name for file in tmp_path.iterdir()] == ["planes.obj"]
    text = (tmp_path / "planes.obj").read_text()
    faces = parsed(text)
    planes = outline_planes(placement, trace_paths(placement, training(links)))
    assert [*faces] == [f"plane_{plane.number}" for plane in planes]
    for plane, corners in zip(planes, faces.values(), strict=True):
        np.testing.assert_allclose(corners, plane.corners, atol=1e-4)
        assert newell(corners) @ plane.normal > 0  # counterclockwise as seen from outside
    assert "# normal 1.0000 0.0000 0.0000, offset 6.000 m, loss" in text


def test_obstacles_are_written_as_splats(links, build, tmp_path):
    placement = build(obstacles=4)
    blobs = placement.obstacles
    with torch.no_grad():
        blobs.log_densities.copy_(torch.tensor([-12.0, -1.0, 0.5, 5.0]))  # clear ... opaque
        blobs.log_widths.copy_(torch.tensor([[0.1, 0.2, 0.4]]).log().expand(4, 3))
    write_room(placement, training(links), tmp_path)
    file = PlyData.read(str(tmp_path / "obstacles.ply"))
    vertices = file["vertex"]

    def columns(*names):
        return torch.from_numpy(np.stack([vertices[name] for name in names], -1))

    torch.testing.assert_close(columns("x", "y", "z"), blobs.centres.data + placement.middle)
    axes = semi_axes(
        columns("rot_0", "rot_1", "rot_2", "rot_3"), columns("scale_0", "scale_1", "scale_2").exp()
    )
    torch.testing.assert_close(axes @ axes.mT, torch.diag_embed(blobs.widths.data.square()))
    logits = columns("opacity")[:, 0]
    depths = np.exp([-12.0, -1.0, 0.5, 5.0]) * np.sqrt(2 * np.pi) * 0.2
    np.testing.assert_allclose(logits.sigmoid().numpy(), 1 - np.exp(-2 * depths), rtol=1e-4)
    assert torch.isfinite(logits).all()
