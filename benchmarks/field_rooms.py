"""Scores in furnished rooms of one complex number a place, and bounds by their known walls.

    python benchmarks/field_rooms.py --rooms 10 11 --seeds 0 1 2 --folder runs/field_rooms

Draws a room for each number and traces it by Sionna RT (plugins/sionna/README.md): reflections,
passages and diffraction. Even rooms are boxes; an odd one has an oblique wall. One isotropic
receiver and one carrier. Prints median SNR / NMSE of the test links [dB], default split of each
seed, of ``+experiment=mirrored_csi``, its baselines, and the bounds of ``field_bound.py`` by up to
two reflections in the true walls. Further words are options of the run, such as
``trainer.max_steps=100``. docs/results.md has the numbers.
"""

import argparse
import json
import math
import random
import subprocess
import sys
from pathlib import Path

import numpy as np
import torch
from field_bound import load_field, scores

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Pose
from gaigs.data.synthetic.image_source import respond
from gaigs.report.table import markdown

sys.path.insert(0, str(Path(__file__).parents[1] / "plugins" / "sionna"))
from gaigs_sionna.cache import find_paths
from gaigs_sionna.meshes import Cuboid, MeshRoom
from gaigs_sionna.simulation import place


def draw_room(number: int) -> MeshRoom:
    """A room of random size, materials and furniture: by the walls, and tables amid."""
    draw = random.Random(number)
    length, width, height = draw.uniform(3.2, 6), draw.uniform(3, 4.5), draw.uniform(2.4, 2.9)
    oblique = draw.uniform(0.3, 0.8) * (number % 2)
    corners = ((0.0, 0.0), (length, 0.0), (length - oblique, width), (0.0, width))
    pieces = []
    for piece in range(draw.randint(3, 6)):
        long, deep, high = draw.uniform(0.5, 1.6), draw.uniform(0.3, 0.6), draw.uniform(0.6, 2.0)
        material = draw.choice(("wood", "wood", "metal", "plasterboard"))
        x, y = draw.uniform(0.05, length - oblique - long - 0.05), draw.choice((0.03, width - 0.03))
        lower, upper = sorted((y, y + deep if y < 1 else y - deep))
        pieces.append(Cuboid(f"piece {piece}", material, (x, lower, 0.0), (x + long, upper, high)))
    for table in range(draw.randint(1, 2)):
        x, y = draw.uniform(1, length - oblique - 1.6), draw.uniform(1, width - 1.5)
        top = (x + draw.uniform(0.8, 1.4), y + draw.uniform(0.5, 0.8), 0.74)
        pieces.append(Cuboid(f"table {table}", "wood", (x, y, 0.7), top, draw.uniform(-40, 40)))
    walls = tuple(draw.choice(("concrete", "brick", "plasterboard", "glass")) for _ in range(4))
    at = draw.uniform(0.4, length - oblique - 0.4), draw.uniform(0.8, width - 0.8), height - 0.35
    slabs = ("concrete", draw.choice(("concrete", "plasterboard")))
    middle = (length / 2, width / 2, 0.5)
    return MeshRoom(
        corners, corners, height, ((0, 1, 2, 3),), walls, slabs, tuple(pieces), (at, middle, 0), {}
    )


def planes_of(room: MeshRoom) -> torch.Tensor:
    """Planes of the walls, the floor and the ceiling (6, 4)."""
    planes = [[0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 1.0, room.height]]
    for start, end in zip(room.floor, (*room.floor[1:], room.floor[0]), strict=True):
        along = np.subtract(end, start) / math.dist(end, start)
        planes.append([along[1], -along[0], 0.0, along[1] * start[0] - along[0] * start[1]])
    return torch.tensor(planes, dtype=torch.float64)


def write_field(room: MeshRoom, seed: int, file: Path, frequency: float = 2.4e9) -> None:
    """Traces channels of 450 places at a carrier [Hz], and writes them for ``data=csi_npz``."""
    position = torch.tensor(room.antenna[0], dtype=torch.float64)
    receiver = Receiver("rx", Pose.from_xyzw(position, (0, 0, 0, 1)), Array(torch.zeros(1, 3)))
    places = place(room, 450, seed)
    paths = find_paths(room, position, places, frequency)
    channels = respond(paths, receiver, frequency, torch.zeros(1))  # (b, 1, 1)
    file.parent.mkdir(parents=True, exist_ok=True)
    arrays = {"h": channels, "tx": places, "rx": position[None], "frequencies": [frequency]}
    np.savez(file, **arrays)


def run_scores(file: Path, seed: int, words: list[str]) -> dict[str, str]:
    """Cells of a run's models, by name."""
    folder = file.parent / f"{file.stem}-seed{seed}"
    data = [f"data.file={file}", f"split.seed={seed}", f"seed={seed}", f"hydra.run.dir={folder}"]
    command = [sys.executable, "-m", "gaigs", "+experiment=mirrored_csi", "data=csi_npz"]
    done = subprocess.run([*command, *data, *words], capture_output=True, text=True, check=False)
    (file.parent / f"{folder.name}.log").write_text(done.stdout + done.stderr)
    done.check_returncode()
    metrics = json.loads((folder / "metrics.json").read_text())
    return {
        name: f"{values['snr_db_median']:.1f} / {values['nmse_db']:.1f}"
        for name, values in metrics["models"].items()
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("words", nargs="*", metavar="KEY=VALUE", help="options of the run")
    parser.add_argument("--rooms", type=int, nargs="+", default=[10, 11])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0])
    parser.add_argument("--folder", type=Path, default=Path("runs/field_rooms"))
    options = parser.parse_args()
    titles = ("images: a strength each", "images: shared gains", "images: varying gains")
    names = ("mean", "knn", "gaussian_process", "friis")
    rows = [("room", "seed", *names, *titles, "mirrored")]
    for number in options.rooms:
        room = draw_room(number)
        file = options.folder / f"room{number}.npz"
        write_field(room, number, file)
        for seed in options.seeds:
            with torch.no_grad():
                bounds = scores(load_field(file, seed), planes_of(room), 2)[1:]
            cells = run_scores(file, seed, options.words)
            ours = [cells[name] for name in names]
            rows.append((str(number), str(seed), *ours, *bounds, cells["mirrored"]))
            print(*rows[-1], flush=True)
    print(markdown(rows))


if __name__ == "__main__":
    main()
