"""Paths by Sionna RT between any transmitters and the receivers of a scene, each link's traced
once.
"""

import functools
import itertools
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from gaigs_sionna import cache, tracing
from gaigs_sionna.meshes import THICKNESS
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.data.synthetic.image_source import MATERIALS
from gaigs.io.meshes import Mesh

from .fields import PASSED, REFLECTED, Traced
from .rooms import read_obj

CHUNK = 16
"""Transmitters traced at a time. Each has a table of its own, of some megabytes."""

CANDIDATES = 50_000
"""Most chains of surfaces that are tried for a transmitter, to all receivers together."""

MOST = 30_000
"""Links kept in memory beside those of the data, some kilobytes each."""

UPRIGHT = 1e-9
"""Sine of the angle between two directions below which one is along the other, and no plane is
between them.
"""


class Tracer:
    """The paths of one carrier in a room.

    Sionna RT finds each path as a chain of reflections, passages through surfaces and at most one
    diffraction, for the materials as tabulated.

    Args:
        surfaces: Text of an OBJ file; its materials are names of ``known``.
        known: Tabulated material of each material.
        receivers: Positions of the receivers [m].
        frequency: Carrier [Hz].
        depth: Largest number of interactions of a path.
        rays: Number of rays from each transmitter.
    """

    def __init__(
        self,
        surfaces: str,
        known: dict[str, str],
        receivers: Float[ndarray, "r 3"],
        frequency: float,
        depth: int,
        rays: int,
    ):
        meshes = read_obj(surfaces, "the room")
        self.meshes = [replace(mesh, material=known[mesh.material]) for mesh in meshes]
        self.receivers = receivers
        self.frequency = frequency
        self.depth = depth
        self.rays = rays
        names = sorted(known)
        self.numbers = np.array([names.index(mesh.material) for mesh in meshes])
        self.normals = np.concatenate([_normals(mesh) for mesh in meshes])
        # Number of the first triangle of each mesh.
        self.first = np.cumsum([0, *(len(mesh.triangles()) for mesh in meshes)])
        materials = {}
        for name in names:
            materials[name] = [known[name], MATERIALS[known[name]], THICKNESS[known[name]]]
        self.key = {
            "of": "ray_tracing",
            "surfaces": surfaces,
            "materials": materials,
            "receivers": receivers.tolist(),
            "frequency": frequency,
            "settings": [depth, rays, CHUNK, CANDIDATES, tracing.WEAKEST],
        }
        # Paths to all receivers by place: of places to remember, and of others.
        self.data: dict[tuple[float, ...], list[Traced]] = {}
        self.others: dict[tuple[float, ...], list[Traced]] = {}
        self.seconds = 0.0
        """Time of tracing so far [s]."""
        self.places = 0
        """Places traced in that time."""

    def remember(self, places: Float[Tensor, "b 3"]) -> None:
        """Traces places that are needed again and again, or reads their paths from disk."""
        places = places.double().unique(dim=0)
        missing = [place for place in map(tuple, places.tolist()) if place not in self.data]
        if not missing:
            return

        def trace() -> dict[str, ndarray]:
            """The paths of all links, one after another, and the number of each link's paths."""
            links = [*itertools.chain.from_iterable(self._trace(missing))]
            arrays = {"counts": np.array([len(link.strengths) for link in links])}
            for name in Traced._fields:
                arrays[name] = torch.cat([getattr(link, name) for link in links]).numpy()
            return arrays

        title = (
            f"tracing the paths of {len(missing)} transmitters to {len(self.receivers)} receivers"
        )
        arrays = cache.keep(self.key | {"transmitters": missing}, trace, title)
        counts = arrays.pop("counts").tolist()
        parts = (torch.from_numpy(arrays[name]).split(counts) for name in Traced._fields)
        links = list(map(Traced, *parts))
        count = len(self.receivers)
        self.data |= {place: links[k * count : (k + 1) * count] for k, place in enumerate(missing)}

    def find(self, places: Float[Tensor, "b 3"], receiver: int) -> list[Traced]:
        """The paths from places [m] to one of the receivers, traced where they are unknown."""
        keys = list(map(tuple, places.double().tolist()))
        distinct = dict.fromkeys(keys)
        missing = [key for key in distinct if key not in self.data and key not in self.others]
        if missing:
            # The memory is bounded: where it is full, places that are not requested now go.
            if (len(self.others) + len(missing)) * len(self.receivers) > MOST:
                self.others = {key: self.others[key] for key in keys if key in self.others}
            self.others |= zip(missing, self._trace(missing), strict=True)
        return [(self.data.get(key) or self.others[key])[receiver] for key in keys]

    @functools.cached_property
    def scene(self):
        """The scene of Sionna RT, with the receivers."""
        scene = tracing.make_scene(self.meshes, self.frequency)
        from sionna import rt

        for k, position in enumerate(self.receivers.tolist()):
            scene.add(rt.Receiver(f"receiver {k}", position))
        return scene

    def _trace(self, places: Sequence[tuple[float, ...]]) -> list[list[Traced]]:
        """The paths of each place to each receiver."""
        scene = self.scene
        from sionna import rt

        start = time.perf_counter()
        # Two chains may share a cell of a table: threads must not decide which one stays.
        solver = rt.PathSolver(deterministic=True)
        identities = {scene.objects[f"mesh {k}"].object_id: k for k in range(len(self.meshes))}
        by_place: list[list[Traced]] = []
        for first in range(0, len(places), CHUNK):
            chunk = places[first : first + CHUNK]
            names = [f"transmitter {k}" for k in range(len(chunk))]
            for name, place in zip(names, chunk, strict=True):
                scene.add(rt.Transmitter(name, list(place)))
            paths = solver(
                scene,
                max_depth=self.depth,
                samples_per_src=self.rays,
                max_num_paths_per_src=CANDIDATES,
                diffraction=True,
            )
            by_place += self._links(paths, np.array(chunk), identities)
            scene.remove(names)
        self.seconds += time.perf_counter() - start
        self.places += len(places)
        return by_place

    def _links(
        self, paths, places: Float[ndarray, "b 3"], identities: dict[int, int]
    ) -> list[list[Traced]]:
        """Paths of Sionna RT by place and receiver, without the weakest.

        Args:
            identities: Number of each mesh by Sionna RT's number of the object.
        """
        fields = paths.a[0].numpy() + 1j * paths.a[1].numpy().astype(complex)
        fields = fields[:, 0, :, 0]  # (receivers, places, paths)
        valid = paths.valid.numpy()
        is_kept = np.zeros_like(valid)
        for receiver, place in np.ndindex(*valid.shape[:2]):
            kept = tracing.without_weakest(fields[receiver, place] * valid[receiver, place])
            is_kept[receiver, place, kept] = True
        receivers, transmitters, _ = is_kept.nonzero()

        def pick(tensor) -> ndarray:
            """Values (p, d, ...) of the kept paths."""
            return np.moveaxis(tensor.numpy(), 0, 3)[is_kept]

        traced = self._paths(
            starts=places[transmitters],
            ends=self.receivers[receivers],
            fields=fields[is_kept],
            types=pick(paths.interactions),
            meshes=np.vectorize(identities.get, otypes=[int])(pick(paths.objects), -1),
            faces=pick(paths.primitives).astype(int),
            points=pick(paths.vertices).astype(float),
        )
        links = []
        for place in range(len(places)):
            to_receivers = []
            for receiver in range(len(self.receivers)):
                chosen = torch.from_numpy((transmitters == place) & (receivers == receiver))
                to_receivers.append(Traced(*(part[chosen] for part in traced)))
            links.append(to_receivers)
        return links

    def _paths(
        self,
        starts: Float[ndarray, "p 3"],
        ends: Float[ndarray, "p 3"],
        fields: ndarray,
        types: Int[ndarray, "p d"],
        meshes: Int[ndarray, "p d"],
        faces: Int[ndarray, "p d"],
        points: Float[ndarray, "p d 3"],
    ) -> Traced:
        """Paths in the form of ``Traced``, from the points and surfaces of p paths.

        Args:
            starts, ends: Positions of transmitters and receivers [m].
            fields: Gain of each path.
            types: Interactions of Sionna RT; 0 for none.
            meshes, faces: Number of the mesh and of its triangle at each interaction.
            points: Places of the interactions [m].
        """
        from sionna.rt import InteractionType

        points = np.where((types > 0)[..., None], points, ends[:, None])
        steps = np.diff(np.concatenate((starts[:, None], points, ends[:, None]), 1), axis=1)
        lengths = np.linalg.norm(steps, axis=-1)  # (p, d + 1)
        total = lengths.sum(1)
        directions = steps / np.where(lengths > 0, lengths, 1)[..., None]
        # Behind the last interaction steps have no length: the direction stays.
        for step in range(1, directions.shape[1]):
            is_over = lengths[:, step] == 0
            directions[is_over, step] = directions[is_over, step - 1]
        strengths = np.ones(len(types), complex)
        diffracted = (types == InteractionType.DIFFRACTION).any(1)
        spreading = speed_of_light / self.frequency / (4 * np.pi * total)
        strengths[diffracted] = fields[diffracted] / spreading[diffracted]
        kinds = np.where(types == InteractionType.SPECULAR, REFLECTED, 0)
        kinds += np.where(types == InteractionType.REFRACTION, PASSED, 0)
        kinds[diffracted] = 0
        directions[diffracted] = directions[diffracted, -1:]
        cosines, turns = self._turns(directions, kinds, meshes, faces)
        images = ends - total[:, None] * directions[:, -1]
        surfaces = np.where(kinds > 0, self.numbers[meshes], 0)
        return Traced(
            torch.from_numpy(images.astype(np.float32)),
            torch.from_numpy(strengths.astype(np.complex64)),
            torch.from_numpy(kinds.astype(np.uint8)),
            torch.from_numpy(surfaces.astype(np.int16)),
            torch.from_numpy(cosines.astype(np.float32)),
            torch.from_numpy(turns.astype(np.float32)),
        )

    def _turns(
        self,
        directions: Float[ndarray, "p d1 3"],
        kinds: Int[ndarray, "p d"],
        meshes: Int[ndarray, "p d"],
        faces: Int[ndarray, "p d"],
    ) -> tuple[Float[ndarray, "p d"], Float[ndarray, "p d1 2 2"]]:
        """Cosines of the angles of incidence, and ``Traced.turns``.

        The components of a field are along two unit vectors. At a surface these are across the
        plane of incidence (TE) and in it (TM).
        """
        count, depth = kinds.shape
        before = _vertical(directions[:, 0])  # unit vectors (p, 2, 3) up to the next surface
        cosines = np.ones((count, depth))
        turns = np.zeros((count, depth + 1, 2, 2))
        for step in range(depth):
            is_surface = kinds[:, step] > 0
            triangles = np.where(is_surface, self.first[meshes[:, step]] + faces[:, step], 0)
            normals = self.normals[triangles]
            arriving = directions[:, step]
            leaving = directions[:, step + 1]
            cosines[:, step] = np.abs((arriving * normals).sum(-1))
            across = np.cross(arriving, normals)
            sines = np.linalg.norm(across, axis=-1, keepdims=True)
            # Along the normal there is no plane of incidence: the vector before stays.
            across = np.where(
                sines > UPRIGHT, across / np.where(sines > UPRIGHT, sines, 1), before[:, 0]
            )
            is_surface = is_surface[:, None, None]
            at_arrival = np.stack((across, np.cross(across, arriving)), 1)
            at_arrival = np.where(is_surface, at_arrival, before)
            turns[:, step] = at_arrival @ before.swapaxes(1, 2)
            behind = np.stack((across, np.cross(across, leaving)), 1)
            before = np.where(is_surface, behind, before)
        turns[:, depth] = _vertical(directions[:, -1]) @ before.swapaxes(1, 2)
        return cosines, turns


@functools.lru_cache(maxsize=16)
def find_tracer(
    surfaces: str,
    known: tuple[tuple[str, str], ...],
    receivers: tuple[tuple[float, float, float], ...],
    frequency: float,
    depth: int,
    rays: int,
) -> Tracer:
    """The tracer of a room at a carrier, made once for equal arguments."""
    return Tracer(surfaces, dict(known), np.array(receivers), frequency, depth, rays)


def _normals(mesh: Mesh) -> Float[ndarray, "f 3"]:
    """Unit normal of each triangle; 0 for a triangle without an area, which no ray meets."""
    corners = np.array(mesh.vertices)[np.array(mesh.triangles())]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(lengths > 0, lengths, 1)


def _vertical(directions: Float[ndarray, "p 3"]) -> Float[ndarray, "p 2 3"]:
    """Two unit vectors across each direction: along the horizontal and down the meridian."""
    azimuths = np.arctan2(directions[:, 1], directions[:, 0])
    horizontal = np.stack((-np.sin(azimuths), np.cos(azimuths), np.zeros_like(azimuths)), -1)
    return np.stack((horizontal, np.cross(horizontal, directions)), 1)
