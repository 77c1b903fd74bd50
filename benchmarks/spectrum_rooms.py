"""Scores of spectra in drawn rooms from two starts: planes searched, or planes learnt alone.

    python benchmarks/spectrum_rooms.py --rooms 0 1 2 3 4 5

Draws a room for each number: an oblique wall, an L, a leaning wall or a corner cut off, with other
materials, furniture and place of the array, traced by Sionna RT (plugins/sionna/README.md). Prints
for mirrored Gaussians without kriging, from planes that a search finds and from the faces of the
box, which the training moves: the median SSIM of the test links, the mean of the validation links,
and processor seconds; and the median of the start that validation chooses. Further words are
options of all trainings, such as ``trainer.max_steps=300``. docs/results.md has the numbers.
"""

import argparse
import math
import random
import sys
import time
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

import gaigs
from gaigs.model.answers import predicted
from gaigs.report.table import markdown

sys.path.insert(0, str(Path(__file__).parents[1] / "plugins" / "sionna"))
from gaigs_sionna.meshes import Cuboid, MeshRoom
from gaigs_sionna.rooms import ROOMS

SPLITS: dict[str, dict] = {
    "official": {},
    "blocks 1 m": {"split": "blocks", "edge": 1.0},
    "60 places": {"split": "sparse", "train": 60},
}
"""Options of each split."""

STARTS = {"searched": "true", "learnt": "false"}
"""Value of ``model.search`` for each start."""


def outline(shape: int, draw: random.Random) -> tuple[list[tuple[float, float]], tuple]:
    """Corners of a floor, counterclockwise [m], and those of its convex parts."""
    length, width = draw.uniform(4.5, 8.5), draw.uniform(3.5, 6.0)
    corners = [(0.0, 0.0), (length, 0.0), (length, width), (0.0, width)]
    if shape == 0:  # an oblique wall
        corners[2] = (length - draw.uniform(0.4, 1.2), width)
    elif shape == 1:  # an L
        x, y = length * draw.uniform(0.45, 0.6), width * draw.uniform(0.45, 0.6)
        corners[2:3] = [(length, y), (x, y), (x, width)]
        return corners, ((0, 1, 2, 3), (0, 3, 4, 5))
    elif shape == 3:  # a corner cut off
        cut = draw.uniform(0.8, 1.6)
        corners[2:3] = [(length, width - cut), (length - 1.3 * cut, width)]
    return corners, (tuple(range(len(corners))),)


def furnish(room: MeshRoom, draw: random.Random) -> tuple[Cuboid, ...]:
    """Pieces along the walls, and tables amid the room: none through a wall or about the array."""
    array = torch.tensor([room.antenna[0]])
    pieces: list[Cuboid] = []
    wanted = draw.randint(4, 8)
    for _ in range(200):
        if len(pieces) == wanted:
            break
        number = draw.randrange(len(room.floor))
        start = np.array(room.floor[number])
        wall = np.array(room.floor[(number + 1) % len(room.floor)]) - start
        along = wall / np.linalg.norm(wall)
        inwards = np.array([-along[1], along[0]])
        size = np.array([draw.uniform(0.5, 1.8), draw.uniform(0.35, 0.7)])
        bottom, top, gap = 0.0, draw.uniform(0.6, 2.1), 0.06
        if draw.random() < 0.3:  # a table
            bottom, top, gap = 0.7, 0.74, draw.uniform(0.8, 2.0)
        middle = start + draw.uniform(0.15, 0.85) * wall + (gap + size[1] / 2) * inwards
        # The edge away from the wall.
        edge = [middle + inwards * size[1] / 2 + side * along * size[0] / 2 for side in (-1, 0, 1)]
        points = torch.tensor([[*point, top] for point in (*edge, middle)])
        if not room.is_free(points[:3]).all():
            continue
        if any(piece.contains(points, 0.05).any() for piece in pieces):
            continue
        material = draw.choice(("wood", "wood", "metal", "plasterboard", "glass"))
        corners = (*(middle - size / 2), bottom), (*(middle + size / 2), top)
        turn = math.degrees(math.atan2(along[1], along[0]))
        piece = Cuboid(f"piece {len(pieces)}", material, *corners, turn)
        if not piece.contains(array, 0.2).any():
            pieces.append(piece)
    return tuple(pieces)


def draw_room(number: int) -> MeshRoom:
    """A room of random shape, size, materials and furniture, with the array high at a wall."""
    draw = random.Random(number)
    floor, convex = outline(number % 4, draw)
    ceiling = [*floor]
    if number % 4 == 2:  # a wall that leans inwards
        lean = draw.uniform(0.5, 1.4)
        ceiling[1:3] = [(x - lean, y) for x, y in floor[1:3]]
    height = draw.uniform(2.4, 3.3)
    materials = ("concrete", "brick", "plasterboard", "glass", "wood")
    walls = tuple(draw.choice(materials) for _ in floor)
    slabs = draw.choice(("concrete", "wood")), draw.choice(("concrete", "plasterboard"))
    side = draw.choice((0, 3 if number % 4 != 1 else 5))  # a wall along an axis
    start, end = np.array(floor[side]), np.array([*floor, floor[0]][side + 1])
    along = (end - start) / np.linalg.norm(end - start)
    at = start + draw.uniform(0.1, 0.5) * (end - start) + 0.25 * np.array([-along[1], along[0]])
    target = np.array(floor)[list(convex[0])].mean(0)
    array = (*at, draw.uniform(1.6, height - 0.25)), (*target, 0.6), draw.uniform(-90, 90)
    room = MeshRoom(tuple(floor), tuple(ceiling), height, convex, walls, slabs, (), array, {})
    return replace(room, furniture=furnish(room, draw))


class Scores(NamedTuple):
    """Scores of one training."""

    test: float  # median SSIM of the test links
    validation: float  # mean SSIM of the validation links, which chooses
    seconds: float  # processor time of search and training [s]


def train(links: gaigs.Links, start: str, words: list[str]) -> Scores:
    """Scores of mirrored Gaussians from a start."""
    began = time.process_time()
    words = [f"model.search={STARTS[start]}", "kriging=false", *words]
    model = gaigs.train("mirrored", links, *words, progress=False)
    seconds = time.process_time() - began
    found = []
    for part in (links.split.test, links.split.validation):
        found.append(links.task.scores(links.labels[part], predicted(model, links, part))["ssim"])
    return Scores(found[0].median().item(), found[1].mean().item(), seconds)


def main() -> None:
    shape = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=shape)
    parser.add_argument("words", nargs="*", metavar="KEY=VALUE", help="options of the trainings")
    parser.add_argument("--rooms", type=int, nargs="+", default=[*range(6)])
    parser.add_argument("--splits", nargs="+", choices=SPLITS, default=[*SPLITS])
    options = parser.parse_args()
    titles = [f"{start}, {name}" for start in STARTS for name in ("test", "validation", "seconds")]
    rows = [("room", "split", *titles, "by validation")]
    for number, split in product(options.rooms, options.splits):
        name = f"drawn_{number}"
        ROOMS[name] = draw_room(number)
        links = gaigs.links("sionna", room=name, **SPLITS[split])
        scores = [train(links, start, options.words) for start in STARTS]
        cells = []
        for own in scores:
            cells += [f"{own.test:.3f}", f"{own.validation:.4f}", f"{own.seconds:.0f}"]
        chosen = max(scores, key=lambda own: own.validation)
        rows.append((str(number), split, *cells, f"{chosen.test:.3f}"))
        print(*rows[-1], flush=True)
    print(markdown(rows))


if __name__ == "__main__":
    main()
