"""Scene files of one's own, as Sionna RT loads them: their free space, and their paths."""

import hashlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from gaigs.core.query import as_positions
from gaigs.data.simulation import draw_places
from gaigs.io.meshes import Mesh

from . import tracing
from .meshes import edges


@dataclass(frozen=True)
class SceneFile:
    """A scene file (Mitsuba XML), and the receivers in it.

    Attributes:
        file: Surfaces with the radio materials of Sionna RT.
        receivers: Positions (k, 3) [m].
        heights: Lowest and highest z of transmitters [m]; None: 0.3 to 2 m above the lowest
            surface.
    """

    file: Path
    receivers: Float[Tensor, "k 3"]
    heights: tuple[float, float] | None

    @cached_property
    def digest(self) -> str:
        """Hash of the file and of all mesh files that it names."""
        files = [self.file]
        for name in ElementTree.parse(self.file).iterfind(".//string[@name='filename']"):
            files.append(self.file.parent / name.get("value", ""))
        return hashlib.sha256(
            b"".join(hashlib.sha256(file.read_bytes()).digest() for file in files)
        ).hexdigest()

    def load(self, frequency: float | None = None) -> Any:
        """The scene of Sionna RT at a carrier [Hz]; a ``ValueError`` if it cannot be loaded."""
        rt = tracing.find_sionna()
        if not self.file.is_file():
            raise FileNotFoundError(
                f"no scene at {self.file}; set data.scene to a scene file (Mitsuba XML)"
            )
        try:
            scene = rt.load_scene(str(self.file))
            if not scene.objects:
                raise ValueError("no surfaces")
        # Mitsuba's parser raises exceptions of many types, with a traceback in the message
        except Exception as error:
            cause = re.sub(
                r"Traceback \(most recent call last\):.*\n(?=\S)", "", str(error), flags=re.DOTALL
            )
            raise ValueError(
                f"cannot load {self.file}: {' '.join(cause.split())}; "
                "expected a scene that sionna.rt.load_scene loads"
            ) from error
        if frequency is not None:
            try:
                tracing.set_up(scene, frequency)
            except ValueError as error:
                raise ValueError(
                    f"{self.file} has no materials at {frequency:.6g} Hz: {error}"
                ) from error
        return scene

    @cached_property
    def space(self) -> "FreeSpace":
        """The free space.

        Raises:
            ValueError: A receiver stands farther from the surfaces than these are long.
        """
        scene = self.load().mi_scene
        box = scene.bbox()
        lower = np.array(box.min, float).reshape(3)
        upper = np.array(box.max, float).reshape(3)
        for receiver in self.receivers.double().numpy():
            if np.linalg.norm(receiver - receiver.clip(lower, upper)) > np.linalg.norm(
                upper - lower
            ):
                bounds = f"{lower.round(3).tolist()} to {upper.round(3).tolist()}"
                raise ValueError(
                    f"receivers must stand in the scene, whose surfaces lie from {bounds} m, "
                    f"got {receiver.tolist()}"
                )
        return FreeSpace(scene, self.receivers.double().numpy())

    def place(self, count: int, seed: int) -> Float[Tensor, "count 3"]:
        """Random places in the free space [m], uniform between the heights."""
        space = self.space
        low, high = self.heights or (space.floor + 0.3, space.floor + 2.0)
        lower = torch.tensor([*space.lower[:2], low]).float()
        upper = torch.tensor([*space.upper[:2], high]).float()
        inside = (space.centres[:, 2] > low - space.pitch) & (
            space.centres[:, 2] < high + space.pitch
        )
        if not space.reached[inside].any():
            raise ValueError(
                f"{self.file}: expected free space at z from {low:.4g} to {high:.4g} m that the "
                "receivers see into, got none; set data.heights"
            )
        return draw_places(lower, upper, space.is_free, count, seed)

    def edges(self) -> Float[Tensor, "k 2 3"]:
        """Outlines of the surfaces for figures [m]; empty if there are too many."""
        import mitsuba

        most = 20_000  # triangles that figures show the edges of

        parts = [mitsuba.traverse(shape.mi_mesh) for shape in self.load().objects.values()]
        parts = [part for part in parts if "vertex_positions" in part]
        if sum(len(part["faces"]) for part in parts) > 3 * most:
            return torch.zeros(0, 2, 3)
        meshes = []
        for part in parts:
            corners = part["vertex_positions"].numpy().reshape(-1, 3).astype(float).round(6)
            corners, number = np.unique(corners, axis=0, return_inverse=True)
            faces = number.ravel()[part["faces"].numpy().reshape(-1, 3)]
            a, b, c = corners[faces].transpose(1, 0, 2)
            faces = faces[np.linalg.norm(np.cross(b - a, c - a), axis=1) > 0]
            meshes.append(
                Mesh("", "", tuple(map(tuple, corners.tolist())), tuple(map(tuple, faces.tolist())))
            )
        return edges(meshes)


