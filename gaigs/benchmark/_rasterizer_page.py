"""Tables and figures of the benchmark of rasterizers, from its rows."""

import math
from collections.abc import Iterator, Mapping, Sequence

from gaigs.benchmark import MEASURED, Glance, Row
from gaigs.benchmark._limits import WAYS
from gaigs.benchmark._page import load_of, number, remarks, table
from gaigs.benchmark._scenes import SCENES

ABOUT = """Every rasterizer composites the same Gaussians, and is held against the dense sum over all pairs of splat and
pixel in float64. All of a table took turns, so that ratios within it hold on a busy machine, too; those
between tables may not.

| word | meaning |
|---|---|
| `common` | one transmitter, 3 channels, 360 x 90 units; standard deviations log-uniform in 1.5..8, no attenuation |
| `training` | 16 transmitters that deform the Gaussians and attenuate, 2 channels; 5 to 15 degrees wide |
| `aperture` | one transmitter, 16 elements, no map: what each element hears, against the dense sum over splats |
| ms, spread | median of the repeats, and the range of their middle half |
| times | as fast as `torch` in the same precision |
| pairs | splat, pixel and transmitter where the splat's opacity is at least 1/255 |
| live | pairs in front of which the transmittance is at least 1e-4 |
| of limit | operations that the pairs take by the formulas, over those of the fastest matrix product meanwhile |
| floor | what the OpenCL kernels' arithmetic takes for all pairs, and for live pairs, with every operand at hand |
| composited | the forward pass of `opencl` without sorting and listing |
| error | of the map, and backward of the gradients, over the largest value; where no pair is within 1e-4 of a bound |
| SSIM, dB | of the amplitude that is pooled from the map, and of its power |
| load | processes that wanted a core meanwhile, this one among them; above the threads, times are too long |
| memory | what both passes add to the memory in use at most, in a process of their own |

Inputs are rounded to each precision, which is part of its error. Of many Gaussians the dense sum covers a band of
columns in the middle of the map, as wide as the pixels checked say, and pairs are counted there. Tiles have no option:
a tile of `torch` is 16 x 16 pixels, one of `opencl` 16 x 8. A pass of over half a second is repeated less often.
"""

Place = tuple[str, str, str, str]
"""Device, scene, Gaussians and grid."""

PLACE = ("device", "scene", "gaussians", "grid")
"""What a reader calls a cell."""


def tables(rows: Sequence[Row]) -> str:
    """The section."""
    parts = [f"## Rasterizers\n\n{ABOUT}"]
    parts += [f"![Error against time]({name}.png)\n" for name in figures(rows)]
    for place, own in sorted(_places(rows).items(), key=lambda item: _order(item[0])):
        device, scene, gaussians, grid = place
        first = next(iter(own.values()))
        pixels = "elements" if scene == "aperture" else "pixels"
        sizes = f"{int(first['pairs']):,} pairs, {int(first['live_pairs']):,} of them live"
        checked = f"{int(first['pixels_checked']):,} {pixels} checked"
        load = f"load of the machine {load_of(own.values())}"
        parts.append(f"### {scene}, {int(gaussians):,} Gaussians, {grid}\n\n{device}; {sizes}; {checked}; {load}.\n")
        parts.append(_times(own))
        parts.append(_errors(own))
    return "\n".join(parts) + "\n" + remarks(rows, ("rasterizer", "precision"), PLACE)


def _places(rows: Sequence[Row]) -> dict[Place, dict[tuple[str, str, str], Row]]:
    """Measured rows by place, and there by rasterizer, precision and way."""
    found: dict[Place, dict] = {}
    for row in rows:
        if row["status"] == MEASURED:
            place = row["device"], row["scene"], row["gaussians"], row["grid"]
            found.setdefault(place, {})[row["rasterizer"], row["precision"], row["way"]] = row
    return found


def _times(own: Mapping[tuple[str, str, str], Row]) -> str:
    lines = []
    for (name, precision, way), row in own.items():
        floor = " / ".join(number(row[key]) for key in ("floor_ms", "live_floor_ms") if row[key])
        speed = [number(row[key]) for key in ("ms", "spread_ms")]
        share = f"{float(row['share_of_limit']):.1%}"
        line = [name, precision, way, *speed, row["repeats"], _times_torch(own, row), number(row["pairs_per_second"])]
        lines.append([*line, share, floor, number(row["composited_ms"])])
    head = ["rasterizer", "precision", "way", "ms", "spread", "repeats", "times", "pairs/s", "of limit"]
    return table([*head, "floor all / live [ms]", "composited [ms]"], lines)


