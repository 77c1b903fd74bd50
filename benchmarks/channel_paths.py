"""Scores of channels of which some kinds of paths are known exactly: what a model of walls can
reach in a traced room.

    python benchmarks/channel_paths.py l_shape slanted furnished         rooms of the ray tracer; needs sionna-rt

Test places of ``sionna_csi``, traced anew. Prints a table in Markdown: each kind's share of a
place's power, and SNR of channels of this kind of paths and all kinds above. docs/results.md has
the numbers.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from common import words
from jaxtyping import Bool, Complex, Int
from numpy import ndarray
from torch import Tensor

from gaigs.data import load
from gaigs.data.synthetic.image_source import Paths, respond
from gaigs.report.table import markdown

sys.path.append(str(Path(__file__).parents[1] / "plugins/sionna"))  # the plug-in
from gaigs_sionna import tracing
from gaigs_sionna.rooms import ROOMS

KINDS = "walls, two reflections or fewer", "walls, three", "furniture", "edges"


def kinds_of(types: Int[ndarray, "d b p"], at_wall: Bool[ndarray, "d b p"]) -> Int[ndarray, "b p"]:
    """Numbers in ``KINDS`` of paths by the types of their interactions, and which of these are at
    walls.
    """
    from sionna.rt.constants import InteractionType

    reflected = types == InteractionType.SPECULAR
    kinds = np.where((reflected & ~at_wall).any(0), 2, reflected.sum(0) > 2)
    return np.where((types == InteractionType.DIFFRACTION).any(0), 3, kinds)


def parts_of(room: str) -> list[Complex[Tensor, "b e s"]]:
    """Channels of the paths of each kind."""
    links = load(
        {"name": "sionna_csi", "room": room},
        {"name": "official", "validation": 0.1, "seed": 0},
        "csi",
    )
    receiver, frequencies = links.receivers[0], links.task.frequencies
    carrier, place = float(frequencies.mean()), receiver.pose.position
    meshes = ROOMS[room].meshes()
    scene = tracing.make_scene(meshes, carrier)
    walls = [mesh.name.endswith(" walls") or mesh.name in ("floor", "ceiling") for mesh in meshes]
    is_wall = {scene.get(f"mesh {number}").object_id: wall for number, wall in enumerate(walls)}
    parts = [[] for _ in KINDS]
    for paths in tracing.solve(scene, place, links.query.transmitters[links.split.test]):
        fields, images = tracing.fields_and_images(paths, place.double().numpy())
        types, surfaces = (array.numpy()[:, :, 0] for array in (paths.interactions, paths.objects))
        at_wall = np.vectorize(lambda number: is_wall.get(number, True))(surfaces)
        kinds = kinds_of(types, at_wall)
        gains = fields * np.linalg.norm(
            images - place.double().numpy(), axis=-1
        )  # all labels have one more factor
        for kind, part in enumerate(parts):
            own = Paths(
                torch.from_numpy(images), torch.from_numpy(np.where(kinds == kind, gains, 0))
            )
            part.append(respond(own, receiver, carrier, frequencies - carrier))
    return [torch.cat(part) for part in parts]


def main(rooms: list[str]) -> None:
    lines = [("room", "paths", "median power [%]", "mean power", "median SNR [dB]", "mean SNR")]
    for room in rooms:
        parts = parts_of(room)
        whole = sum(parts)

        def ratio(some, whole=whole):
            return some.abs().square().sum((1, 2)) / whole.abs().square().sum((1, 2))

        known = torch.zeros_like(whole)
        for kind, part in zip(KINDS, parts, strict=True):
            known = known + part
            shares, snr = 100 * ratio(part), -10 * ratio(whole - known).log10()
            scores = (
                [snr.quantile(0.5), snr.mean()] if kind != KINDS[-1] else []
            )  # nothing is left over
            cells = [f"{value:.1f}" for value in (shares.quantile(0.5), shares.mean(), *scores)]
            lines.append((room, kind, *cells, *[""] * (4 - len(cells))))
    print(markdown(lines))


if __name__ == "__main__":
    main(words(__doc__, "ROOM") or ["l_shape", "slanted", "furnished"])
