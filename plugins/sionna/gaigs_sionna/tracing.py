"""Paths in a room of meshes by the ray tracer Sionna RT, on the processor."""

import itertools
import math
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from glob import glob
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Complex, Float, Int
from numpy import ndarray
from scipy.constants import speed_of_light
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from gaigs.data.simulation import sample_band
from gaigs.data.synthetic.image_source import MATERIALS, Paths, conductivity
from gaigs.io.meshes import Mesh

from .meshes import THICKNESS

DEPTH = 3
"""Largest number of reflections, passages through surfaces and diffractions of a path; a wardrobe
is two passages.
"""

CHUNK = 10
"""Transmitters traced at a time. Chains of surfaces to all of them share a table, in which some
displace others.
"""

RAYS = 500_000
"""Rays from a receiver for each chunk."""

CANDIDATES = 1_000_000
"""Chains tried for each chunk, and the size of their table. Of 50 transmitters with 80 chains each
one place in ten would lose 1 to 6 dB of the power.
"""

WEAKEST = 1e-4
"""Fraction of a transmitter's power in the paths left out, two thirds of all: the weakest."""


def find_packages() -> dict[str, str]:
    """Versions of the packages that trace, by name; an ``ImportError`` if one is not installed."""
    try:
        return {name: metadata.version(name) for name in ("sionna-rt", "mitsuba", "drjit")}
    except metadata.PackageNotFoundError as error:
        raise ImportError(
            f"rooms of the ray tracer need {error.name}: pip install sionna-rt"
        ) from error


def find_llvm() -> str:
    """The libLLVM for the ray tracer's kernels: DRJIT_LIBLLVM_PATH, else the newest; a
    ``RuntimeError`` before 17.
    """
    oldest = 17  # with 15 and 16 the process aborts at the first kernel
    chosen = os.environ.get("DRJIT_LIBLLVM_PATH")
    folders = (
        f"{sys.prefix}/lib",
        "/usr/lib/*-linux-gnu",
        "/usr/lib64",
        "/usr/lib/llvm-*/lib",
        "/usr/local/lib",
    )
    names = "libLLVM.so*", "libLLVM-[0-9]*.so*", "libLLVM.dylib"
    files: list[str] = []
    if chosen:
        files.append(chosen)
    else:
        for folder, name in itertools.product(folders, names):
            files += glob(f"{folder}/{name}")
    versions = {file: llvm_version(file) for file in dict.fromkeys(map(os.path.realpath, files))}
    newest = max(versions, key=versions.__getitem__, default="")
    if versions.get(newest, 0) < oldest:
        found = ", ".join(
            f"{file} ({version or 'no libLLVM of 16 or later'})"
            for file, version in versions.items()
        )
        raise RuntimeError(
            f"the ray tracer needs libLLVM {oldest} or later, got {found or 'none'}; "
            "install it (Debian: apt-get install libllvm19), or set DRJIT_LIBLLVM_PATH to its file"
        )
    return newest


def llvm_version(file: str) -> int:
    """Major version of a libLLVM; 0 before 16, or if it cannot be loaded.

    A process of its own loads it, since an old one aborts the process.
    """
    code = (
        "import ctypes, sys; number = ctypes.c_uint(); "
        "ctypes.CDLL(sys.argv[1]).LLVMGetVersion(ctypes.byref(number), None, None); "
        "print(number.value)"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, file], capture_output=True, text=True, check=False
    )
    return int(done.stdout) if done.returncode == 0 else 0


