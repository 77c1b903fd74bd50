"""Meshes of rooms as files, Wavefront OBJ and PLY: what is wrong is told with its file, line and value."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from plyfile import PlyData

from gaigs.geometry import FAR, WITHIN
from gaigs.io.tables import NUMBER, read_lines, refuse

Face = tuple[int, ...]
"""Numbers of a polygon's vertices, from 0."""

Groups = dict[tuple[str, str], list[Face]]
"""Faces of a mesh, by the names of their object and material."""

NO_NAME = "mesh", "unnamed"
"""Of an object and a material that have none."""


def read_obj(file: Path) -> tuple[Float[np.ndarray, "v 3"], Groups]:
    """Vertices [m] and faces of a Wavefront OBJ file.

    Raises:
        ValueError: It cannot be read, or is as ``parse_obj`` refuses it.
    """
    defects: list[str] = []
    lines = read_lines(file, "a mesh of 'v x y z' and 'f i j k'", defects)
    refuse(file.parent, defects)
    return parse_obj(lines, str(file))


def parse_obj(lines: Iterable[str], source: str) -> tuple[Float[np.ndarray, "v 3"], Groups]:
    """The same from the file's lines.

    Args:
        lines: Of the file.
        source: What errors call it.

    Raises:
        ValueError: A line holds no numbers where it must, a vertex is too far away, or a face takes vertices that do
            not stand before it.
    """
    vertices: list[list[float]] = []
    groups: Groups = {}
    name, material = NO_NAME
    for number, line in enumerate(lines, 1):
        word, *rest = line.split("#")[0].split() or [""]
        try:
            match word:
                case "o" | "g":
                    name = " ".join(rest) or NO_NAME[0]
                case "usemtl":
                    material = " ".join(rest) or NO_NAME[1]
                case "v":
                    vertices.append(_vertex(rest[:3]))
                case "f":
                    face = _face([part.split("/")[0] for part in rest], len(vertices))
                    groups.setdefault((name, material), []).append(face)
        except ValueError as error:
            shown = line.strip() if len(line) < 80 else f"{line.strip()[:80]} ..."
            raise ValueError(f"{source}, line {number}, must hold {error}, got {shown!r}") from error
    return np.array(vertices, dtype=float).reshape(-1, 3), groups


def _vertex(words: list[str]) -> list[float]:
    if len(words) < 3 or not all(map(NUMBER.fullmatch, words)):
        raise ValueError("numbers x y z")
    point = [float(word) for word in words]
    if not all(abs(value) < FAR for value in point):
        raise ValueError(WITHIN)
    return point


def _face(words: list[str], count: int) -> Face:
    try:
        numbers = [int(word) for word in words]
    except ValueError:
        raise ValueError("numbers of vertices") from None
    # They count from 1, or back from the last vertex so far.
    face = tuple(k - 1 if k > 0 else count + k for k in numbers)
    if len(face) < 3 or not all(k and 0 <= corner < count for k, corner in zip(numbers, face, strict=True)):
        raise ValueError(f"a face of three vertices or more of the {count} before it")
    return face


def read_ply(file: Path) -> tuple[np.ndarray, list[Face]]:
    """Vertices, as a structured array with x, y and z [m] among its columns, and faces of a PLY file.

    Raises:
        ValueError: It is damaged, a column of the vertices holds no numbers, a vertex is too far away, or a face takes
            vertices that there are not.
    """
    try:
        content = PlyData.read(str(file), mmap=False)
        vertices = content["vertex"].data
        vertices = vertices.astype([(column, float) for column in vertices.dtype.names])
        points = np.stack([vertices[axis] for axis in "xyz"], -1)
        faces = [tuple(map(int, face)) for face in _indices(content)]
    except Exception as error:  # whatever plyfile and numpy meet in a damaged header
        told = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(
            f"{file} must be a whole .ply file of vertices x, y, z and of faces or none: {told}"
        ) from error
    check_mesh(points, faces, str(file))
    return vertices, faces


def check_mesh(points: Float[np.ndarray, "v 3"], faces: Sequence[Face], source: str) -> None:
    """Sees to it that vertices [m] are near enough, and faces made of them.

    Args:
        points, faces: Of a mesh.
        source: What errors call it.

    Raises:
        ValueError: A vertex is too far away or no number, or a face takes vertices that there are not.
    """
    if not (np.abs(points) < FAR).all():
        row = int((~(np.abs(points) < FAR)).any(1).argmax())
        raise ValueError(f"{source} must hold {WITHIN}, got {points[row].tolist()} at vertex {row + 1}")
    for number, face in enumerate(faces, 1):
        if len(face) < 3 or not all(0 <= corner < len(points) for corner in face):
            raise ValueError(
                f"{source}, face {number}, must be of three vertices or more of the {len(points)} there are, got {face}"
            )


def _indices(content: PlyData) -> Iterable:
    """The lists of vertices of a file's faces; none where it has no faces, or these no such list."""
    columns = content["face"].data.dtype.names if "face" in content else ()
    key = next((name for name in ("vertex_indices", "vertex_index") if name in columns), None)
    return [] if key is None else content["face"].data[key]
