"""Learnt rooms for 3-D programs, as glTF and Wavefront OBJ, and for ray tracers, as scenes of
Mitsuba.
"""

import base64
import cmath
import hashlib
import json
import math
import re
import struct
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import torch
from jaxtyping import Complex
from plyfile import PlyData, PlyElement
from torch import Tensor

from gaigs.core.query import check_carrier
from gaigs.data.sionna.meshes import Mesh
from gaigs.data.synthetic.image_source import TABULATED, conductivity
from gaigs.io.files import atomic_write, write_text
from gaigs.model import Model, Wrapper
from gaigs.model.mirrored import MirroredSplatting
from gaigs.planes.learnt_room import LearntPlane, outline_planes
from gaigs.planes.materials import Material, materials
from gaigs.planes.obstacle_surfaces import Sheet, fit_sheets
from gaigs.planes.room_files import wavefront_obj
from gaigs.planes.room_paths import trace_paths
from gaigs.processes import only_run
from gaigs.registry import name_of

COLOUR = 0.0, 0.45, 0.70, 0.35
"""Red, green, blue and opacity of planes: the figures' blue, through which the room shows."""

THINNEST = 1e-5
"""Thickness of the sheets of obstacles [m]: thin against the wavelength, so that only the
conductance counts.
"""

FREE_SPACE = 376.73
"""Wave impedance of free space [ohm]."""

CARRIERS_OF_ITU = 1e9, 40e9
"""Lowest and highest carrier [Hz] at which all of ``TABULATED`` are tabulated."""


def write_room(model: Model, file: Path, frequency: float | None = None) -> list[Path]:
    """Writes the planes and obstacles that a model has learnt, of an ensemble its first member;
    gives the files.

    Args:
        file: ``.gltf``, ``.glb``, ``.obj``, or a scene ``.xml`` of Mitsuba, whose meshes get a
            folder beside it.
        frequency: Carrier of a scene's materials [Hz]; None: that of the training links, of several
            the middle one.

    Raises:
        ValueError: The model has no planes, or a scene's carrier is unknown or impossible.
    """
    own, suffix = mirrored_of("a learnt room", model), file.suffix.lower()
    if suffix == ".xml":
        frequency = own.scene.middle_frequency if frequency is None else frequency
        if frequency is None:
            raise ValueError(
                "materials depend on the carrier, which the data do not know; set frequency=... [Hz]"
            )
        frequency = float(frequency)
        check_carrier("frequency", frequency)
    found = trace_paths(own.placement, own.traced)
    planes = outline_planes(own.placement, found)
    corners = np.concatenate([found.ends, *(plane.corners for plane in planes)])
    sheets, rest = fit_sheets(own.placement, own.traced, corners.min(0), corners.max(0))
    meshes = [
        *map(mesh_of, planes),
        *(mesh_of_sheet(number, sheet) for number, sheet in enumerate(sheets)),
    ]
    if suffix == ".obj":
        write_text(file, wavefront_obj(own.placement, found, sheets))
        return [file]
    if frequency is None or suffix != ".xml":
        extras = [
            *({"share": plane.share} for plane in planes),
            *({"loss_db": sheet.loss_db} for sheet in sheets),
        ]
        write_gltf(file, meshes, extras)
        return [file]
    chosen = materials(own.placement, own.traced, frequency)
    bsdfs = [itu_bsdf(chosen[plane.number], frequency) for plane in planes] + [
        *map(sheet_bsdf, sheets)
    ]
    comments = [f"Materials for {frequency:.7g} Hz.", *map(str, own.scene.flat_axes)]
    if own.scene.task.dtype.is_complex:
        for receiver, gain in zip(
            own.scene.receivers, traced_gains(own, rest).tolist(), strict=True
        ):
            turned = f"{abs(gain):.4g}, turned by {math.degrees(cmath.phase(gain)):.2f} degrees"
            conjugated = ", then conjugated" if own.pooling.array_sign > 0 else ""
            comments.append(
                f"Channels of {receiver.name} are those traced times {turned}{conjugated}."
            )
    return write_scene(file, meshes, bsdfs, comments)


