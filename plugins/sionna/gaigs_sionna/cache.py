"""Traced paths, stored on disk: any spectrum and any band of a carrier has the same paths."""

import hashlib
import json
import logging
import os
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.data.synthetic.image_source import Paths

from . import tracing
from .meshes import THICKNESS, MeshRoom
from .scenes import SceneFile

log = logging.getLogger(__name__)

VERSION = 1
"""Version of the files; to be raised with every change of ``tracing`` that changes its paths."""


def find_paths(
    room: MeshRoom | SceneFile,
    receiver: Float[Tensor, "3"],
    transmitters: Float[Tensor, "b 3"],
    frequency: float,
    diffraction: bool = True,
) -> Paths:
    """The paths in a room: traced the first time, afterwards read from a file by ``keep``."""
    surfaces: dict[str, object] = {}
    if isinstance(room, SceneFile):
        surfaces["scene"] = room.digest
    else:
        meshes = room.meshes()
        surfaces["meshes"] = [(mesh.material, mesh.vertices, mesh.faces) for mesh in meshes]
        surfaces["thickness"] = THICKNESS
    key = {
        **surfaces,
        "receiver": receiver.tolist(),
        "transmitters": transmitters.tolist(),
        "frequency": float(frequency),
        "settings": [
            tracing.DEPTH,
            tracing.RAYS,
            tracing.CANDIDATES,
            tracing.CHUNK,
            tracing.WEAKEST,
        ],
    }
    if not diffraction:
        key["diffraction"] = False
    reflections = None if diffraction else tracing.DEPTH

    def trace() -> dict[str, np.ndarray]:
        if isinstance(room, SceneFile):
            paths = tracing.trace_scene(
                room.load(frequency), receiver, transmitters, reflections=reflections
            )
        else:
            paths = tracing.trace(room.meshes(), receiver, transmitters, frequency, reflections)
        return {
            "images": paths.images.numpy().astype(np.float32),
            "gains": paths.gains.numpy().astype(np.complex64),
        }

    arrays = keep(key, trace, f"tracing the paths of {len(transmitters)} transmitters")
    return Paths(
        torch.from_numpy(arrays["images"]).double(),
        torch.from_numpy(arrays["gains"]).to(torch.complex128),
    )


def keep(
    key: Mapping[str, object], make: Callable[[], dict[str, np.ndarray]], task: str
) -> dict[str, np.ndarray]:
    """Arrays from a file in ``$XDG_CACHE_HOME/gaigs/sionna``, which is made the first time.

    Args:
        key: All that the arrays depend on, beside the packages, as JSON can hold it.
        make: Computes the arrays by name.
        task: Name of the computation in the log.

    Raises:
        ValueError: The file is damaged.
    """
    key = {"version": VERSION, "packages": tracing.find_packages(), **key}
    folder = Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "gaigs" / "sionna"
    file = folder / f"{hashlib.sha256(json.dumps(key).encode()).hexdigest()[:32]}.npz"
    if not file.is_file():
        log.info("%s; next time they are read from %s", task, file)
        arrays = make()
        file.parent.mkdir(parents=True, exist_ok=True)
        # Two processes may trace at once, with slightly different results: the first file stays.
        with tempfile.TemporaryDirectory(dir=file.parent) as scratch:
            with open(f"{scratch}/paths.npz", "wb") as stream:
                np.savez_compressed(stream, **arrays)
            if not file.is_file():
                os.replace(f"{scratch}/paths.npz", file)
    try:
        with file.open("rb") as stream:  # numpy leaves a damaged file open
            return dict(np.load(stream, allow_pickle=False))
    except (OSError, TypeError, ValueError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"cannot parse {file}: {error}; delete it") from error