def _times_torch(own: Mapping[tuple[str, str, str], Row], row: Row) -> str:
    other = own.get(("torch", row["precision"], row["way"]))
    return f"{float(other['ms']) / float(row['ms']):.1f}" if other else ""


def _errors(own: Mapping[tuple[str, str, str], Row]) -> str:
    lines = []
    for (name, precision, way), row in own.items():
        if way == WAYS[0] and (back := own.get((name, precision, WAYS[1]))):
            errors = [number(row["error_max"]), number(row["error_mean"]), f"{float(row['ssim']):.4f}"]
            errors.append(number(row["error_db"]))
            gradients = [number(back[key]) for key in ("error_max", "error_mean")]
            lines.append([name, precision, *errors, *gradients, number(row["peak_mb"])])
    head = ["rasterizer", "precision", "largest error", "mean error", "SSIM", "dB"]
    return table([*head, "of gradients", "mean", "memory [MB]"], lines)


def figures(rows: Sequence[Row]) -> dict:
    """Error against time of both passes, by device and scene; a panel a number of Gaussians, on the largest grid."""
    from gaigs.benchmark._figures import pareto  # matplotlib is slow to import

    panels: dict[tuple[str, str], dict[int, dict[str, list[tuple[float, float]]]]] = {}
    for (device, scene, gaussians, _), own in sorted(_places(rows).items(), key=lambda item: _order(item[0])):
        points = {}
        for (name, precision, way), row in own.items():
            error = float(row["error_max"])
            if way == WAYS[0] and math.isfinite(error) and error > 0:
                points[f"{name}, {precision}"] = [(_both(own, name, precision), error)]
        if points:
            panels.setdefault((device, scene), {})[int(gaussians)] = points  # a larger grid takes a smaller one's place
    found = {}
    devices = [*dict.fromkeys(device for device, _ in panels)]
    for (device, scene), by_count in panels.items():
        number_ = devices.index(device) + 1
        shown = {f"{count:,} Gaussians": by_count[count] for count in sorted(by_count)}
        name = f"rasterizer_{scene}" + (f"_{number_}" if number_ > 1 else "")
        label = f"{scene} on {device}: forward and backward [ms]"
        found[name] = pareto(shown, label, "largest error\nover largest value")
    return found


def _order(place: Place) -> tuple:
    """Of places on the page: scenes as they are listed, and the small ones first."""
    device, scene, gaussians, grid = place
    rows, columns = map(int, grid.split(" x "))
    return [*SCENES].index(scene), int(gaussians), rows * columns, device


def _both(own: Mapping[tuple[str, str, str], Row], name: str, precision: str) -> float:
    """Time of both passes [ms]."""
    return sum(float(own[name, precision, way]["ms"]) for way in WAYS)


def highlights(rows: Sequence[Row]) -> list[Glance]:
    """Each rasterizer beside torch in float32, by scene, where both have most pairs in common."""
    return [glance for device in dict.fromkeys(row["device"] for row in rows) for glance in _of_device(rows, device)]


def _of_device(rows: Sequence[Row], device: str) -> Iterator[Glance]:
    shown: dict[tuple[str, str, str], tuple[int, Glance]] = {}
    for (at, scene, gaussians, grid), own in _places(rows).items():
        base = own.get(("torch", "float32", "forward"))
        if at != device or (base is None and scene != "aperture"):
            continue
        for (name, precision, way), row in own.items():
            if way != "forward" or row is base:
                continue
            back = own[name, precision, "backward"]
            times = _ratios(own, name, precision)
            told = f"{number(row['ms'])} + {number(back['ms'])} ms{times}"
            error = f"{number(row['error_max'])}, SSIM {float(row['ssim']):.4f}"
            choice = f"`{name}` in {precision}" + (" for `torch` in float32" if times else "")
            where = f"{scene}, {int(gaussians):,} Gaussians, {grid}, forward + backward"
            key, pairs = (name, precision, scene), int(row["pairs"])
            if key not in shown or shown[key][0] <= pairs:
                shown[key] = pairs, Glance(choice, where, told, error, device)
    yield from (glance for _, glance in shown.values())


def _ratios(own: Mapping[tuple[str, str, str], Row], name: str, precision: str) -> str:
    """How many times as fast as torch in float32, both passes."""
    if ("torch", "float32", "forward") not in own:
        return ""
    times = _both(own, "torch", "float32") / _both(own, name, precision)
    return f", {times:.2g} times as fast"
