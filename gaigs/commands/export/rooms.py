"""Learnt rooms as glTF, as Wavefront OBJ, and as scenes of Mitsuba for ray tracers."""

import cmath
import hashlib
import math
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
import torch
from jaxtyping import Complex
from plyfile import PlyData, PlyElement
from torch import Tensor

from gaigs.core.query import check_carrier
from gaigs.data.synthetic.image_source import TABULATED, conductivity
from gaigs.io.files import atomic_write, write_text
from gaigs.io.gltf import write_gltf
from gaigs.io.meshes import Mesh
from gaigs.model import Model, Wrapper
from gaigs.model.mirrored import MirroredSplatting
from gaigs.planes.learnt_room import outline_planes
from gaigs.planes.materials import Material, materials
from gaigs.planes.obstacle_surfaces import Sheet, fit_sheets
from gaigs.planes.room_files import to_meshes, wavefront_obj
from gaigs.planes.room_paths import trace_paths
from gaigs.processes import only_run
from gaigs.registry import name_of


def write_room(model: Model, file: Path, frequency: float | None = None) -> list[Path]:
    """Writes the planes and obstacles that a model, or an ensemble's first member, has learnt.

    Args:
        file: ``.gltf``, ``.glb``, ``.obj``, or a scene ``.xml`` of Mitsuba, whose meshes get a
            folder beside it.
        frequency: Carrier of a scene's materials [Hz]; None for the training links' or, of several
            carriers, the middle one.
    """
    mirrored = mirrored_of("a learnt room", model)
    placement = mirrored.placement
    suffix = file.suffix.lower()
    if suffix == ".xml":
        frequency = _carrier(mirrored, frequency)
    paths = trace_paths(placement, mirrored.traced)
    planes = outline_planes(placement, paths)
    # Sheets, thin absorbers, replace obstacles in the box of all paths and planes. ``gain`` is the
    # common gain of all paths that sheets do not explain [Np].
    corners = np.concatenate([paths.ends, *(plane.corners for plane in planes)])
    sheets, gain = fit_sheets(placement, mirrored.traced, corners.min(0), corners.max(0))
    if suffix == ".obj":
        write_text(file, wavefront_obj(placement, paths, sheets))
        return [file]
    meshes = to_meshes(planes, sheets)
    if frequency is None or suffix != ".xml":
        extras = [{"share": plane.share} for plane in planes]
        extras += [{"loss_db": sheet.loss_db} for sheet in sheets]
        write_gltf(file, meshes, extras)
        return [file]
    chosen = materials(placement, mirrored.traced, frequency)
    bsdfs = [itu_bsdf(chosen[plane.number], frequency) for plane in planes]
    bsdfs += [sheet_bsdf(sheet) for sheet in sheets]
    comments = [f"Materials for {frequency:.7g} Hz.", *map(str, mirrored.scene.flat_axes)]
    if mirrored.scene.task.dtype.is_complex:
        comments += _gain_comments(mirrored, gain)
    return write_scene(file, meshes, bsdfs, comments)


def _carrier(mirrored: MirroredSplatting, frequency: float | None) -> float:
    """The option ``frequency``, or else the data's carrier [Hz]; a ``ValueError`` without one."""
    if frequency is None:
        frequency = mirrored.scene.middle_frequency
    if frequency is None:
        raise ValueError(
            "materials depend on the carrier, which the data do not know; set frequency=... [Hz]"
        )
    frequency = float(frequency)
    check_carrier("frequency", frequency)
    return frequency


def mirrored_of(kind: str, model: Model) -> MirroredSplatting:
    """The mirrored Gaussians within a model with kriging, or in an ensemble's first member."""
    while isinstance(model, Wrapper):
        if not model.has_room:
            raise ValueError(
                f"{kind} takes a learnt room, and the levels show none: predictions have no part "
                "of the trained model (see the log)\nexport model.underlying to see it all the same"
            )
        model = model.underlying
    if not isinstance(model, MirroredSplatting):
        raise ValueError(
            f"{kind} takes a model 'mirrored', got {name_of(model)!r}; train it on the same data"
        )
    return model


@torch.no_grad()
def traced_gains(model: MirroredSplatting, gain: float) -> Complex[Tensor, " receivers"]:
    """Factor of each receiver by which traced channels of Sionna RT become the model's channels.

    Args:
        gain: Common gain of all paths from ``fit_sheets`` [Np], beside the losses in sheets, the
            thin absorbers that replace obstacles.
    """
    placement = model.placement
    # The direct path has number 0; the mean is over bands.
    nepers = placement.receiver_gains + placement.path_gains[..., 0].mean() + gain
    amplitudes = nepers.exp() * model.pooling.strength
    return torch.polar(amplitudes, placement.receiver_phases)


def _gain_comments(model: MirroredSplatting, gain: float) -> list[str]:
    """Comments of a scene: the factor that turns traced channels into each receiver's channels."""
    # Labels in which phases have the other sign than in Sionna RT.
    conjugated = ", then conjugated" if model.pooling.array_sign > 0 else ""
    factors = traced_gains(model, gain).tolist()
    comments = []
    for receiver, complex_factor in zip(model.scene.receivers, factors, strict=True):
        angle = math.degrees(cmath.phase(complex_factor))
        factor = f"{abs(complex_factor):.4g}, turned by {angle:.2f} degrees"
        comments.append(f"Channels of {receiver.name} are those traced times {factor}{conjugated}.")
    return comments


