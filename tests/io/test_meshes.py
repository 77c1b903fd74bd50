"""Mesh files of rooms: their content, and defects with their places."""

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from gaigs.io.meshes import parse_obj, read_obj, read_ply

OBJ = (
    "# a room\no floor\nv 0 0 1\nv 4 0 1\nv 4.5 2e0 1\nv 0 2 1\nusemtl glass\nf 1/1 2/2 3/3 4/4\no "
    "roof\nf -4 -3 -2\n"
)


def ply(text):
    vertices = np.array(
        [(0, 0, 1), (4, 0, 1), (4.5, 2, 1), (0, 2, 1)], [(axis, "f4") for axis in "xyz"]
    )
    faces = np.empty(2, [("vertex_indices", object)])
    faces["vertex_indices"] = [np.array([0, 1, 2], "i4"), np.array([0, 2, 3], "i4")]
    return PlyData(
        [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")], text=text
    )


def test_an_obj_has_vertices_and_faces_by_object_and_material(tmp_path):
    (tmp_path / "room.obj").write_text(OBJ, encoding="utf-8-sig", newline="\r\n")
    vertices, groups = read_obj(tmp_path / "room.obj")
    assert vertices.tolist() == [[0, 0, 1], [4, 0, 1], [4.5, 2, 1], [0, 2, 1]]
    assert groups == {("floor", "glass"): [(0, 1, 2, 3)], ("roof", "glass"): [(0, 1, 2)]}


def test_a_line_of_an_obj_goes_on_after_a_backslash(tmp_path):
    (tmp_path / "room.OBJ").write_text(
        OBJ.replace("f 1/1 2/2", "f 1/1 \\\n 2/2\\").replace("0 2 1", "0 \\\n2 1")
    )
    with (tmp_path / "room.OBJ").open("a") as file:
        file.write("# from C:\\rooms\\\n#\n")
    assert repr(read_obj(tmp_path / "room.OBJ")) == repr(parse_obj(OBJ.splitlines(), ""))
    with pytest.raises(ValueError, match="line 12: expected numbers x y z, got 'v 0  0'"):
        parse_obj([*OBJ.splitlines(), "v 0 \\", "0"], "room.obj")
    with pytest.raises(ValueError, match=r"line 11: expected another line after the \\ at its end"):
        parse_obj([*OBJ.splitlines(), "v 0 0 \\"], "room.obj")


@pytest.mark.parametrize("text", [True, False])
def test_a_ply_has_vertices_and_faces(tmp_path, text):
    ply(text).write(str(tmp_path / "room.ply"))
    vertices, faces = read_ply(tmp_path / "room.ply")
    assert vertices["x"].tolist() == [0, 4, 4.5, 0]
    assert faces == [(0, 1, 2), (0, 2, 3)]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("v 0 0", "line 11: expected numbers x y z, got 'v 0 0'"),
        ("v 0 0 nan", "numbers x y z"),
        ("v 0 0 1e5", "positions within 1e5 m"),
        ("f 1 2", "a face of three vertices or more of the 4 before it, got 'f 1 2'"),
        ("f 1 2 5", "a face of three vertices or more of the 4 before it"),
        ("f -5 1 2", "a face of three"),
        ("f 1 2 three", "numbers of vertices, got 'f 1 2 three'"),
        (f"f 1 2 {'9' * 5000}", "numbers of vertices, got 'f 1 2 9{70,} ...'"),
    ],
)
def test_a_wrong_line_of_an_obj_is_named(line, message):
    with pytest.raises(ValueError, match=message):
        parse_obj([*OBJ.splitlines(), line], "room.obj")


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        (
            "4.5 2 1",
            "4.5 2 nan",
            r"vertex 3: expected positions within 1e5 m .*, got \[4\.5, 2\.0, nan\]",
        ),
        ("4.5 2 1", "1e9 2 1", "positions within 1e5 m"),
        (
            "3 0 2 3",
            "3 0 2 4",
            r"face 2: expected three or more of the 4 vertices, got \(0, 2, 4\)",
        ),
        ("3 0 2 3", "2 0 2", "face 2: expected three"),
        (
            "vertex 4",
            "vertex 400000000000",
            "cannot parse .*room.ply: .*; expected a .ply file of vertices x, y, z",
        ),
        (
            "property float z\n",
            "",
            "cannot parse .*room.ply: .*; expected a .ply file of vertices x, y, z",
        ),
    ],
)
def test_a_defect_of_a_ply_is_named(tmp_path, before, after, message):
    file = tmp_path / "room.ply"
    ply(True).write(str(file))
    text = file.read_text()
    assert before in text
    file.write_text(text.replace(before, after))
    with pytest.raises(ValueError, match=message) as caught:
        read_ply(file)
    assert "\n" not in str(caught.value)
