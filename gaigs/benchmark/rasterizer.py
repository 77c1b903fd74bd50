"""Rasterizers: error against a dense float64 sum, time, memory, share of what the arithmetic allows."""

import functools
import itertools
import logging
import statistics
from collections.abc import Iterator, Mapping, Sequence

import torch

from gaigs.benchmark import UNAVAILABLE, Context, Glance, Measured, Row, check_names, clock, device_of, named
from gaigs.benchmark import _rasterizer_page as page
from gaigs.benchmark._limits import OPERATIONS_OF_FIELDS, WAYS, Ceiling, Product, operations
from gaigs.benchmark._memory import peak_mb
from gaigs.benchmark._page import load_now
from gaigs.benchmark._passes import CAUSES, Passes, compositor, in_turns, start
from gaigs.benchmark._scenes import DRAWS_NO_MAP, SCENES, ApertureScene, Scene, cast
from gaigs.benchmark._truth import Truth, errors_of, errors_of_gradients, errors_of_pooled, pooled, sum_densely
from gaigs.registry import register, registry

log = logging.getLogger(__name__)

PRECISIONS = ("float64", "float32", "bfloat16", "float16")


@register("benchmark", "rasterizer")
class RasterizerBenchmark(Measured):
    """Rasterizers x scenes x Gaussians x grids x precisions, forward and backward.

    The rasterizers and precisions of a cell take turns, so that their ratios hold on a busy machine, too.

    Args:
        rasterizers: Names; None: all that are registered but ``fastest``, which is one of the others.
        common, training, aperture: Numbers of Gaussians in the scene of that name; an empty list leaves it out.
        grids: Rows and columns of maps, in pairs.
        precisions: Of the tensors.
        repeats: Of passes of under half a second.
        minutes, device: As of every benchmark.

    Raises:
        ValueError: An option is out of range, or names what there is not.
    """

    name = "rasterizer"
    keys = ("device", "rasterizer", "precision", "scene", "gaussians", "grid", "way")
    values = (
        "ms", "spread_ms", "least_ms", "repeats", "composited_ms", "pairs", "live_pairs", "pairs_per_second",
        "gigaops_limit", "share_of_limit", "floor_ms", "live_floor_ms", "error_max", "error_mean", "ssim", "error_db",
        "pixels_checked", "peak_mb", "tile", "load",
    )  # fmt: skip

    def __init__(
        self,
        common: list[int],
        training: list[int],
        aperture: list[int],
        grids: list[list[int]],
        precisions: list[str],
        rasterizers: list[str] | None = None,
        repeats: int = 20,
        minutes: float | None = None,
        device: str | None = None,
    ):
        super().__init__(minutes, device)
        known = registry("rasterizer").names()
        self.rasterizers = [name for name in known if name != "fastest"] if rasterizers is None else rasterizers
        check_names("rasterizers", self.rasterizers, known)
        check_names("precisions", precisions, PRECISIONS)
        self.scenes = {"common": common, "training": training, "aperture": aperture}
        for scene, counts in self.scenes.items():
            if any(n < 1 for n in counts):
                raise ValueError(f"benchmark.{scene} must be numbers of Gaussians of at least 1, got {counts}")
        if not grids or any(len(grid) != 2 or min(grid) < 8 for grid in grids):
            raise ValueError(f"benchmark.grids must be pairs of rows and columns, each at least 8, got {grids}")
        if repeats < 1:
            raise ValueError(f"benchmark.repeats must be at least 1, got {repeats}")
        self.grids, self.precisions, self.repeats = grids, precisions, repeats

    def cells(self, context: Context) -> Iterator[list[Row]]:
        places = []
        for scene, counts in self.scenes.items():
            # Of the aperture the grid is only that of what is pooled: the largest will do.
            grids = [max(self.grids)] if scene == DRAWS_NO_MAP else self.grids
            places += [
                (n * grid[0] * grid[1] * (16 if scene == "training" else 1), n, scene, grid)
                for n in counts
                for grid in grids
            ]
        for _, n, scene, (rows, columns) in sorted(places):
            own = {"scene": scene, "gaussians": str(n), "grid": f"{rows} x {columns}"}
            for device in context.devices:
                yield [
                    own | {"device": named(device), "rasterizer": name, "precision": precision, "way": way}
                    for name, precision, way in itertools.product(self.rasterizers, self.precisions, WAYS)
                ]

    def measure(self, cell: Sequence[Row], context: Context) -> Iterator[Row]:
        first = cell[0]
        device = device_of(first, context)
        grid = tuple(map(int, first["grid"].split(" x ")))
        place = first["scene"], int(first["gaussians"]), grid
        double = SCENES[place[0]](place[1], *grid)
        truth = sum_densely(double, device)
        runs, causes = {}, {}
        for key in dict.fromkeys((row["rasterizer"], row["precision"]) for row in cell):
            name, precision = key
            try:
                dtype = getattr(torch, precision)
                if place[0] == DRAWS_NO_MAP and dtype.itemsize == 2:
                    raise ValueError("torch has no complex numbers in half precision")
                runs[key] = start(name, cast(double, device, dtype))
            except CAUSES as error:
                causes[key] = " ".join(str(error).split())
        times = in_turns(self._turns(runs, device), self.repeats) if runs else {}
        found = {key: _errors(run, truth, grid) for key, run in runs.items()}
        peaks = {key: peak_mb(key[0], *place, key[1], device) for key in runs}
        for row in cell:
            key, way = (row["rasterizer"], row["precision"]), row["way"]
            if key in causes:
                yield row | {"status": UNAVAILABLE + causes[key]}
                continue
            yield row | found[key][way] | self._figures(times, key, way, runs[key].scene, truth) | {
                "peak_mb": peaks[key], "tile": tile_of(runs[key].rasterizer), "load": load_now()
            }  # fmt: skip

    def _turns(self, runs: Mapping[tuple[str, str], Passes], device: str) -> dict:
        now = clock(device)

        def timed(name: str, run: Passes):
            composite = compositor(run) if name == "opencl" else None

            def turn() -> dict[str, float]:
                start = now()
                run.forward()
                between = now()
                run.backward()
                seconds = {"forward": between - start, "backward": now() - between}
                if composite:
                    start = now()
                    composite()
                    seconds["composited"] = now() - start
                return seconds

            return turn

        turns: dict = {key: timed(key[0], run) for key, run in runs.items()}
        precisions = dict.fromkeys(precision for _, precision in runs)
        products = {precision: Product(device, getattr(torch, precision)) for precision in precisions}
        turns["limit"] = lambda: {precision: 1 / product.measure() for precision, product in products.items()}
        if run := runs.get(("opencl", "float32")):
            ceiling = _ceiling(run.scene.signal.shape[-1], run.scene.attenuations is not None)
            turns["ceiling"] = lambda: {way: ceiling.measure(way) for way in WAYS}
        return turns

    def _figures(self, times: Mapping, key: tuple[str, str], way: str, scene: Scene, truth: Truth) -> Row:
        own = times[key][way]
        seconds = statistics.median(own)
        low, _, high = statistics.quantiles(own, n=4) if len(own) > 1 else own * 3
        if isinstance(scene, ApertureScene):
            count = OPERATIONS_OF_FIELDS[way]
        else:
            count = operations(way, scene.signal.shape[-1], scene.attenuations is not None)
        limit = 1 / min(times["limit"][key[1]])
        figures = {
            "ms": 1e3 * seconds, "spread_ms": 1e3 * (high - low), "least_ms": 1e3 * min(own), "repeats": len(own),
            "pairs": truth.pairs, "live_pairs": truth.live, "pairs_per_second": truth.pairs / seconds,
            "gigaops_limit": limit / 1e9, "share_of_limit": truth.pairs * count / seconds / limit,
        }  # fmt: skip
        if composited := times[key].get("composited") if way == "forward" else None:
            figures["composited_ms"] = 1e3 * statistics.median(composited)
        if "ceiling" in times and key[1] == "float32":
            pair = 1e3 * statistics.median(times["ceiling"][way])
            figures |= {"floor_ms": pair * truth.pairs, "live_floor_ms": pair * truth.live}
        return figures

    def tables(self, rows: Sequence[Row]) -> str:
        return page.tables(rows)

    def figures(self, rows: Sequence[Row]):
        return page.figures(rows)

    def highlights(self, rows: Sequence[Row]) -> Sequence[Glance]:
        return page.highlights(rows)