def trace(
    meshes: Sequence[Mesh],
    receiver: Float[Tensor, "3"],
    transmitters: Float[Tensor, "b 3"],
    frequency: float,
    reflections: int | None = None,
) -> Paths:
    """The paths at a carrier [Hz] from transmitters to a receiver point [m], strongest first.

    Transmitters with fewer paths than others have further ones with a gain of 0. By reciprocity the
    rays leave the single receiver. Both ends have an isotropic, vertically polarised antenna: its
    field runs along the meridians about the vertical. A path that is reflected and passes through
    surfaces equals a straight one from an image of the transmitter, at the path's length in the
    direction of arrival. Length and direction of a diffracted path are exact at the receiver point,
    and its wave is more curved than the wave of the image.

    Args:
        reflections: Largest number of reflections of a path, then without diffractions, as in
            ``trace_scene``; None: ``DEPTH`` interactions of any kind.

    Raises:
        ImportError: Sionna RT is not installed.
        RuntimeError: There is no libLLVM that it can use.
        ValueError: The frequency is out of range, or no path leads to a transmitter.

    Source: Sionna RT technical report, arXiv:2504.21719; materials as in ITU-R P.2040-3, table 3.
    """
    paths = trace_scene(
        make_scene(meshes, frequency), receiver, transmitters, reflections=reflections
    )
    for transmitter, gains in zip(transmitters, paths.gains, strict=True):
        if not gains.any():
            got = f"none to {transmitter.tolist()}"
            raise ValueError(f"a path must lead to each transmitter, got {got}; move it")
    return paths


def trace_scene(
    scene: Any,
    receiver: Float[Tensor, "3"],
    transmitters: Float[Tensor, "b 3"],
    depth: int = DEPTH,
    reflections: int | None = None,
) -> Paths:
    """The paths of ``trace``, in a scene that is ``set_up``; without a path all gains are 0.

    Args:
        depth: Largest number of interactions of a path.
        reflections: Largest number of reflections of a path, then without diffractions, as each
            triangle of a curved surface has edges; None: any.
    """
    images: list[Tensor] = []
    gains: list[Tensor] = []
    wavelength = float(scene.wavelength[0])
    for paths in solve(scene, receiver, transmitters, depth, diffraction=reflections is None):
        strongest = _strongest(paths, receiver.double().numpy(), wavelength, reflections)
        for places, strengths in strongest:
            images.append(torch.from_numpy(places))
            gains.append(torch.from_numpy(strengths))
    # An image 1 km away, with a gain of 0, stands where a transmitter has fewer paths than others.
    return Paths(
        pad_sequence(images, batch_first=True, padding_value=1e3),
        pad_sequence(gains, batch_first=True),
    )


def solve(
    scene: Any,
    receiver: Float[Tensor, "3"],
    transmitters: Float[Tensor, "b 3"],
    depth: int = DEPTH,
    diffraction: bool = True,
) -> Iterator[Any]:
    """The paths of ``sionna.rt`` to each ``CHUNK`` of the transmitters.

    Transmitters stand in the scene while their paths are traced.
    """
    from sionna import rt

    scene.add(rt.Transmitter("receiver", receiver.tolist()))
    solver = rt.PathSolver()
    for chunk in transmitters.split(CHUNK):
        names = [f"transmitter {k}" for k in range(len(chunk))]
        for name, position in zip(names, chunk.tolist(), strict=True):
            scene.add(rt.Receiver(name, position))
        yield solver(
            scene,
            max_depth=depth,
            samples_per_src=RAYS,
            max_num_paths_per_src=CANDIDATES,
            diffraction=diffraction,
        )
        scene.remove(names)
    scene.remove("receiver")


def find_sionna() -> Any:
    """The module ``sionna.rt``, set to compute on the processor; it raises errors as ``trace``."""
    find_packages()
    os.environ["DRJIT_LIBLLVM_PATH"] = find_llvm()  # read once, when the first kernel is compiled
    import mitsuba

    # On the processor, before the import chooses a graphics card.
    mitsuba.set_variant("llvm_ad_mono_polarized")
    from sionna import rt

    return rt


def open_scene(frequency: float, file: Path | None = None) -> Any:
    """The scene of a Mitsuba file, or an empty one, ``set_up`` at a carrier [Hz]."""
    low = 0.3e9  # below, furniture is no larger than the wavelength
    high = 40e9  # above, materials are not tabulated
    if not low <= frequency <= high:
        raise ValueError(f"frequency must lie in {low:g}..{high:g} Hz, got {frequency:.6g}")
    scene = find_sionna().load_scene(file and str(file))
    set_up(scene, frequency)
    return scene


