"""A room's geometry from a file: points, a mesh or splats."""

import itertools
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from plyfile import PlyData, PlyParseError
from scipy.spatial import cKDTree
from torch import Tensor

NEIGHBOURS = 3
"""A Gaussian at a bare point is as wide as these are away, in root mean square, as 3-D Gaussian splatting starts."""

NEAREST = 1e-3
"""They count as at least so far away [m]: points that are there twice have no distance."""

SPLATS = {
    "log_scales": [f"scale_{i}" for i in range(3)],
    "quats": [f"rot_{i}" for i in range(4)],
    "opacity_logits": ["opacity"],
}
"""Columns by which a .ply of splats is known."""


class Geometry(NamedTuple):
    """Gaussians as a file has them, raw as those of ``gaigs.gaussians.Gaussians``.

    Attributes:
        means: Centres, world frame (n, 3) [m].
        log_scales: (n, 3).
        quats: (w, x, y, z), of any length.
        opacity_logits: (n,), of splats; else None.
    """

    means: Float[Tensor, "n 3"]
    log_scales: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    opacity_logits: Float[Tensor, "n"] | None = None


def read_geometry(file: Path, most: int) -> Geometry:
    """Gaussians at a room's points; a mesh is sampled at as many as allowed, evenly over its area.

    Args:
        file: World frame [m]. ``.csv`` with points x,y,z, a heading or not; ``.obj`` with vertices, and faces or not;
            ``.ply`` with vertices, and faces or not, or with splats, which keep their scales, rotations and opacities.
        most: No more than so many Gaussians; of more points, so many are drawn.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is of another kind, damaged, or has too few points.
    """
    readers = {".csv": _read_csv, ".obj": _read_obj, ".ply": _read_ply}
    if not file.is_file():
        raise FileNotFoundError(f"no geometry at {file}; set model.geometry to a .csv, .obj or .ply, or to null")
    if file.suffix.lower() not in readers:
        raise ValueError(f"model.geometry must be a .csv, .obj or .ply, got {file.name}")
    points, triangles, splats = readers[file.suffix.lower()](file)
    values = np.concatenate([points, *splats.values()], 1)
    if not np.isfinite(values).all():
        row = int((~np.isfinite(values)).any(1).argmax())
        raise ValueError(f"{file} must hold finite numbers, got {values[row].tolist()} at point {row + 1}")
    if len(triangles):
        points = _sample(points[triangles], most)
    if len(points) <= NEIGHBOURS or most <= NEIGHBOURS:
        count = min(len(points), most)
        raise ValueError(f"{file} must give at least {NEIGHBOURS + 1} Gaussians, got {count} of gaussians.count={most}")
    chosen = torch.randperm(len(points))[:most]
    means = torch.from_numpy(points)[chosen].float()
    if splats:
        own = {name: torch.from_numpy(values)[chosen].float() for name, values in splats.items()}
        return Geometry(means, own["log_scales"], own["quats"], own["opacity_logits"][:, 0])
    distances, _ = cKDTree(means.numpy()).query(means.numpy(), k=NEIGHBOURS + 1)
    widths = torch.from_numpy(distances[:, 1:]).square().mean(1).sqrt().clamp(min=NEAREST).float()
    return Geometry(means, widths.log()[:, None].expand(-1, 3), torch.randn(len(means), 4))


def _sample(corners: np.ndarray, count: int) -> np.ndarray:
    """Points spread at random over triangles (f, 3, 3), each as likely as its area is large."""
    corners = torch.from_numpy(corners)
    sides = corners[:, 1:] - corners[:, :1]
    areas = torch.linalg.cross(sides[:, 0], sides[:, 1]).norm(dim=1)
    if not areas.sum() > 0:
        return np.zeros((0, 3))
    of = torch.multinomial(areas, count, replacement=True)
    along = torch.rand(count, 2, dtype=corners.dtype)
    along = torch.where(along.sum(1, keepdim=True) > 1, 1 - along, along)  # folded back into the triangle
    return (corners[of, 0] + (along[..., None] * sides[of]).sum(1)).numpy()


def _read_csv(file: Path) -> tuple[np.ndarray, np.ndarray, dict]:
    lines = file.read_text(encoding="utf-8-sig").splitlines()
    heading = bool(lines) and [cell.strip().lower() for cell in lines[0].split(",")] == ["x", "y", "z"]
    rows = [line for line in lines[heading:] if line.strip()]
    try:
        points = np.loadtxt(rows, delimiter=",", ndmin=2) if rows else np.zeros((0, 3))
    except ValueError as error:
        raise ValueError(f"{file} must hold x,y,z in each line [m]: {error}") from error
    if points.shape[1] != 3:
        raise ValueError(f"{file} must hold x,y,z in each line [m], got {points.shape[1]} columns")
    return points, np.zeros((0, 3), int), {}


def _read_obj(file: Path) -> tuple[np.ndarray, np.ndarray, dict]:
    vertices, faces = [], []
    for number, line in enumerate(file.read_text().splitlines(), 1):
        word, *rest = line.split("#")[0].split() or [""]
        try:
            if word == "v":
                x, y, z, *_ = map(float, rest)
                vertices.append((x, y, z))
            elif word == "f":
                corners = [int(value.split("/")[0]) for value in rest]
                # They count from 1, or back from the last vertex so far.
                faces.append([k - 1 if k > 0 else len(vertices) + k for k in corners])
        except ValueError as error:
            raise ValueError(f"{file}, line {number}, must hold numbers, got {line.strip()!r}") from error
    return np.array(vertices).reshape(-1, 3), _triangles(file, faces, len(vertices)), {}


def _read_ply(file: Path) -> tuple[np.ndarray, np.ndarray, dict]:
    try:
        content = PlyData.read(str(file))
        vertices = content["vertex"].data
        points = np.stack([vertices[axis] for axis in "xyz"], -1).astype(float)
    except (PlyParseError, KeyError, ValueError) as error:
        raise ValueError(f"{file} must be a whole .ply file of vertices x, y, z: {error}") from error
    if all(column in vertices.dtype.names for columns in SPLATS.values() for column in columns):
        columns = SPLATS.items()
        return (
            points,
            np.zeros((0, 3), int),
            {name: np.stack([vertices[column] for column in own], -1).astype(float) for name, own in columns},
        )
    faces = []
    if "face" in content:
        names = content["face"].data.dtype.names
        key = next((name for name in ("vertex_indices", "vertex_index") if name in names), None)
        faces = [] if key is None else content["face"].data[key]
    return points, _triangles(file, faces, len(points)), {}


def _triangles(file: Path, faces, vertices: int) -> np.ndarray:
    """Triangles (f, 3) of polygons, as fans."""
    fans = [(int(face[0]), int(a), int(b)) for face in faces for a, b in itertools.pairwise(face[1:])]
    triangles = np.array(fans, int).reshape(-1, 3)
    if triangles.size and not (triangles.min() >= 0 and triangles.max() < vertices):
        raise ValueError(f"{file} must hold faces of its {vertices} vertices, and a face names another")
    return triangles
