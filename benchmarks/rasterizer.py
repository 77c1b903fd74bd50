"""Times of both passes of each rasterizer, and its errors against a dense float64 sum.

    python benchmarks/rasterizer.py python benchmarks/rasterizer.py --common 1000 5000 --training
    --grids 90x360 --precisions float32

A rasterizer that cannot draw a scene is listed with the reason.
"""

import itertools
import statistics
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any

import torch
from common import (
    UNAVAILABLE,
    Benchmark,
    Row,
    command_line,
    grouped,
    median_and_spread,
    positive,
    table,
)
from scenes import SCENES, Truth, passes

from gaigs.registry import registry

INTRODUCTION = """# Rasterizers

Every rasterizer composites the same Gaussians: `common` has one transmitter and 3 channels, `training` 16 transmitters
that deform the Gaussians and attenuate, and 2 channels. Rasterizers of one scene, number of Gaussians and grid took
turns, so that their ratios hold on a busy machine. Times are medians, spreads the range of the middle half; "times" is
the speed of both passes over that of `torch` in the same precision. Pairs are splats, pixels and transmitters where the
opacity is at least 1/255. An error is the largest deviation from the dense float64 sum over all pairs, over the largest
value; inputs are rounded to each precision, which is part of it.
"""


class Rasterizers(Benchmark):
    """Rasterizers x scenes x Gaussians x grids x precisions."""

    name = "rasterizer"
    keys = ("device", "scene", "gaussians", "grid", "rasterizer", "precision")
    values = (
        "pairs",
        "forward_ms",
        "forward_spread_ms",
        "backward_ms",
        "backward_spread_ms",
        "repeats",
        "times",
    )
    values += ("error", "gradient_error")

    def cells(self, device: str) -> Iterator[list[Row]]:
        options, sizes = self.options, []
        for scene, counts in (("common", options.common), ("training", options.training)):
            transmitters = 16 if scene == "training" else 1
            for n, (rows, columns) in itertools.product(counts, options.grids):
                sizes.append((n * rows * columns * transmitters, scene, n, rows, columns))
        for _, scene, n, rows, columns in sorted(sizes):
            own = {"scene": scene, "gaussians": str(n), "grid": f"{rows} x {columns}"}
            kinds = itertools.product(options.rasterizers, options.precisions)
            yield [own | {"rasterizer": name, "precision": precision} for name, precision in kinds]

    def measure(self, cell: Sequence[Row], device: str) -> list[dict]:
        first = cell[0]
        scene = SCENES[first["scene"]](
            int(first["gaussians"]), *map(int, first["grid"].split(" x "))
        )
        truth = Truth(scene)
        rows: dict[tuple[str, str], dict[str, Any]] = {
            (row["rasterizer"], row["precision"]): {**row} for row in cell
        }
        turns, times = {}, defaultdict[tuple[str, str], list](list)
        for (name, precision), row in rows.items():
            try:
                rasterizer, dtype = (
                    registry("rasterizer").build({"name": name}),
                    getattr(torch, precision),
                )
                row |= truth.errors(rasterizer, device, dtype) | {"pairs": truth.pairs}
                turns[name, precision] = passes(rasterizer, scene, device, dtype)
            except (AttributeError, TypeError, ValueError, RuntimeError, ImportError) as error:
                row["status"] = UNAVAILABLE + " ".join(str(error).split())
        for number_of_turn in range(self.options.repeats + 1):  # the first one is for warm-up
            for kind, turn in turns.items():
                if number_of_turn < 4 or max(times[kind][0]) < 0.5:
                    times[kind].append(turn())
        total = {
            kind: sum(map(statistics.median, zip(*found[1:], strict=True)))
            for kind, found in times.items()
        }
        for kind, found in times.items():
            for way, seconds in zip(
                ("forward", "backward"), zip(*found[1:], strict=True), strict=True
            ):
                median, spread = median_and_spread(seconds)
                rows[kind] |= {
                    f"{way}_ms": 1e3 * median,
                    f"{way}_spread_ms": 1e3 * spread,
                    "repeats": len(seconds),
                }
            if ("torch", kind[1]) in total:
                rows[kind]["times"] = total["torch", kind[1]] / total[kind]
        return [*rows.values()]

    def tables(self, rows: Sequence[Row]) -> str:
        def size(row):
            return (int(row["gaussians"]), [int(edge) for edge in row["grid"].split(" x ")])

        groups = sorted(grouped(rows, "scene", "device").items())
        shown = {key.replace("_", " "): key for key in (*self.keys[2:], *self.values)}
        titles = (
            f"## {', '.join(place)}\n\n{table(sorted(own, key=size), shown)}"
            for place, own in groups
        )
        return "\n".join([INTRODUCTION, *titles])


def grid(text: str) -> list[int]:
    """Rows and columns from "90x360"."""
    rows, columns = text.split("x")
    return [positive(rows), positive(columns)]


def main(words: Sequence[str] | None = None) -> None:
    names = [name for name in registry("rasterizer").names() if name != "fastest"]
    precisions = ["float64", "float32", "bfloat16", "float16"]
    parser = command_line(__doc__, takes_overrides=False)
    add, text = parser.add_argument, "numbers of Gaussians in this scene"
    add("--rasterizers", nargs="+", choices=names, default=names)
    add("--common", nargs="*", type=positive, default=[200, 1000, 5000, 20000, 100000], help=text)
    add("--training", nargs="*", type=positive, default=[200, 1000, 5000], help=text)
    add(
        "--grids",
        nargs="+",
        type=grid,
        default=[[23, 90], [90, 360]],
        help="rows x columns of maps",
    )
    add("--precisions", nargs="+", choices=precisions, default=precisions)
    text = "of a pass under half a second, after warm-up; a longer one has three"
    add("--repeats", type=positive, default=20, help=text)
    Rasterizers(parser.parse_args(words)).run()


if __name__ == "__main__":
    main()
