"""Planes of known walls against the floor plans and cuboids of the files."""

import math
import re

import pytest
import torch

from gaigs.data.synthetic import ROOM, meshes
from gaigs.data.synthetic.image_source import Room
from gaigs.io.meshes import wavefront_obj
from gaigs.splatting.placement.mirrored.paths import Mirrored
from gaigs.splatting.placement.mirrored.walls import read_planes
from gaigs.testing import example_links

LOWER, UPPER = torch.tensor([0.5, 0.5, 0.4]), torch.tensor([3.5, 2.5, 2.2])
EMPTY = Room((7.0, 5.0, 3.0), ("concrete",) * 6)
PLAN = "x,y\n0,0\n4,0\n4,3\n0,3\n0,0\n"


def write(folder, name, text):
    file = folder / name
    file.write_text(text)
    return file


def outward(planes, inside):
    """Rows with normals that point away from a place, as tuples of rounded numbers."""
    signs = torch.where(planes[:, :3] @ torch.as_tensor(inside) > planes[:, 3], -1.0, 1.0)
    return [
        tuple(round(value, 4) + 0.0 for value in row) for row in (signs[:, None] * planes).tolist()
    ]


def test_a_floor_plan_has_upright_walls_by_length_then_floor_and_ceiling_of_the_box(tmp_path):
    planes = read_planes(write(tmp_path, "plan.csv", PLAN), LOWER, UPPER)
    found = outward(planes, [2.0, 1.5, 1.0])
    assert {*found[:2]} == {(0, -1, 0, 0), (0, 1, 0, 3)}
    assert {*found[2:4]} == {(1, 0, 0, 4), (-1, 0, 0, 0)}
    assert {*found[4:]} == {(0, 0, 1, 2.2), (0, 0, -1, -0.4)}
    flat = read_planes(tmp_path / "plan.csv", LOWER, torch.tensor([3.5, 2.5, LOWER[2]]))
    assert torch.equal(flat, planes[:4])


def test_walls_at_any_angle_hold_their_own_ends(tmp_path):
    ends = [(1.0, 2.0), (4.0, 6.0), (2.5, 7.0)]
    planes = read_planes(
        write(tmp_path, "plan.csv", "".join(f"{x},{y}\n" for x, y in ends)), LOWER, UPPER
    )
    for row, pair in zip(planes[:2], ((0, 1), (1, 2)), strict=True):  # 5 m, then 1.8 m
        assert row[:3].norm().item() == pytest.approx(1)
        for end in pair:
            for height in (0.0, 2.0):
                assert row[:3] @ torch.tensor([*ends[end], height]) == pytest.approx(
                    row[3].item(), abs=1e-5
                )


def test_floor_and_ceiling_come_before_a_fifth_wall(tmp_path):
    plan = "0,0\n6,0\n6,5\n3,5\n3,4\n0,4\n0,0\n"
    planes = read_planes(write(tmp_path, "plan.csv", plan), LOWER, UPPER)
    assert len(planes) == 8
    assert planes[4:6, 2].abs().tolist() == [1, 1]
    assert not planes[:4, 2].any()
    assert not planes[6:, 2].any()


def test_pieces_of_one_wall_are_one_plane_and_count_together(tmp_path):
    """Two pieces of 2 m beside a niche are longer than a wall of 3 m."""
    plan = "0,0\n2,0\n2,-0.5\n3,-0.5\n3,0\n5,0\n5,3\n"
    planes = read_planes(write(tmp_path, "plan.csv", plan), LOWER, UPPER)
    assert outward(planes, [2.5, 1.0, 1.0])[:2] == [(0, -1, 0, 0), (1, 0, 0, 5)]
    back_and_forth = read_planes(write(tmp_path, "twice.csv", "0,0\n4,0\n0,0.001\n"), LOWER, UPPER)
    assert len(back_and_forth) == 3
    apart = read_planes(write(tmp_path, "apart.csv", "0,0\n4,0\n4,0.1\n0,0.1\n"), LOWER, UPPER)
    assert sorted(
        row[3] for row in outward(apart, [2.0, 0.05, 1.0]) if row[2] == 0 and row[0] == 0
    ) == [0.0, 0.1]


def test_furniture_adds_its_faces_to_the_walls_it_stands_at(tmp_path):
    planes = read_planes(write(tmp_path, "room.obj", wavefront_obj(meshes(ROOM))), LOWER, UPPER)
    areas = {}
    for lower, upper in [
        ((0.0, 0.0, 0.0), ROOM.size),
        *((box.lower, box.upper) for box in ROOM.furniture),
    ]:
        edges = [high - low for low, high in zip(lower, upper, strict=True)]
        for axis in range(3):
            for side in (lower, upper):
                key = axis, round(side[axis], 4)
                areas[key] = areas.get(key, 0) + math.prod(edges) / edges[axis]
    found = [(int(row[:3].abs().argmax()), round(abs(row[3].item()), 4)) for row in planes]
    assert sorted(found) == sorted(areas)
    sizes = [areas[key] for key in found]
    assert sizes == pytest.approx(sorted(sizes, reverse=True))


