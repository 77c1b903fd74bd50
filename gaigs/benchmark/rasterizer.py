"""Rasterizers: time of both passes, and error against a dense float64 sum."""

import itertools
import statistics
from collections import defaultdict
from collections.abc import Iterator, Sequence
from typing import Any

import torch

from gaigs.benchmark import UNAVAILABLE, Benchmark, Context, Row, grouped, median_and_spread, table
from gaigs.benchmark.scenes import SCENES, Truth, passes
from gaigs.registry import register, registry

INTRODUCTION = """# Rasterizers

Every rasterizer composites the same Gaussians: `common` has one transmitter and 3 channels, `training` 16 transmitters
that deform the Gaussians and attenuate, and 2 channels. Rasterizers of one scene, number of Gaussians and grid took
turns, so that their ratios hold on a busy machine. Times are medians, spreads the range of the middle half; "times" is
the speed of both passes over that of `torch` in the same precision. Pairs are splats, pixels and transmitters where the
opacity is at least 1/255. An error is the largest deviation from the dense float64 sum over all pairs, over the largest
value; inputs are rounded to each precision, which is part of it.
"""


@register("benchmark", "rasterizer")
class RasterizerBenchmark(Benchmark):
    """Rasterizers x scenes x Gaussians x grids x precisions.

    Args:
        common, training: Numbers of Gaussians in the scene of that name; an empty list leaves it out.
        grids: Rows and columns of maps, in pairs.
        precisions: Precisions of the tensors.
        rasterizers: Names; None: all registered ones but ``fastest``, which is one of the others.
        repeats: Repeats of a pass shorter than half a second; a longer one has at most three.
    """

    name = "rasterizer"
    keys = ("device", "scene", "gaussians", "grid", "rasterizer", "precision")
    values = ("pairs", "forward_ms", "forward_spread_ms", "backward_ms", "backward_spread_ms", "repeats", "times")
    values += ("error", "gradient_error")

    def __init__(
        self,
        common: list[int],
        training: list[int],
        grids: list[list[int]],
        precisions: list[str],
        rasterizers: list[str] | None = None,
        repeats: int = 20,
    ):
        known = registry("rasterizer").names()
        self.rasterizers = [name for name in known if name != "fastest"] if rasterizers is None else rasterizers
        self.scenes = {"common": common, "training": training}
        allowed = "float64", "float32", "bfloat16", "float16"
        if unknown := {*precisions} - {*allowed}:
            raise ValueError(f"benchmark.precisions must be among {', '.join(allowed)}, got {', '.join(unknown)}")
        if min([*common, *training, 1]) < 1 or any(len(grid) != 2 or min(grid) < 1 for grid in grids):
            raise ValueError("benchmark.common, training and grids must be numbers of at least 1, and grids pairs")
        if repeats < 1:
            raise ValueError(f"benchmark.repeats must be at least 1, got {repeats}")
        self.grids, self.precisions, self.repeats = grids, precisions, repeats

    def cells(self, context: Context) -> Iterator[list[Row]]:
        sizes = [
            (n * rows * columns * (16 if scene == "training" else 1), scene, n, rows, columns)
            for scene, counts in self.scenes.items()
            for n, (rows, columns) in itertools.product(counts, self.grids)
        ]
        for _, scene, n, rows, columns in sorted(sizes):
            own = {"scene": scene, "gaussians": str(n), "grid": f"{rows} x {columns}"}
            kinds = itertools.product(self.rasterizers, self.precisions)
            yield [own | {"rasterizer": name, "precision": precision} for name, precision in kinds]

    def measure(self, cell: Sequence[Row], context: Context) -> list[dict]:
        first = cell[0]
        scene = SCENES[first["scene"]](int(first["gaussians"]), *map(int, first["grid"].split(" x ")))
        truth = Truth(scene)
        rows: dict[tuple[str, str], dict[str, Any]] = {(row["rasterizer"], row["precision"]): {**row} for row in cell}
        turns, times = {}, defaultdict[tuple[str, str], list](list)
        for (name, precision), row in rows.items():
            try:
                rasterizer, dtype = registry("rasterizer").build({"name": name}), getattr(torch, precision)
                row |= truth.errors(rasterizer, context.device, dtype) | {"pairs": truth.pairs}
                turns[name, precision] = passes(rasterizer, scene, context.device, dtype)
            except (AttributeError, TypeError, ValueError, RuntimeError, ImportError) as error:
                row["status"] = UNAVAILABLE + " ".join(str(error).split())
        for number_of_turn in range(self.repeats + 1):  # the first one is for warm-up
            for kind, turn in turns.items():
                if number_of_turn < 4 or max(times[kind][0]) < 0.5:
                    times[kind].append(turn())
        total = {kind: sum(map(statistics.median, zip(*found[1:], strict=True))) for kind, found in times.items()}
        for kind, found in times.items():
            for way, seconds in zip(("forward", "backward"), zip(*found[1:], strict=True), strict=True):
                median, spread = median_and_spread(seconds)
                rows[kind] |= {f"{way}_ms": 1e3 * median, f"{way}_spread_ms": 1e3 * spread, "repeats": len(seconds)}
            if ("torch", kind[1]) in total:
                rows[kind]["times"] = total["torch", kind[1]] / total[kind]
        return [*rows.values()]

    def tables(self, rows: Sequence[Row]) -> str:
        size = lambda row: (int(row["gaussians"]), [int(edge) for edge in row["grid"].split(" x ")])
        groups = sorted(grouped(rows, "scene", "device").items())
        shown = {key.replace("_", " "): key for key in (*self.keys[2:], *self.values)}
        titles = (f"## {', '.join(place)}\n\n{table(sorted(own, key=size), shown)}" for place, own in groups)
        return "\n".join([INTRODUCTION, *titles])