def mirrored_of(kind: str, model: Model) -> MirroredSplatting:
    """The mirrored Gaussians of a model, without its kriging, of an ensemble those of its first
    member.
    """
    own = model
    while isinstance(own, Wrapper):
        own = own.underlying
    if not isinstance(own, MirroredSplatting):
        raise ValueError(
            f"{kind} takes a model 'mirrored', got {name_of(own)!r}; train it on the same data"
        )
    return own


def mesh_of(plane: LearntPlane) -> Mesh:
    """A plane as a mesh of one face."""
    corners = tuple(map(tuple, plane.corners.tolist()))
    return Mesh(f"plane_{plane.number}", "", corners, (tuple(range(len(corners))),))


def mesh_of_sheet(number: int, sheet: Sheet) -> Mesh:
    """Surfaces of obstacles as a mesh of triangles."""
    vertices, faces = (tuple(map(tuple, part.tolist())) for part in (sheet.vertices, sheet.faces))
    return Mesh(f"obstacle_{number}", "", vertices, faces)


@torch.no_grad()
def traced_gains(model: MirroredSplatting, rest: float) -> Complex[Tensor, " receivers"]:
    """Gain of each receiver's channels over those that Sionna RT traces; ``rest`` is that of
    ``fit_sheets`` [Np].
    """
    placement = model.placement
    amplitudes = (
        placement.receiver_gains + placement.path_gains[0] + rest
    ).exp() * model.pooling.strength
    return torch.polar(amplitudes, placement.receiver_phases)


class Bsdf(NamedTuple):
    """What a mesh is made of, as a BSDF of Mitsuba: its name, its type and its properties."""

    name: str
    kind: str
    properties: tuple[tuple[str, str | float], ...]


def itu_bsdf(material: Material, frequency: float) -> Bsdf:
    """A material of ITU-R P.2040 by its name, which follows the carrier that is set in Sionna RT.

    For a carrier [Hz] outside the tables it is the extrapolated numbers of this carrier.
    """
    name, thickness = (
        f"{material.name}-{1e3 * material.thickness:.4g}mm",
        ("thickness", material.thickness),
    )
    if CARRIERS_OF_ITU[0] <= frequency <= CARRIERS_OF_ITU[1]:
        return Bsdf(name, "itu-radio-material", (("type", material.name), thickness))
    numbers = TABULATED[material.name][0], conductivity(material.name, frequency)
    parts = zip(("relative_permittivity", "conductivity"), numbers, strict=True)
    return Bsdf(name, "radio-material", (thickness, *parts))


def sheet_bsdf(sheet: Sheet) -> Bsdf:
    """A sheet of obstacles, which reflects nothing: all of that energy is scattered, which Sionna
    RT leaves out.
    """
    conductivity = sheet.conductance / (THINNEST * FREE_SPACE)
    properties = (
        ("thickness", THINNEST),
        ("conductivity", conductivity),
        ("scattering_coefficient", 1.0),
    )
    return Bsdf(
        f"sheet-{sheet.loss_db:.4g}dB",
        "radio-material",
        (("relative_permittivity", 1.0), *properties),
    )


