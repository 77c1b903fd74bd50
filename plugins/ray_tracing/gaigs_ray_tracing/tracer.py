"""Paths by Sionna RT between any transmitters and the receivers of a scene, each link's traced
once.
"""

import functools
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

    By tracing, a path is a chain of reflections, passages through surfaces and at most one
    diffraction, whose points are Sionna RT's. Which paths there are is decided with the materials
    as tabulated.

    Args:
        surfaces: Text of an OBJ file; its materials are names of ``known``.
        known: Which tabulated material each of them is.
        receivers: Positions [m].
        frequency: Of the carrier [Hz].
        depth: Largest number of things that happen to a path.
        rays: That leave each transmitter.
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
        self.receivers, self.frequency, self.depth, self.rays = receivers, frequency, depth, rays
        names = sorted(known)
        self.numbers = np.array([names.index(mesh.material) for mesh in meshes])
        self.normals = np.concatenate([_normals(mesh) for mesh in meshes])
        self.first = np.cumsum(
            [0, *(len(mesh.triangles()) for mesh in meshes)]
        )  # triangle of each mesh
        self.key = {
            "of": "ray_tracing",
            "surfaces": surfaces,
            "materials": {
                name: [known[name], MATERIALS[known[name]], THICKNESS[known[name]]]
                for name in names
            },
            "receivers": receivers.tolist(),
            "frequency": frequency,
            "settings": [depth, rays, CHUNK, CANDIDATES, tracing.WEAKEST],
        }
        self.data: dict[tuple[float, ...], list[Traced]] = {}
        self.others: dict[tuple[float, ...], list[Traced]] = {}
        self.seconds = 0.0
        """Time of tracing so far [s]."""
        self.places = 0
        """Places traced in that time."""

    def remember(self, places: Float[Tensor, "b 3"]) -> None:
        """Traces places that will be asked for time and again, or reads their paths from disk."""
        places = places.double().unique(dim=0)
        missing = [place for place in map(tuple, places.tolist()) if place not in self.data]
        if not missing:
            return

        def trace() -> dict[str, ndarray]:
            links = [link for place in self._trace(missing) for link in place]
            arrays = {
                name: torch.cat([getattr(link, name) for link in links]).numpy()
                for name in Traced._fields
            }
            return arrays | {"counts": np.array([len(link.strengths) for link in links])}

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
        """The paths of links to one of the receivers."""
        asked = list(map(tuple, places.double().tolist()))
        missing = [
            place
            for place in dict.fromkeys(asked)
            if place not in self.data and place not in self.others
        ]
        if missing:
            if (len(self.others) + len(missing)) * len(self.receivers) > MOST:
                self.others = {place: self.others[place] for place in asked if place in self.others}
            self.others |= zip(missing, self._trace(missing), strict=True)
        return [(self.data.get(place) or self.others[place])[receiver] for place in asked]

    @functools.cached_property
    def scene(self):
        """Sionna RT's, with the receivers."""
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
        # Which of two chains stays that share a cell of a table would else be up to the processor's
        # threads.
        solver = rt.PathSolver(deterministic=True)
        identities = {scene.objects[f"mesh {k}"].object_id: k for k in range(len(self.meshes))}
        found: list[list[Traced]] = []
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
            found += self._links(paths, np.array(chunk), identities)
            scene.remove(names)
        self.seconds += time.perf_counter() - start
        self.places += len(places)
        return found

    def _links(
        self, paths, places: Float[ndarray, "b 3"], identities: dict[int, int]
    ) -> list[list[Traced]]:
        """Paths of Sionna RT, by place and receiver."""
        fields = (paths.a[0].numpy() + 1j * paths.a[1].numpy().astype(complex))[:, 0, :, 0]
        valid = paths.valid.numpy()
        there = np.zeros_like(valid)
        for receiver, place in np.ndindex(*valid.shape[:2]):
            there[
                receiver,
                place,
                tracing.without_weakest(fields[receiver, place] * valid[receiver, place]),
            ] = True
        receivers, transmitters, _ = there.nonzero()

        def pick(tensor):
            return np.moveaxis(tensor.numpy(), 0, 3)[there]

        types, objects, faces, points = map(
            pick, (paths.interactions, paths.objects, paths.primitives, paths.vertices)
        )
        meshes = np.vectorize(identities.get, otypes=[int])(objects, -1)
        ends = places[transmitters], self.receivers[receivers]
        traced = self._paths(
            *ends, fields[there], types, meshes, faces.astype(int), points.astype(float)
        )
        links = [[Traced(*(part[:0] for part in traced))] * len(self.receivers) for _ in places]
        for place, own in enumerate(links):
            for receiver in range(len(self.receivers)):
                chosen = torch.from_numpy((transmitters == place) & (receivers == receiver))
                own[receiver] = Traced(*(part[chosen] for part in traced))
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
        """Directions, angles and planes of incidence of paths."""
        from sionna.rt import InteractionType

        points = np.where((types > 0)[..., None], points, ends[:, None])
        steps = np.diff(np.concatenate((starts[:, None], points, ends[:, None]), 1), axis=1)
        lengths = np.linalg.norm(steps, axis=-1)
        total = lengths.sum(1)
        directions = steps / np.where(lengths > 0, lengths, 1)[..., None]
        for step in range(1, directions.shape[1]):  # behind the last point it goes on as before
            gone = lengths[:, step] == 0
            directions[gone, step] = directions[gone, step - 1]
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
        """Cosines of incidence, and the content of ``Traced.turns``."""
        count, depth = kinds.shape
        before = _vertical(directions[:, 0])
        cosines, turns = np.ones((count, depth)), np.zeros((count, depth + 1, 2, 2))
        for step in range(depth):
            happens = kinds[:, step] > 0
            normals = self.normals[
                np.where(happens, self.first[meshes[:, step]] + faces[:, step], 0)
            ]
            here, after = directions[:, step], directions[:, step + 1]
            cosines[:, step] = np.abs((here * normals).sum(-1))
            across = np.cross(here, normals)
            sines = np.linalg.norm(across, axis=-1, keepdims=True)
            across = np.where(
                sines > UPRIGHT, across / np.where(sines > UPRIGHT, sines, 1), before[:, 0]
            )
            happens = happens[:, None, None]
            own = np.where(happens, np.stack((across, np.cross(across, here)), 1), before)
            turns[:, step] = own @ before.swapaxes(1, 2)
            before = np.where(happens, np.stack((across, np.cross(across, after)), 1), before)
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
    """The tracer of a room and a carrier; all who ask for the same share one."""
    return Tracer(surfaces, dict(known), np.array(receivers), frequency, depth, rays)


def _normals(mesh: Mesh) -> Float[ndarray, "f 3"]:
    """Unit normal of each triangle; one without an area has none, and no ray meets it."""
    corners = np.array(mesh.vertices)[np.array(mesh.triangles())]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(lengths > 0, lengths, 1)


def _vertical(directions: Float[ndarray, "p 3"]) -> Float[ndarray, "p 2 3"]:
    """Unit vectors across directions, along the horizontal and down the meridian."""
    azimuths = np.arctan2(directions[:, 1], directions[:, 0])
    cos, sin, none = np.cos(azimuths), np.sin(azimuths), np.zeros_like(azimuths)
    horizontal = np.stack((-sin, cos, none), -1)
    return np.stack((horizontal, np.cross(horizontal, directions)), 1)