class Bsdf(NamedTuple):
    """The material of a mesh as a BSDF of Mitsuba (how its surface reflects and transmits)."""

    name: str
    kind: str  # Mitsuba's type
    properties: tuple[tuple[str, str | float], ...]  # names and values


def itu_bsdf(material: Material, frequency: float) -> Bsdf:
    """A material of ITU-R P.2040 for Sionna RT.

    From 1 to 40 GHz the material has only its name, and Sionna RT computes the constants for the
    carrier that is set there. At other carriers, for which Sionna RT has no table, the material has
    extrapolated constants.

    Args:
        material: Name and thickness.
        frequency: Carrier [Hz].
    """
    name = f"{material.name}-{1e3 * material.thickness:.4g}mm"
    thickness = ("thickness", material.thickness)
    if 1e9 <= frequency <= 40e9:  # all of ``TABULATED`` are tabulated
        return Bsdf(name, "itu-radio-material", (("type", material.name), thickness))
    permittivity = ("relative_permittivity", TABULATED[material.name][0])
    conductance = ("conductivity", conductivity(material.name, frequency))
    return Bsdf(name, "radio-material", (thickness, permittivity, conductance))


def sheet_bsdf(sheet: Sheet) -> Bsdf:
    """The material of a sheet, a thin absorber that stands for obstacles.

    A sheet transmits a part of the power and scatters all else. Sionna RT leaves scattered power
    out by default, so that a sheet only dims waves.
    """
    thickness = 1e-5  # [m]; thin against the wavelength, so that only the conductance counts
    impedance = 376.73  # of free space [ohm]
    properties = (
        ("relative_permittivity", 1.0),
        ("thickness", thickness),
        ("conductivity", sheet.conductance / (thickness * impedance)),
        ("scattering_coefficient", 1.0),
    )
    return Bsdf(f"sheet-{sheet.loss_db:.4g}dB", "radio-material", properties)


def write_scene(
    file: Path, meshes: Sequence[Mesh], bsdfs: Sequence[Bsdf], comments: Sequence[str] = ()
) -> list[Path]:
    """Writes a scene of Mitsuba for Sionna RT, and a mesh ``.ply`` of each surface beside it."""
    scene = ElementTree.Element("scene", version="2.1.0")
    for comment in ("Learnt by gaigs; metres, z up.", *comments):
        scene.append(ElementTree.Comment(f" {re.sub('-+', '-', comment)} "))
    for bsdf in {bsdf.name: bsdf for bsdf in bsdfs}.values():
        element = ElementTree.SubElement(scene, "bsdf", id=bsdf.name, type=bsdf.kind)
        for name, value in bsdf.properties:
            if isinstance(value, str):
                ElementTree.SubElement(element, "string", name=name, value=value)
            else:
                ElementTree.SubElement(element, "float", name=name, value=f"{value:.6g}")
    folder = file.with_name(f"{file.stem}_meshes")
    folder.mkdir(exist_ok=True)
    files = [file]
    with only_run(folder, waits=True):
        for mesh, bsdf in zip(meshes, bsdfs, strict=True):
            path = _write_mesh(folder, mesh)
            files.append(path)
            shape = ElementTree.SubElement(scene, "shape", type="ply", id=f"mesh-{mesh.name}")
            place = f"{folder.name}/{path.name}"
            ElementTree.SubElement(shape, "string", name="filename", value=place)
            ElementTree.SubElement(shape, "boolean", name="face_normals", value="true")
            ElementTree.SubElement(shape, "ref", id=bsdf.name, name="bsdf")
        ElementTree.indent(scene)
        write_text(file, ElementTree.tostring(scene, encoding="unicode") + "\n")
        old_meshes = {*folder.glob("plane_*.ply"), *folder.glob("obstacle_*.ply")} - {*files}
        for old in old_meshes:
            # For a minute a program may still read the scene before.
            if old.stat().st_mtime < time.time() - 60:
                old.unlink()
    return files


def _write_mesh(folder: Path, mesh: Mesh) -> Path:
    """Writes the triangles of a mesh as a ``.ply`` with the mesh's name and a digest."""
    vertices = np.array([*mesh.vertices], dtype=[(axis, "f4") for axis in "xyz"])
    faces = np.array([(face,) for face in mesh.triangles()], dtype=[("vertex_indices", "i4", (3,))])
    # Named by content: a scene that is read meanwhile never has another scene's meshes.
    digest = hashlib.sha256(vertices.tobytes() + faces.tobytes()).hexdigest()[:8]
    path = folder / f"{mesh.name}-{digest}.ply"
    elements = [PlyElement.describe(vertices, "vertex"), PlyElement.describe(faces, "face")]
    with atomic_write(path) as part:
        PlyData(elements, byte_order="<").write(str(part))
    return path