def tile_of(rasterizer) -> str | None:
    """Rows and columns of a rasterizer's tiles, where it has them; none has them as an option."""
    match rasterizer.used.split()[0]:
        case "torch":
            from gaigs.rasterizer.torch import TILE

            return f"{TILE} x {TILE}"
        case "opencl":
            from gaigs.rasterizer import opencl

            return f"{opencl.ROWS} x {opencl.COLUMNS}"
    return None


_ceiling = functools.cache(Ceiling)


def _errors(run: Passes, truth: Truth, grid: tuple[int, int]) -> dict[str, dict[str, float]]:
    """Errors of the map and its pooled value, and those of gradients, by way."""
    run.forward()
    found = run.result()
    pixels = None
    if not isinstance(run.scene, ApertureScene):
        pixels = found.new_zeros(found.shape[0], *found.shape[2:])
        pixels[..., truth.band] = truth.clear.to(pixels)
    run.backward(pixels)
    ssim, level = errors_of_pooled(pooled(found, grid, truth.band), pooled(truth.outputs, grid, slice(None)))
    largest, mean = errors_of(found, truth)
    forward = {"error_max": largest, "error_mean": mean, "ssim": ssim, "error_db": level}
    largest, mean = errors_of_gradients(run.gradients(), truth)
    checked = {"pixels_checked": truth.checked}
    return {"forward": forward | checked, "backward": {"error_max": largest, "error_mean": mean} | checked}
