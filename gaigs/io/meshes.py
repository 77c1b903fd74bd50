"""Mesh files of rooms: Wavefront OBJ and PLY."""

import itertools
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from plyfile import PlyData

from gaigs.io import FAR, WITHIN
from gaigs.io.tables import NUMBER, read_lines

Face = tuple[int, ...]
"""Numbers of a polygon's vertices, from 0."""

Groups = dict[tuple[str, str], list[Face]]
"""Faces of a mesh, by the names of their object and material."""

NO_NAME = "mesh", "unnamed"
"""Names of an object and a material without a name."""


def read_obj(file: Path) -> tuple[Float[np.ndarray, "v 3"], Groups]:
    """Vertices [m] and faces of a Wavefront OBJ file, as by ``parse_obj``."""
    return parse_obj(read_lines(file, "a mesh of 'v x y z' and 'f i j k'"), str(file))


def parse_obj(lines: Iterable[str], source: str) -> tuple[Float[np.ndarray, "v 3"], Groups]:
    """Vertices [m] and faces of the lines of a Wavefront OBJ file; a ``ValueError`` names the
    source and the line.
    """
    vertices: list[list[float]] = []
    groups: Groups = {}
    name, material = NO_NAME
    begun = ""
    for number, part in enumerate(lines, 1):
        line, begun = begun + part, ""
        if (
            line.rstrip().endswith("\\") and "#" not in line
        ):  # goes on in the next one; a comment may end in a path
            begun = line.rstrip()[:-1] + " "
            continue
        word, *rest = line.split("#")[0].split() or [""]
        try:
            match word:
                case "o" | "g":
                    name = " ".join(rest) or NO_NAME[0]
                case "usemtl":
                    material = " ".join(rest) or NO_NAME[1]
                case "v":
                    if len(rest) < 3 or not all(map(NUMBER.fullmatch, rest[:3])):
                        raise ValueError("numbers x y z")
                    vertices.append([float(word) for word in rest[:3]])
                    if not all(abs(value) < FAR for value in vertices[-1]):
                        raise ValueError(WITHIN)
                case "f":
                    face = _face([part.split("/")[0] for part in rest], len(vertices))
                    groups.setdefault((name, material), []).append(face)
        except ValueError as error:
            shown = line.strip() if len(line) < 80 else f"{line.strip()[:80]} ..."
            raise ValueError(f"{source}, line {number}: expected {error}, got {shown!r}") from error
    if begun:
        raise ValueError(
            f"{source}, line {number}: expected another line after the \\ at its end, got none"
        )
    return np.array(vertices, dtype=float).reshape(-1, 3), groups


def _face(words: list[str], count: int) -> Face:
    try:
        numbers = [int(word) for word in words]
    except ValueError:
        raise ValueError("numbers of vertices") from None
    # They count from 1, or back from the last vertex so far.
    face = tuple(k - 1 if k > 0 else count + k for k in numbers)
    if len(face) < 3 or not all(
        k and 0 <= corner < count for k, corner in zip(numbers, face, strict=True)
    ):
        raise ValueError(f"a face of three vertices or more of the {count} before it")
    return face


def read_ply(file: Path) -> tuple[np.ndarray, list[Face]]:
    """Vertices, as a structured array with x, y and z [m] among its columns, and faces of a PLY
    file.

    Raises:
        ValueError: The file is damaged, a column holds no numbers, or the mesh has a defect, see
            ``check_mesh``.
    """
    try:
        content = PlyData.read(str(file), mmap=False)
        vertices = content["vertex"].data
        vertices = vertices.astype([(column, float) for column in vertices.dtype.names])
        points = positions(vertices)
        columns = content["face"].data.dtype.names if "face" in content else ()
        key = next((name for name in ("vertex_indices", "vertex_index") if name in columns), None)
        faces = [] if key is None else [tuple(map(int, face)) for face in content["face"].data[key]]
    except (
        Exception
    ) as error:  # damaged headers make plyfile and numpy raise exceptions of many types
        cause = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(
            f"cannot parse {file}: {cause}; expected a .ply file of vertices x, y, z"
        ) from error
    check_mesh(points, faces, str(file))
    return vertices, faces


def positions(vertices: np.ndarray) -> Float[np.ndarray, "v 3"]:
    """Positions [m] of vertices as ``read_ply`` gives them."""
    return np.stack([vertices[axis] for axis in "xyz"], -1)


def triangles(faces: Iterable[Face]) -> list[tuple[int, int, int]]:
    """Polygons cut into triangles, as fans about their first corners."""
    return [(face[0], *pair) for face in faces for pair in itertools.pairwise(face[1:])]


def check_mesh(points: Float[np.ndarray, "v 3"], faces: Sequence[Face], source: str) -> None:
    """Raises a ``ValueError`` for a vertex too far away or without numbers, or a face that refers
    to a missing one.
    """
    if not (np.abs(points) < FAR).all():
        row = int((~(np.abs(points) < FAR)).any(1).argmax())
        raise ValueError(
            f"{source}, vertex {row + 1}: expected {WITHIN}, got {points[row].tolist()}"
        )
    for number, face in enumerate(faces, 1):
        if len(face) < 3 or not all(0 <= corner < len(points) for corner in face):
            expected = f"three or more of the {len(points)} vertices"
            raise ValueError(f"{source}, face {number}: expected {expected}, got {face}")