def test_the_largest_face_sets_the_normal(tmp_path):
    sliver = "v 0 0 0\nv 1 0 0\nv 0 1 0.015\n"
    floor = "v 0 0 0\nv 9 0 0\nv 0 9 0\n"
    planes = read_planes(
        write(tmp_path, "scan.obj", f"{sliver}{floor}f 1 2 3\nf 4 5 6\n"), LOWER, UPPER
    )
    assert planes.abs().tolist() == [[0, 0, 1, 0]]


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("walls.stl", "solid", r"must be a \.csv or \.obj, got walls\.stl"),
        ("walls.csv", "0,0\n1,zero\n", "line 2"),
        ("walls.csv", "0,0\n", "two wall vertices"),
        ("walls.obj", "v 0 0 0\nv 1 0 zero\n", "line 2"),
        ("walls.obj", "v 0 0 0\nv 1 0 0\nf 1 2 3\n", "line 3"),
        ("walls.obj", "v 0 0 0\nv 1 0 0\nv 1 1 0\n", "must have a wall longer than 0.001 m"),
        (
            "walls.obj",
            "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n",
            "must have a wall longer than 0.001 m",
        ),
    ],
)
def test_damaged_files_are_refused(tmp_path, name, text, message):
    with pytest.raises(ValueError, match=message):
        read_planes(write(tmp_path, name, text), LOWER, UPPER)
    with pytest.raises(FileNotFoundError, match=r"nowhere\.csv; set placement\.walls"):
        read_planes(tmp_path / "nowhere.csv", LOWER, UPPER)


@pytest.fixture
def links():
    return example_links("spectrum")


def started(links, file, planes=8, **options):
    torch.manual_seed(0)
    placement = Mirrored(
        links.scene, 2, planes, 1, 0, walls=None if file is None else str(file), **options
    )
    placement.fit(links)
    return placement


def test_a_placement_starts_from_the_walls(tmp_path, links):
    file = write(tmp_path, "room.obj", wavefront_obj(meshes(EMPTY)))
    placement = started(links, file)
    expected = read_planes(file, *placement.box)
    torch.testing.assert_close(placement.normals[:6], expected[:, :3])
    torch.testing.assert_close(
        placement.offsets[:6] + placement.normals[:6] @ placement.middle, expected[:, 3]
    )
    assert placement.used.tolist() == [*range(6)]
    assert int(placement.kept.sum()) == 7  # the direct path and one of each wall
    assert placement.shifts.requires_grad
    assert not torch.allclose(started(links, None).offsets, placement.offsets)


def test_of_more_walls_than_planes_the_largest_are_taken(tmp_path, links, caplog):
    file = write(tmp_path, "room.obj", wavefront_obj(meshes(ROOM)))
    placement = started(links, file, planes=6)
    planes = read_planes(file, *placement.box)
    torch.testing.assert_close(
        placement.offsets + placement.normals @ placement.middle, planes[:6, 3]
    )
    assert f"room.obj has {len(planes)} planes, the first 6 are taken" in caplog.text
    assert placement.used.tolist() == [*range(6)]


@pytest.mark.parametrize("fixed", [True, False])
def test_training_moves_walls_unless_they_are_fixed(tmp_path, links, fixed):
    placement = started(
        links, write(tmp_path, "room.obj", wavefront_obj(meshes(EMPTY))), fixed=fixed
    )
    before = placement.normals.clone(), placement.offsets.clone(), placement.plane_gains.clone()
    groups = placement.parameter_groups()
    assert ("planes" in groups) != fixed
    optimizer = torch.optim.SGD(
        [parameter for group in groups.values() for parameter in group], lr=0.1
    )
    placed = placement(None, links.query)
    (placed.gains.abs().square().sum() + placed.lengths.mean()).backward()
    optimizer.step()
    assert torch.equal(placement.normals, before[0]) == fixed
    assert torch.equal(placement.offsets, before[1]) == fixed
    assert not torch.equal(placement.plane_gains, before[2])


def test_walls_in_millimetres_are_doubted(tmp_path, caplog):
    read_planes(write(tmp_path, "plan.CSV", PLAN), LOWER, UPPER)
    assert not caplog.messages
    millimetres = PLAN.replace("4", "4000").replace("3", "3000")
    read_planes(write(tmp_path, "plan.csv", millimetres), LOWER, UPPER)
    assert re.search(
        r"placement.walls: the walls are \d.+ m across, transmitters and receivers .* m",
        caplog.text,
    )