def write_scene(
    file: Path, meshes: Sequence[Mesh], bsdfs: Sequence[Bsdf], comments: Sequence[str] = ()
) -> list[Path]:
    """Writes a scene of Mitsuba for Sionna RT, and a mesh ``.ply`` of each surface beside it; gives
    the files.
    """
    scene = ElementTree.Element("scene", version="2.1.0")
    for comment in ("Learnt by gaigs; metres, z up.", *comments):
        scene.append(ElementTree.Comment(f" {re.sub('-+', '-', comment)} "))
    for bsdf in {bsdf.name: bsdf for bsdf in bsdfs}.values():
        element = ElementTree.SubElement(scene, "bsdf", id=bsdf.name, type=bsdf.kind)
        for name, value in bsdf.properties:
            kind, text = ("string", value) if isinstance(value, str) else ("float", f"{value:.6g}")
            ElementTree.SubElement(element, kind, name=name, value=text)
    folder, files = file.with_name(f"{file.stem}_meshes"), [file]
    folder.mkdir(exist_ok=True)
    with only_run(folder, waits=True):
        for mesh, bsdf in zip(meshes, bsdfs, strict=True):
            vertices = np.array([*mesh.vertices], dtype=[(axis, "f4") for axis in "xyz"])
            faces = np.array(
                [(face,) for face in mesh.triangles()], dtype=[("vertex_indices", "i4", (3,))]
            )
            elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
            # Named by content: a scene that is read meanwhile never has another scene's meshes.
            digest = hashlib.sha256(vertices.tobytes() + faces.tobytes()).hexdigest()[:8]
            files.append(folder / f"{mesh.name}-{digest}.ply")
            with atomic_write(files[-1]) as part:
                PlyData(elements, byte_order="<").write(str(part))
            shape = ElementTree.SubElement(scene, "shape", type="ply", id=f"mesh-{mesh.name}")
            ElementTree.SubElement(
                shape, "string", name="filename", value=f"{folder.name}/{files[-1].name}"
            )
            ElementTree.SubElement(shape, "boolean", name="face_normals", value="true")
            ElementTree.SubElement(shape, "ref", id=bsdf.name, name="bsdf")
        ElementTree.indent(scene)
        write_text(file, ElementTree.tostring(scene, encoding="unicode") + "\n")
        for old in {*folder.glob("plane_*.ply"), *folder.glob("obstacle_*.ply")} - {*files}:
            if old.stat().st_mtime < time.time() - 60:  # the scene before may still be read
                old.unlink()
    return files


def write_gltf(file: Path, meshes: Sequence[Mesh], extras: Sequence[Mapping[str, float]]) -> None:
    """Writes meshes as glTF 2.0, ``.glb`` or, with its buffer within, ``.gltf``; a node each, with
    its extras.

    The root's rotation turns z up into glTF's y up.
    """
    buffer, views, accessors = b"", [], []

    def add(array: np.ndarray, kind: str, target: int) -> int:
        nonlocal buffer
        views.append(
            {"buffer": 0, "byteOffset": len(buffer), "byteLength": array.nbytes, "target": target}
        )
        component = (
            5126 if array.dtype == np.float32 else 5125
        )  # float and unsigned int, of OpenGL as the targets
        accessors.append(
            {
                "bufferView": len(views) - 1,
                "componentType": component,
                "count": len(array),
                "type": kind,
            }
            | (
                {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
                if kind == "VEC3"
                else {}
            )
        )
        buffer += array.tobytes()  # both types have 4 bytes, so that all parts stay aligned
        return len(views) - 1

    shapes = []
    for mesh in meshes:
        corners = add(np.array(mesh.vertices, np.float32), "VEC3", 34962)
        faces = add(np.array(mesh.triangles(), np.uint32).ravel(), "SCALAR", 34963)
        primitive = {"attributes": {"POSITION": corners}, "indices": faces, "material": 0}
        shapes.append({"name": mesh.name, "primitives": [primitive]})
    turned = {
        "name": "room",
        "children": [*range(1, len(meshes) + 1)],
        "rotation": [-(0.5**0.5), 0, 0, 0.5**0.5],
    }
    nodes = [{"name": mesh.name, "mesh": k, "extras": extras[k]} for k, mesh in enumerate(meshes)]
    look = {"baseColorFactor": COLOUR, "metallicFactor": 0}
    content = {
        "asset": {"version": "2.0", "generator": "gaigs"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [turned, *nodes],
        "meshes": shapes,
        "materials": [{"pbrMetallicRoughness": look, "alphaMode": "BLEND", "doubleSided": True}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(buffer)}],
    }
    if file.suffix.lower() == ".gltf":
        content["buffers"][0]["uri"] = (
            "data:application/octet-stream;base64," + base64.b64encode(buffer).decode()
        )
        write_text(file, json.dumps(content) + "\n")
        return
    text = json.dumps(content).encode()
    text += b" " * (-len(text) % 4)
    with atomic_write(file) as part:
        part.write_bytes(
            struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(buffer))
            + struct.pack("<I4s", len(text), b"JSON")
            + text
            + struct.pack("<I4s", len(buffer), b"BIN\0")
            + buffer
        )
