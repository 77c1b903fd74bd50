"""Mesh files of rooms: Wavefront OBJ and PLY."""

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
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


@dataclass(frozen=True)
class Mesh:
    """One object of one material."""

    name: str  # name of the object; several meshes may share it
    material: str  # name of the material; empty without one
    vertices: tuple[tuple[float, float, float], ...]  # corners, world frame [m]
    faces: tuple[Face, ...]  # corners of each planar convex face, counted from 0, in order

    def triangles(self) -> list[tuple[int, int, int]]:
        """Faces cut into triangles."""
        return triangles(self.faces)

    def compact(self) -> "Mesh":
        """The mesh without corners that belong to no face."""
        used = sorted(set(itertools.chain(*self.faces)))
        number = {corner: k for k, corner in enumerate(used)}
        vertices = tuple(self.vertices[corner] for corner in used)
        faces = tuple(tuple(map(number.__getitem__, face)) for face in self.faces)
        return Mesh(self.name, self.material, vertices, faces)


def wavefront_obj(
    meshes: Sequence[Mesh], heading: Sequence[str] = (), notes: Sequence[Sequence[str]] = ()
) -> str:
    """Meshes as a Wavefront OBJ file [m]: one object for each mesh, with its material.

    Args:
        heading: Comments at the start of the file.
        notes: Comments before each mesh; empty without comments.
    """
    # trimesh writes triangles alone, and a material only by a second file and with a texture.
    lines = [f"# {comment}" for comment in heading]
    first = 1  # number of the next vertex
    for mesh, comments in itertools.zip_longest(meshes, notes, fillvalue=()):
        lines += [f"# {comment}" for comment in comments]
        lines.append(f"o {mesh.name.replace(' ', '_')}")
        if mesh.material:
            lines.append(f"usemtl {mesh.material}")
        lines += [f"v {x:.7g} {y:.7g} {z:.7g}" for x, y, z in mesh.vertices]
        for face in mesh.faces:
            lines.append(" ".join(["f", *(str(first + corner) for corner in face)]))
        first += len(mesh.vertices)
    return "\n".join(lines) + "\n"


def read_obj(file: Path) -> tuple[Float[np.ndarray, "v 3"], Groups]:
    """Vertices [m] and faces of a Wavefront OBJ file, by ``parse_obj``."""
    return parse_obj(read_lines(file, "a mesh of 'v x y z' and 'f i j k'"), str(file))


def parse_obj(lines: Iterable[str], source: str) -> tuple[Float[np.ndarray, "v 3"], Groups]:
    """Vertices [m] and faces from lines of a Wavefront OBJ file; errors name source and line."""
    # trimesh's reader cuts polygons, loses materials without an .mtl file, counts negative numbers
    # from the end of the file, and leaves defects without their line.
    vertices: list[list[float]] = []
    groups: Groups = {}
    name, material = NO_NAME
    for number, line in _joined(lines, source):
        word, *words = line.split("#")[0].split() or [""]
        try:
            match word:
                case "o" | "g":
                    name = " ".join(words) or NO_NAME[0]
                case "usemtl":
                    material = " ".join(words) or NO_NAME[1]
                case "v":
                    vertices.append(_vertex(words))
                case "f":
                    face = _face(words, len(vertices))
                    groups.setdefault((name, material), []).append(face)
        except ValueError as error:
            shown = line.strip() if len(line) < 80 else f"{line.strip()[:80]} ..."
            raise ValueError(f"{source}, line {number}: expected {error}, got {shown!r}") from error
    return np.array(vertices, dtype=float).reshape(-1, 3), groups


def _joined(lines: Iterable[str], source: str) -> Iterator[tuple[int, str]]:
    """Number and text of each line; a line that ends in a backslash is joined with the next one.

    A joined line has the number of its last part, counted from 1.
    """
    begun = ""
    number = 0
    for number, part in enumerate(lines, 1):
        line = begun + part
        if line.rstrip().endswith("\\") and "#" not in line:  # a comment may end in a path
            begun = line.rstrip()[:-1] + " "
            continue
        begun = ""
        yield number, line
    if begun:
        expected = "another line after the \\ at its end"
        raise ValueError(f"{source}, line {number}: expected {expected}, got none")


def _vertex(words: Sequence[str]) -> list[float]:
    """The position [m] in a line ``v x y z``; a ``ValueError`` states the expected form."""
    if len(words) < 3 or not all(map(NUMBER.fullmatch, words[:3])):
        raise ValueError("numbers x y z")
    point = [float(word) for word in words[:3]]
    if not all(abs(value) < FAR for value in point):
        raise ValueError(WITHIN)
    return point


def _face(words: Sequence[str], count: int) -> Face:
    """Vertices, from 0, of a line ``f i j k`` after ``count`` vertices.

    Raises a ``ValueError`` with the expected form.
    """
    try:
        numbers = [int(word.split("/")[0]) for word in words]
    except ValueError:
        raise ValueError("numbers of vertices") from None
    # Vertices count from 1, or with negative numbers back from the last vertex so far.
    face = tuple(k - 1 if k > 0 else count + k for k in numbers)
    if len(face) < 3 or 0 in numbers or not all(0 <= corner < count for corner in face):
        raise ValueError(f"a face of three vertices or more of the {count} before it")
    return face


def read_ply(file: Path) -> tuple[np.ndarray, list[Face]]:
    """Vertices, a structured array with x, y, z [m] among its columns, and faces of a PLY file."""
    try:
        content = PlyData.read(str(file), mmap=False)
        vertices = content["vertex"].data
        vertices = vertices.astype([(column, float) for column in vertices.dtype.names])
        points = positions(vertices)
        columns = content["face"].data.dtype.names if "face" in content else ()
        key = next((name for name in ("vertex_indices", "vertex_index") if name in columns), None)
        faces = [] if key is None else [tuple(map(int, face)) for face in content["face"].data[key]]
    # Damaged headers make plyfile and numpy raise exceptions of many types.
    except Exception as error:
        cause = " ".join(str(error).split()) or type(error).__name__
        expected = "a .ply file of vertices x, y, z"
        raise ValueError(f"cannot parse {file}: {cause}; expected {expected}") from error
    check_mesh(points, faces, str(file))
    return vertices, faces


def positions(vertices: np.ndarray) -> Float[np.ndarray, "v 3"]:
    """Positions [m] of vertices from ``read_ply``."""
    return np.stack([vertices[axis] for axis in "xyz"], -1)


def triangles(faces: Iterable[Face]) -> list[tuple[int, int, int]]:
    """Polygons cut into triangles, as fans about their first corners."""
    corners = []
    for face in faces:
        corners += [(face[0], *pair) for pair in itertools.pairwise(face[1:])]
    return corners


def check_mesh(points: Float[np.ndarray, "v 3"], faces: Sequence[Face], source: str) -> None:
    """Raises a ``ValueError`` unless vertices are within ``FAR`` and faces refer to them."""
    near = np.abs(points) < FAR
    if not near.all():
        row = int((~near).any(1).argmax())
        got = points[row].tolist()
        raise ValueError(f"{source}, vertex {row + 1}: expected {WITHIN}, got {got}")
    for number, face in enumerate(faces, 1):
        if len(face) < 3 or not all(0 <= corner < len(points) for corner in face):
            expected = f"three or more of the {len(points)} vertices"
            raise ValueError(f"{source}, face {number}: expected {expected}, got {face}")
