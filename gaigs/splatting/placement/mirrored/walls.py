"""Known walls: planes from a floor plan or a mesh."""

import itertools
import logging
import math
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from gaigs.data.checks.places import check_walls
from gaigs.io.meshes import Face, read_obj, triangles
from gaigs.io.tables import read_walls

log = logging.getLogger(__name__)


def read_planes(
    file: Path,
    lower: Float[Tensor, "3"],
    upper: Float[Tensor, "3"],
    shortest: float = 1e-3,
) -> Float[Tensor, "k 4"]:
    """Planes of a file as rows (normal, offset [m]), the largest area first.

    Args:
        file: ``.csv`` with consecutive vertices x,y of a floor plan [m], whose walls are upright,
            or ``.obj`` with the faces of a mesh [m].
        lower, upper: Corners of the box of transmitters and receivers [m]. They place floor and
            ceiling of a floor plan, unless the box has no height.
        shortest: Smallest length of a wall, and of an edge of a face [m].
    """
    if not file.is_file():
        raise FileNotFoundError(
            f"no walls at {file}; set placement.walls to a .csv or .obj, or to null"
        )
    if file.suffix.lower() == ".csv":
        ends = read_walls(file)  # (walls, 2, 3) [m]
        points = ends.flatten(0, 1)
        along = ends[:, 1] - ends[:, 0]
        lengths = along.norm(dim=1)
        normals = torch.stack((along[:, 1], -along[:, 0], 0 * lengths), 1)
        ceiling_and_floor = torch.tensor([[0.0, 0.0, 1.0, upper[2]], [0.0, 0.0, -1.0, -lower[2]]])
        if upper[2] - lower[2] < 0.01:  # [m]; floor and ceiling would hold all places
            ceiling_and_floor = ceiling_and_floor[:0]
        is_long = lengths > shortest
        walls = _merged(normals[is_long], ends[is_long, 0], lengths[is_long])
        # A room has floor and ceiling before a fifth wall.
        planes = torch.cat((walls[:4], ceiling_and_floor, walls[4:])) if len(walls) else walls
    elif file.suffix.lower() == ".obj":
        vertices, groups = read_obj(file)
        points = torch.from_numpy(vertices).float()
        planes = _merged(*_faces(points, itertools.chain(*groups.values()), shortest))
    else:
        raise ValueError(f"placement.walls must be a .csv or .obj, got {file.name}")
    if not len(planes):
        raise ValueError(f"{file} must have a wall longer than {shortest} m")
    for finding in check_walls(points, torch.stack((lower, upper))):
        log.warning("placement.walls: %s", finding)
    return planes


class _Faces(NamedTuple):
    """Triangles of a mesh."""

    normals: Float[Tensor, "f 3"]  # of any length
    points: Float[Tensor, "f 3"]  # a corner of each [m]
    areas: Float[Tensor, " f"]  # [m²]


def _faces(vertices: Float[Tensor, "v 3"], faces: Iterable[Face], shortest: float) -> _Faces:
    """Triangles of a mesh that are larger than a square of edge ``shortest`` [m]."""
    numbers = torch.tensor(triangles(faces), dtype=torch.long).reshape(-1, 3)  # of the vertices
    first, second, third = vertices[numbers].unbind(1)  # corners (f, 3) each
    normals = torch.linalg.cross(second - first, third - first)
    areas = normals.norm(dim=1) / 2
    large = areas > shortest**2
    return _Faces(normals[large], first[large], areas[large])


def _merged(
    normals: Float[Tensor, "f 3"], points: Float[Tensor, "f 3"], sizes: Float[Tensor, " f"]
) -> Float[Tensor, "k 4"]:
    """Planes (normal, offset [m]) of faces, sorted by decreasing total size.

    Faces within 0.02 rad and 0.02 m of the largest face belong to its plane. The largest of the
    remaining faces makes the next plane, and so on.

    Args:
        normals: Normals of the faces, of any length and sign.
        points: A point of each face [m].
        sizes: Area or length of each face.
    """
    sizes, order = sizes.sort(descending=True, stable=True)
    normals = functional.normalize(normals[order], dim=1)
    offsets = (normals * points[order]).sum(1)
    planes: list[list[float]] = []
    totals: list[float] = []
    while len(sizes):
        cosines = normals @ normals[0]
        gaps = (offsets * cosines.sign() - offsets[0]).abs()  # [m]; normals may be opposite
        is_same = (cosines.abs() > math.cos(0.02)) & (gaps < 0.02)
        planes.append([*normals[0].tolist(), offsets[0].item()])
        totals.append(sizes[is_same].sum().item())
        remaining = slice(1, None) if is_same.sum() == 1 else ~is_same  # a slice is no copy
        normals = normals[remaining]
        offsets = offsets[remaining]
        sizes = sizes[remaining]
    by_size = torch.tensor(totals).argsort(descending=True, stable=True)
    return torch.tensor(planes).reshape(-1, 4)[by_size]
