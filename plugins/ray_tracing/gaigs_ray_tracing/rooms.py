"""Rooms as meshes: those that are known by name, and files of one's own."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from gaigs_sionna import tracing
from gaigs_sionna.meshes import THICKNESS
from gaigs_sionna.rooms import ROOMS

from gaigs.data import synthetic
from gaigs.io.meshes import NO_NAME, Mesh, check_mesh, parse_obj, positions, read_ply, wavefront_obj
from gaigs.io.meshes import read_obj as read_mesh

BUILT_IN = ("built_in", "synthetic", "synthetic_rssi", "synthetic_csi")
"""Names of the built-in room: its own, and those of the data that come from it."""

FURNITURE = {
    "partition": "plasterboard",
    "wardrobe": "wood",
    "bookshelf": "wood",
    "desk": "wood",
    "sofa": "wood",
    "refrigerator": "metal",
    "column": "concrete",
}
"""Materials of the built-in room's furniture. The simulation knows how much each piece dims, and no
material.
"""

SUFFIXES = (".obj", ".ply", ".xml")


def check_room(room: str) -> None:
    """Raises a ``ValueError`` unless a room of that name is known."""
    if room not in BUILT_IN and room not in ROOMS:
        raise ValueError(
            f"model 'ray_tracing' must know the room: one of built_in, {', '.join(ROOMS)}, got "
            f"{room!r}; set model.room, or model.mesh to a file of its surfaces"
        )


def find_meshes(room: str, mesh: str | None) -> list[Mesh]:
    """The surfaces of a room, each with a material's name.

    Args:
        room: Its name.
        mesh: File of its surfaces [m]; None for the room of that name.

    Raises:
        FileNotFoundError: There is no such file.
        ImportError, RuntimeError: A scene file takes Sionna RT, and it cannot be used.
        ValueError: The file is of another kind, damaged, or without surfaces; or there is no such
            room.
    """
    if mesh is not None:
        return _read(Path(mesh))
    check_room(room)
    if room in ROOMS:
        return ROOMS[room].meshes()
    shell = read_obj(wavefront_obj(synthetic.meshes(synthetic.ROOM)), "the built-in room")
    return [replace(part, material=part.name) if part.name in FURNITURE else part for part in shell]


def known_materials(meshes: Sequence[Mesh], chosen: Mapping[str, str]) -> dict[str, str]:
    """The tabulated material of each material of a mesh, by names in ascending order.

    Args:
        meshes: Surfaces.
        chosen: The user's choice for some materials.

    Raises:
        ValueError: A tabulated material is unknown, or a choice is for none of the materials.
    """
    names = sorted({mesh.material for mesh in meshes})
    if unused := sorted(set(chosen) - set(names)):
        raise ValueError(
            f"model.materials has {', '.join(unused)}, and the materials are {', '.join(names)}"
        )
    tabulated = {}
    for name in names:
        plain = name.removeprefix("mat-").removeprefix("itu_").removeprefix("itu-")
        tabulated[name] = chosen.get(name, FURNITURE.get(name, plain))
        if tabulated[name] not in THICKNESS:
            raise ValueError(
                f"material {name!r} must be one of {', '.join(THICKNESS)}, got "
                f"{tabulated[name]!r}; say which it is like: +model.materials.{name}=concrete"
            )
    return tabulated


def _read(file: Path) -> list[Mesh]:
    """The surfaces of a mesh or scene file; a ``ValueError`` if it has none."""
    if file.suffix not in SUFFIXES:
        raise ValueError(f"model.mesh must be a file {', '.join(SUFFIXES)}, got {file.name}")
    if not file.is_file():
        raise FileNotFoundError(
            f"no mesh at {file}; set model.mesh to a file of surfaces, or to null"
        )
    match file.suffix:
        case ".obj":
            points, groups = read_mesh(file)
            vertices = points.tolist()
            meshes = [_mesh(*names, vertices, faces) for names, faces in groups.items()]
        case ".ply":
            meshes = _read_ply(file)
        case _:
            meshes = _read_scene(file)
    if not meshes:
        raise ValueError(f"{file} must hold surfaces, and holds none")
    return meshes


def read_obj(text: str, source: str) -> list[Mesh]:
    """The surfaces of a Wavefront OBJ file, one mesh for each material of an object.

    Args:
        text: Content of the file.
        source: Its name in errors.

    Raises:
        ValueError: A line has no numbers where they must be, or a face has unknown vertices.
    """
    points, groups = parse_obj(text.splitlines(), source)
    vertices = points.tolist()
    return [_mesh(*names, vertices, faces) for names, faces in groups.items()]


def _read_ply(file: Path) -> list[Mesh]:
    """The surface of a PLY file as one mesh without a material's name; none without faces."""
    vertices, faces = read_ply(file)
    return [_mesh(file.stem, NO_NAME[1], positions(vertices).tolist(), faces)] if faces else []


def _read_scene(file: Path) -> list[Mesh]:
    """The surfaces of a scene of Mitsuba, as Sionna RT loads it."""
    rt = tracing.find_sionna()
    import mitsuba

    try:
        scene = rt.load_scene(str(file))
    # Whatever Mitsuba's parser raises, with a traceback in it where a material is wrong
    except Exception as error:
        message, traceback, calls = str(error).partition("Traceback (most recent call last):")
        cause = calls.strip().rpartition("\n")[2] if traceback else ""
        words = " ".join(f"{message} {cause}".split())
        raise ValueError(
            f"{file} must be a scene that Sionna RT reads, and is not: {words}"
        ) from error
    meshes = []
    for name, shape in scene.objects.items():
        parameters = mitsuba.traverse(shape.mi_mesh)
        if "vertex_positions" not in parameters:  # such as a rectangle of Mitsuba
            raise ValueError(
                f"{file}, shape {name!r}, must be a mesh of type ply or obj; export it as one, as "
                "Blender does"
            )
        points = parameters["vertex_positions"].numpy().reshape(-1, 3).astype(float)
        faces = [tuple(face) for face in parameters["faces"].numpy().reshape(-1, 3).tolist()]
        check_mesh(points, faces, f"{file}, shape {name!r}")
        meshes.append(_mesh(name, shape.radio_material.name, points.tolist(), faces))
    return meshes


def _mesh(name: str, material: str, vertices: Sequence, faces: Sequence[tuple[int, ...]]) -> Mesh:
    """A mesh with the vertices that its faces have, in the order of the faces."""
    numbers = {corner: k for k, corner in enumerate(dict.fromkeys(itertools.chain(*faces)))}
    corners = tuple(tuple(vertices[corner]) for corner in numbers)
    renumbered = tuple(tuple(map(numbers.__getitem__, face)) for face in faces)
    return Mesh(name, material, corners, renumbered)