class FreeSpace:
    """The part of a scene that can be reached from its receivers without passing through a surface.

    Neighbouring cells of a grid are joined if no surface lies between their centres. So closed
    rooms end at their walls, and solids are left out, also those without a bottom on the ground.

    Attributes:
        floor: Height of the lowest surface [m].
        lower, upper: Corners of the grid, which has all surfaces and receivers [m].
        pitch: Edge of a cell [m].
        centres: Middles of the cells (c, 3) [m].
        reached: True for cells that can be reached (c,).
    """

    def __init__(self, scene: Any, receivers: Float[np.ndarray, "k 3"]):
        self.scene = scene
        box = scene.bbox()
        bounds = np.array([box.min, box.max], float).reshape(2, 3)
        self.floor = float(bounds[0, 2])
        bounds = np.concatenate((bounds, receivers))
        self.lower, self.upper = bounds.min(0), bounds.max(0)
        pitch = 0.1  # the smallest one [m]
        cells = 300_000  # the largest number of them
        size = np.maximum(self.upper - self.lower, pitch)
        self.pitch = max(pitch, float(size.prod() / cells) ** (1 / 3))
        self.counts = np.ceil(size / self.pitch).astype(int)
        number = np.arange(self.counts.prod()).reshape(self.counts)
        self.centres = self.lower + (np.indices(self.counts).reshape(3, -1).T + 0.5) * self.pitch
        pairs = []
        for axis in range(3):
            near = np.moveaxis(number, axis, 0)
            pairs.append(np.stack((near[:-1].ravel(), near[1:].ravel()), -1))
        # Neighbouring cells are joined if no surface lies between their centres.
        joined = np.concatenate(pairs)
        joined = joined[self.is_open(self.centres[joined[:, 0]], self.centres[joined[:, 1]])]
        graph = coo_matrix(
            (np.ones(len(joined), bool), tuple(joined.T)), (number.size, number.size)
        )
        part = connected_components(graph, directed=False)[1]
        # A receiver is in the parts of the cells around it that it sees: its own cell's centre may
        # lie behind the wall on which it hangs.
        around = np.indices((3, 3, 3)).reshape(3, -1).T - 1
        cells = self.cells(receivers)[:, None] + around
        cells = np.clip(cells, 0, self.counts - 1).reshape(-1, 3)
        cells = np.ravel_multi_index(tuple(cells.T), tuple(self.counts))
        seen = cells[self.is_open(receivers.repeat(len(around), 0), self.centres[cells])]
        self.reached = np.isin(part, part[seen])

    def cells(self, points: Float[np.ndarray, "k 3"]) -> np.ndarray:
        """Indices of the cells of points (k, 3)."""
        return np.clip(((points - self.lower) / self.pitch).astype(int), 0, self.counts - 1)

    def is_open(self, start: Float[np.ndarray, "k 3"], end: Float[np.ndarray, "k 3"]) -> np.ndarray:
        """True where no surface lies between two points [m]."""
        import mitsuba as mi

        ways = end - start
        lengths = np.linalg.norm(ways, axis=1)
        ways = ways / np.maximum(lengths, 1e-9)[:, None]
        origins, directions = (np.ascontiguousarray(part.T, np.float32) for part in (start, ways))
        ray = mi.Ray3f(mi.Point3f(*origins), mi.Vector3f(*directions))
        ray.maxt = mi.Float(lengths.astype(np.float32))
        return ~self.scene.ray_test(ray).numpy()

    def is_free(self, points: Float[Tensor, "k 3"]) -> Bool[Tensor, " k"]:
        """True for points [m] that can be reached, with a margin to all surfaces."""
        margin = 0.1  # smallest distance from surfaces, in 26 directions [m]
        places = points.double().numpy()
        cells = np.ravel_multi_index(tuple(self.cells(places).T), tuple(self.counts))
        free = self.reached[cells] & self.is_open(places, self.centres[cells])
        around = np.indices((3, 3, 3)).reshape(3, -1).T - 1.0
        around = around[np.abs(around).any(1)]
        around *= margin / np.linalg.norm(around, axis=1, keepdims=True)
        ends = places[:, None] + around
        clear = self.is_open(places.repeat(len(around), 0), ends.reshape(-1, 3))
        clear = clear.reshape(len(places), -1)  # (k, 26)
        return torch.from_numpy(free & clear.all(1))


def check_points(name: str, points: int | Sequence[Sequence[float]] | None) -> Float[Tensor, "k 3"]:
    """Positions of an option [m]; a ``ValueError`` without three coordinates of each."""
    rows = points if isinstance(points, Sequence) else []
    if not rows or not all(isinstance(row, Sequence) and len(row) == 3 for row in rows):
        raise ValueError(f"{name} must be x, y, z of each receiver in the scene [m], got {points}")
    return as_positions(name, [[*row] for row in rows])