def make_scene(meshes: Sequence[Mesh], frequency: float) -> Any:
    """The scene of some meshes, as by ``open_scene``; mesh k is ``mesh <k>``."""
    scene = open_scene(frequency)
    import mitsuba
    from sionna import rt

    objects, materials = [], {}
    for name in sorted({mesh.material for mesh in meshes}):
        # Sionna's own table refuses frequencies below 1 GHz.
        materials[name] = rt.RadioMaterial(
            name, THICKNESS[name], MATERIALS[name][0], conductivity(name, frequency)
        )
    for number, mesh in enumerate(meshes):
        triangles = mesh.triangles()
        properties = mitsuba.Properties()
        properties["face_normals"] = True
        properties["mesh_bsdf"] = materials[mesh.material]
        shape = mitsuba.Mesh(f"mesh {number}", len(mesh.vertices), len(triangles), props=properties)
        parameters = mitsuba.traverse(shape)
        parameters["vertex_positions"] = np.ravel(mesh.vertices).astype(np.float32)
        parameters["faces"] = np.ravel(triangles).astype(np.uint32)
        parameters.update()
        objects.append(
            rt.SceneObject(
                mi_mesh=shape, name=f"mesh {number}", radio_material=materials[mesh.material]
            )
        )
    scene.edit(add=objects)
    return scene


def set_up(scene: Any, frequency: float) -> None:
    """Sets a scene's carrier [Hz], and isotropic, vertically polarised antennas at both ends."""
    from sionna import rt

    scene.frequency = frequency
    scene.tx_array = scene.rx_array = rt.PlanarArray(
        num_rows=1, num_cols=1, pattern="iso", polarization="V"
    )


def without_weakest(fields: Complex[ndarray, " p"]) -> Int[ndarray, " k"]:
    """Numbers of the paths that carry all but ``WEAKEST`` of the power, the strongest first."""
    order = np.argsort(-np.abs(fields), kind="stable")
    power = np.abs(fields[order]) ** 2
    return order[np.cumsum(power[::-1])[::-1] > WEAKEST * power.sum()]


def fields_and_images(
    paths: Any, receiver: Float[ndarray, "3"]
) -> tuple[Complex[ndarray, "b p"], Float[ndarray, "b p 3"]]:
    """Fields of the solver's paths from one receiver, and their images [m]; 0 for no path."""
    fields = (paths.a[0].numpy() + 1j * paths.a[1].numpy().astype(complex))[:, 0, 0, 0]  # (b, p)
    delays = paths.tau.numpy()[:, 0].astype(float)
    zenith = paths.theta_t.numpy()[:, 0].astype(float)
    azimuth = paths.phi_t.numpy()[:, 0].astype(float)
    horizontal = np.sin(zenith)
    directions = np.stack(
        (horizontal * np.cos(azimuth), horizontal * np.sin(azimuth), np.cos(zenith)), -1
    )
    return fields, receiver + speed_of_light * delays[..., None] * directions


def _strongest(
    paths: Any, receiver: np.ndarray, wavelength: float, reflections: int | None
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Images (p, 3) [m] and gains (p,) of each transmitter's paths, without the weakest."""
    fields, images = fields_and_images(paths, receiver)
    if reflections is not None:
        from sionna.rt.constants import InteractionType

        counts = (paths.interactions.numpy()[:, :, 0] == InteractionType.SPECULAR).sum(0)
        fields = np.where(counts <= reflections, fields, 0)
    lengths = np.linalg.norm(images - receiver, axis=-1)
    strongest = []
    for k, field in enumerate(fields):
        order = without_weakest(field)
        # The path's gain has no spreading of free space, wavelength / (4 pi length).
        gains = field[order] * 4 * math.pi * lengths[k, order] / wavelength
        strongest.append((images[k, order], gains))
    return strongest


def frequency_offsets(meshes: Sequence[Mesh], bandwidth: float) -> Float[Tensor, " f"]:
    """Frequencies that sample a band, as by ``sample_band``, for the longest path among meshes."""
    vertices = [*itertools.chain(*(mesh.vertices for mesh in meshes))]
    corners = torch.tensor(vertices, dtype=torch.float64)
    return sample_paths(bandwidth, (corners.amax(0) - corners.amin(0)).norm().item())


def sample_paths(bandwidth: float, diagonal: float) -> Float[Tensor, " f"]:
    """Frequencies that sample a band, for the longest path in a box of a diagonal [m]."""
    return sample_band(bandwidth, (DEPTH + 1) * diagonal)
