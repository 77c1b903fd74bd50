"""Channels of the built-in room at one antenna and one carrier of each band, for ``data=csi_npz``.

    python benchmarks/field_bands.py runs/bands --frequencies 2.4e9 5.8e9 --places 400
    python -m gaigs +experiment=mirrored_csi data=csi_npz 'data.file=[runs/bands/2.4.npz,runs/bands/5.8.npz]'
    python -m gaigs +experiment=mirrored_csi data=csi_npz data.file=runs/bands/2.4.npz

Writes a file for each band, named by its carrier in GHz. All bands have the same places, or, with
``--apart``, each has its own. docs/results.md has the scores of bands together and alone.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from gaigs.core.antenna import Array, Receiver
from gaigs.data.synthetic import default_room


def write_band(frequency: float, count: int, seed: int, file: Path) -> None:
    """Channels of random places at one patch in the middle of the room's array."""
    room = default_room(2)
    receiver = Receiver("patch", room.poses[0], Array(torch.zeros(1, 3), "cosine"))
    places = room.place(count, seed)
    offsets = torch.zeros(1, dtype=torch.float64)
    channels = torch.cat([*room.respond(places, receiver, frequency, offsets)])
    np.savez(
        file,
        h=channels.to(torch.complex64).numpy(),
        tx=places.numpy(),
        rx=receiver.pose.position[None].numpy(),
        frequencies=np.array([frequency]),
    )


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path)
    parser.add_argument("--frequencies", type=float, nargs="+", default=[2.4e9, 5.8e9])
    parser.add_argument("--places", type=int, default=400)
    parser.add_argument("--apart", action="store_true")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    for number, frequency in enumerate(arguments.frequencies):
        file = arguments.folder / f"{frequency / 1e9:.4g}.npz"
        write_band(frequency, arguments.places, number * arguments.apart, file)


if __name__ == "__main__":
    with torch.no_grad():
        main()
