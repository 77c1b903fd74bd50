"""Meshes as glTF 2.0, by trimesh."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

from gaigs.io.files import atomic_write
from gaigs.io.meshes import Mesh


def write_gltf(file: Path, meshes: Sequence[Mesh], extras: Sequence[Mapping[str, float]]) -> None:
    """Writes meshes as ``.glb``, or as ``.gltf`` with embedded buffers: a node for each, with
    extras.

    Args:
        extras: Numbers of each node by name, such as ``loss_db``.
    """
    import trimesh  # slow to import
    from trimesh.exchange import gltf
    from trimesh.visual import TextureVisuals
    from trimesh.visual.material import PBRMaterial

    blue = [0.0, 0.45, 0.70, 0.35]  # as planes in figures, with an opacity that shows the room
    look = PBRMaterial(
        baseColorFactor=blue, metallicFactor=0.0, alphaMode="BLEND", doubleSided=True
    )
    scene = trimesh.Scene()
    upright = trimesh.transformations.rotation_matrix(-math.pi / 2, [1, 0, 0])
    # glTF's y axis points up.
    scene.graph.update(frame_to="room", matrix=upright)
    for mesh, about in zip(meshes, extras, strict=True):
        shape = trimesh.Trimesh(
            mesh.vertices, mesh.triangles(), visual=TextureVisuals(material=look), process=False
        )
        scene.add_geometry(
            shape,
            node_name=mesh.name,
            geom_name=mesh.name,
            parent_node_name="room",
            metadata=dict(about),
        )
    with atomic_write(file) as part:
        if file.suffix.lower() == ".glb":
            part.write_bytes(gltf.export_glb(scene))
        else:
            part.write_bytes(gltf.export_gltf(scene, embed_buffers=True)["model.gltf"])
