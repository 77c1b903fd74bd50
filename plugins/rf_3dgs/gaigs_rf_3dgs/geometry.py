"""A room's geometry from a file: points, a mesh or splats."""

import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial import cKDTree
from torch import Tensor

from gaigs.io.meshes import read_obj, read_ply, triangles
from gaigs.io.tables import read_points

NEIGHBOURS = 3
"""Nearest points whose root mean square distance is the width of a Gaussian at a point, as in 3-D
Gaussian splatting.
"""

NEAREST = 1e-3
"""Smallest width of a Gaussian at a point [m]: a repeated point has no distance."""

SPLATS = {
    "log_scales": [f"scale_{i}" for i in range(3)],
    "quats": [f"rot_{i}" for i in range(4)],
    "opacity_logits": ["opacity"],
}
"""Columns by which a .ply of splats is known."""


class Geometry(NamedTuple):
    """Gaussians of a file, as raw parameters of ``gaigs.splatting.gaussians.Gaussians``.

    Attributes:
        means: Centres, world frame (n, 3) [m].
        log_scales: Logarithms of standard deviations (n, 3).
        quats: Quaternions (w, x, y, z) of any length.
        opacity_logits: Logits of opacities (n,); None unless the file has splats.
    """

    means: Float[Tensor, "n 3"]
    log_scales: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    opacity_logits: Float[Tensor, " n"] | None = None


def read_geometry(file: Path, most: int) -> Geometry:
    """Gaussians at a room's points, or at random points of a mesh.

    Args:
        file: Geometry in the world frame [m]. ``.csv`` with points x,y,z, with a heading or
            without; ``.obj`` with vertices, with faces or without; or ``.ply`` with the same, or
            with splats, which keep their scales, rotations and opacities.
        most: Largest number of Gaussians; more points are thinned at random.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is of another kind, damaged, or has too few points.
    """
    readers = {".csv": _read_csv, ".obj": _read_obj, ".ply": _read_ply}
    if not file.is_file():
        raise FileNotFoundError(
            f"no geometry at {file}; set model.geometry to a .csv, .obj or .ply, or to null"
        )
    if file.suffix.lower() not in readers:
        raise ValueError(f"model.geometry must be a .csv, .obj or .ply, got {file.name}")
    points, corners, splats = readers[file.suffix.lower()](file)
    values = np.concatenate([points, *splats.values()], 1)
    if not np.isfinite(values).all():
        row = int((~np.isfinite(values)).any(1).argmax())
        raise ValueError(
            f"{file} must hold finite numbers, got {values[row].tolist()} at point {row + 1}"
        )
    if len(corners):
        points = _sample(points[corners], most)
    if len(points) <= NEIGHBOURS or most <= NEIGHBOURS:
        count = min(len(points), most)
        raise ValueError(
            f"{file} must give at least {NEIGHBOURS + 1} Gaussians, got {count} of "
            f"gaussians.count={most}"
        )
    chosen = torch.randperm(len(points))[:most]
    means = torch.from_numpy(points)[chosen].float()
    if splats:
        stored = {name: torch.from_numpy(values)[chosen].float() for name, values in splats.items()}
        logits = stored["opacity_logits"][:, 0]
        return Geometry(means, stored["log_scales"], stored["quats"], logits)
    distances, _ = cKDTree(means.numpy()).query(means.numpy(), k=NEIGHBOURS + 1)
    widths = torch.from_numpy(distances[:, 1:]).square().mean(1).sqrt().clamp(min=NEAREST).float()
    return Geometry(means, widths.log()[:, None].expand(-1, 3), torch.randn(len(means), 4))


def _sample(corners: np.ndarray, count: int) -> np.ndarray:
    """Random points, uniform over the area of triangles (f, 3, 3); none without an area."""
    corners = torch.from_numpy(corners)
    sides = corners[:, 1:] - corners[:, :1]  # (f, 2, 3)
    areas = torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=1)
    if not areas.sum() > 0:
        return np.zeros((0, 3))
    triangle = torch.multinomial(areas, count, replacement=True)
    along = torch.rand(count, 2, dtype=corners.dtype)
    # The other half of the parallelogram is folded back into the triangle.
    along = torch.where(along.sum(1, keepdim=True) > 1, 1 - along, along)
    return (corners[triangle, 0] + (along[..., None] * sides[triangle]).sum(1)).numpy()


# Readers give points (n, 3) [m], triangles (f, 3) as numbers of points, and raw columns of splats.


def _read_csv(file: Path) -> tuple[np.ndarray, np.ndarray, dict]:
    points = read_points(file, "xyz", "x,y,z in each line [m]")
    return np.array(points).reshape(-1, 3), _triangles(()), {}


def _read_obj(file: Path) -> tuple[np.ndarray, np.ndarray, dict]:
    points, groups = read_obj(file)
    return points, _triangles(itertools.chain(*groups.values())), {}


def _read_ply(file: Path) -> tuple[np.ndarray, np.ndarray, dict]:
    vertices, faces = read_ply(file)

    def columns(names):
        return np.stack([vertices[name] for name in names], -1)

    if {*itertools.chain(*SPLATS.values())} <= {*vertices.dtype.names}:
        splats = {name: columns(names) for name, names in SPLATS.items()}
        return columns("xyz"), _triangles(()), splats
    return columns("xyz"), _triangles(faces), {}


def _triangles(faces: Iterable[tuple[int, ...]]) -> np.ndarray:
    """Triangles (f, 3) of polygons."""
    return np.array(triangles(faces), int).reshape(-1, 3)
