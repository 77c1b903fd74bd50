"""Times every registered rasterizer on one scene, interleaved in one process, beside the processor's own ceiling.

    python benchmarks/rasterizers.py
    python benchmarks/rasterizers.py --scene training --splats 200 1000
    python benchmarks/rasterizers.py --device cuda --splats 20000 200000
    python benchmarks/rasterizers.py --splats 300 1000 3000 10000 30000 --figure rasterizers.png

A pair is a splat, a pixel and a transmitter where the splat's opacity reaches ALPHA_MIN. It is live if the
transmittance in front of it is at least STOP. Customary rasterizers leave out the others; torch composites them, opencl
as far as they change a tile by 5e-7 or more. A floor is the number of pairs times what the OpenCL
kernels' arithmetic takes for one with every lane live and every operand at hand: no lists, no rows that miss, no tiles
to load; without opencl there is none. Times are medians; judge them by their ratios within one run, as other work on
the machine slows all of them.
"""

import argparse
import math
import multiprocessing
import re
import statistics
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import pyopencl as cl
import torch
from matplotlib import rc_context
from matplotlib.figure import Figure
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from torch import Tensor

from gaigs.projection import Plane, Splats
from gaigs.rasterizer import ALPHA_MAX, ALPHA_MIN, Rasterizer, opencl
from gaigs.rasterizer.torch import TorchRasterizer
from gaigs.registry import registry
from gaigs.report.style import BLUE, COLUMN, DPI, GREEN, GREY, ORANGE, PURPLE, STYLE

STOP = 1e-4
"""Transmittance below which the rasterizer of 3D Gaussian Splatting (Kerbl et al., 2023) stops at a pixel."""

CEILING = """
/* One splat that covers a whole tile, passed over and over; memory holds its appearance and its offsets, all small. */
static inline view_t view_still(global const float *memory) {
    view_t view;
    view.s = view.square = view.skew = memory[0];
    for (int r = 0; r < ROWS; r++) view.height[r] = memory[r];
    return view;
}

kernel void ceiling_forward(global float *memory, int chunks) {
    view_t view = view_still(memory);
    map_t map;
    lanes footprints[ROWS], all = 0;
    for (int r = 0; r < ROWS; r++)
        for (int c = 0; c < CHANNELS; c++) map.colour[c][r] = 0;
    for (int chunk = 0; chunk < chunks; chunk++) {
        for (int r = 0; r < ROWS; r++) map.transmittance[r] = 1;
        for (int k = 0; k < CHUNK; k++, view.square += 1e-6f) {
            for (int r = 0; r < ROWS; r++) footprints[r] = footprint(offsets_of(&view, r));
            for (int r = 0; r < ROWS; r++) blend(&map, r, footprints[r], memory);
        }
    }
    for (int r = 0; r < ROWS; r++)
        for (int c = 0; c < CHANNELS; c++) all += map.colour[c][r];
    memory[64 + get_global_id(0)] = sum(all);
}

kernel void ceiling_backward(global float *memory, int chunks) {
    view_t view = view_still(memory);
    chunk_t chunk;
    found_t found = {0};
    moments_t moments = {0};
    lanes transmittance[ROWS], behind[ROWS], gradient[CHANNELS][ROWS];
    for (int r = 0; r < ROWS; r++)
        for (int c = 0; c < CHANNELS; c++) gradient[c][r] = memory[c];
    for (int number = 0; number < chunks; number++) {
        for (int r = 0; r < ROWS; r++) transmittance[r] = behind[r] = 1;
        for (int k = 0; k < CHUNK; k++, view.square += 1e-6f)
            for (int r = 0; r < ROWS; r++) {
                chunk.footprint[k][r] = footprint(offsets_of(&view, r));
                chunk.flow[k][r] = 0;
            }
        for (int k = 0; k < CHUNK; k++)
            for (int r = 0; r < ROWS; r++) pass_forward(&chunk, k, r, transmittance + r, memory);
        for (int k = CHUNK - 1; k >= 0; k--)
            for (int r = 0; r < ROWS; r++) pass_back(&chunk, k, r, behind + r, gradient[0] + r, memory, &found);
        for (int k = 0; k < CHUNK; k++)
            for (int r = 0; r < ROWS; r++) add_moments(&moments, chunk.flow[k][r], offsets_of(&view, r));
    }
    lanes all = found.opacity + found.attenuation + moments.s + moments.y + moments.yy;
    for (int c = 0; c < CHANNELS; c++) all += found.signal[c];
    memory[64 + get_global_id(0)] = sum(all);
}
"""

Scene = tuple[Splats, Tensor, Tensor, Tensor | None, Plane]
"""A rasterizer's arguments."""


def common(n: int, device="cpu", dtype=torch.float32) -> Scene:
    """360 x 90 pixels, standard deviations log-uniform in 1.5..8 pixels, opacities uniform in 0.05..0.6, 3 channels."""
    uniform = _uniform(device, dtype)
    means = torch.stack((uniform(0, 360, n), uniform(0, 90, n)), -1)
    splats = _splats(means, uniform(math.log(1.5), math.log(8), 1, n, 2).exp(), uniform)
    plane = Plane(torch.arange(360).to(means)[None] + 0.5, torch.arange(90).to(means)[:, None] + 0.5, None)
    return splats, uniform(0, 1, 1, n, 3), uniform(0.05, 0.6, 1, n), None, plane


def training(n: int, device="cpu", dtype=torch.float32) -> Scene:
    """16 transmitters that deform splats of 5 to 15 degrees and attenuate; 2 channels, 90 x 360 directions."""
    uniform = _uniform(device, dtype)
    means = torch.stack((uniform(-math.pi, math.pi, n), uniform(0, math.pi / 2, n)), -1)
    splats = _splats(means, torch.deg2rad(uniform(5, 15, 16, n, 2)), uniform)
    degrees = lambda count: torch.deg2rad(torch.arange(count).to(means))
    plane = Plane(degrees(360)[None], degrees(90)[:, None], 2 * math.pi)
    return splats, uniform(-1, 1, 16, n, 2), uniform(0, 0.6, 16, n), uniform(0.5, 1, 16, n), plane


SCENES = {"common": common, "training": training}

WAYS = "forward", "backward"

SPEED = "forward\n[ms]", "composited\n[ms]", "backward\n[ms]", "torch's\nforward", "torch's\nbackward"
ACCURACY = "peak [MB]", "error of map", "error of gradients"


def _uniform(device, dtype):
    generator = torch.Generator().manual_seed(0)
    return lambda low, high, *shape: (low + (high - low) * torch.rand(*shape, generator=generator)).to(device, dtype)


def _splats(means: Tensor, deviations: Tensor, uniform) -> Splats:
    angles, depths = uniform(0, math.pi, *deviations.shape[:2]), uniform(1, 5, len(means))
    axes = torch.stack((angles.cos(), -angles.sin(), angles.sin(), angles.cos()), -1).unflatten(-1, (2, 2))
    half = axes * deviations[..., None, :]
    factors = torch.linalg.cholesky(half @ half.mT)[..., [0, 1, 1], [0, 0, 1]]
    return Splats(means, factors, depths, depths > 0)


def inspect(scene: Scene) -> tuple[int, int, Tensor]:
    """How many pairs act, how many of them are live, and which pixels (b, rows, columns) are no matter of rounding: no
    pair is near a bound."""
    splats, _, opacities, attenuations, plane = scene
    pairs = live = 0
    left = torch.ones(len(opacities), *plane.shape, dtype=torch.float64, device=opacities.device)
    clear = torch.ones_like(left, dtype=torch.bool)
    for i in splats.depths.argsort(stable=True).split(16):
        du, dv = plane.u - splats.means2d[i, 0, None, None], plane.v - splats.means2d[i, 1, None, None]
        if plane.period is not None:
            du = du - plane.period * (du / plane.period).round()
        p, q, r = splats.factors[:, i, :, None, None].unbind(2)
        across = du / p
        footprints = torch.exp(-0.5 * (across.square() + ((dv - q * across) / r).square()))
        product = opacities[:, i, None, None] * footprints
        acts = product >= ALPHA_MIN
        for bound in (ALPHA_MIN, ALPHA_MAX):
            clear &= ((product / bound - 1).abs() > 1e-4).all(1)
        passed = torch.where(acts, 1 - product.clamp_max(ALPHA_MAX), 1)
        if attenuations is not None:
            passed = torch.where(acts, passed * attenuations[:, i, None, None] ** footprints, 1)
        behind = left[:, None] * passed.double().cumprod(1)
        before = torch.cat((left[:, None], behind[:, :-1]), 1)
        pairs += int(acts.sum())
        live += int((acts & (before >= STOP)).sum())
        left = behind[:, -1]
    return pairs, live, clear


def run(rasterizer: Rasterizer, scene: Scene, pixels: Tensor) -> tuple[float, float, Tensor, list[Tensor]]:
    """Times of the forward and the backward pass [s], the map, and the gradients of a sum over ``pixels``."""
    splats, *parameters, plane = scene
    parameters = [splats.means2d, splats.factors, *parameters]
    parameters = [None if tensor is None else tensor.clone().requires_grad_() for tensor in parameters]
    means2d, factors, signal, opacities, attenuations = parameters
    splats = Splats(means2d, factors, splats.depths, splats.visible)
    outputs = pixels[:, None].repeat(1, signal.shape[-1], 1, 1), pixels
    start = _now(signal.device)
    image, left = rasterizer(splats, signal, opacities, attenuations, plane)
    between = _now(signal.device)
    torch.autograd.backward((image, left), outputs)
    end = _now(signal.device)
    gradients = [tensor.grad for tensor in parameters if tensor is not None]
    return between - start, end - between, image.detach(), gradients


def _now(device: torch.device) -> float:
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


def time_compositing(rasterizer: Rasterizer, scene: Scene) -> float | None:
    """Time of the forward pass without sorting and binning [s], for the one rasterizer that has them apart."""
    if not isinstance(rasterizer, opencl.OpenCLRasterizer):
        return None
    splats, signal, opacities, attenuations, plane = scene
    render = opencl._Render(opencl.open_queue(rasterizer.device), splats, signal, opacities, attenuations, plane)
    start = time.perf_counter()
    render.forward(differentiate=True)
    return time.perf_counter() - start


class Ceiling:
    """The OpenCL kernels' arithmetic alone, on all cores."""

    def __init__(self, channels: int, attenuation: bool):
        self.queue = opencl.open_queue(None)
        macros = {"CHANNELS": channels, "ATTENUATION": int(attenuation), "TRANSMITTERS": 1, "SEPARABLE": 1}
        macros |= {"ALPHA_MIN": opencl._literal(ALPHA_MIN), "ALPHA_MAX": opencl._literal(ALPHA_MAX)}
        options = ["-w", *(f"-D{macro}={value}" for macro, value in macros.items())]
        program = cl.Program(self.queue.context, opencl._source() + CEILING).build(options)
        self.kernels = {way: cl.Kernel(program, f"ceiling_{way}") for way in ("forward", "backward")}
        self.items = 4 * self.queue.device.max_compute_units
        values = np.full(64 + self.items, 0.01, np.float32)
        self.memory = cl.Buffer(self.queue.context, cl.mem_flags.COPY_HOST_PTR, hostbuf=values)

    def time_pair(self, way: str) -> float:
        """Time a pair, "forward" or "backward" [s]."""
        chunks = 100
        start = time.perf_counter()
        self.kernels[way](self.queue, (self.items,), (1,), self.memory, np.int32(chunks)).wait()
        seconds = time.perf_counter() - start
        return seconds / (self.items * chunks * opencl.CHUNK * opencl.ROWS * opencl.COLUMNS)


def peak_memory(name: str, scene: str, n: int, device: str) -> float:
    """What one forward and backward pass adds to the memory in use at most [MB]; to be called in a fresh process."""
    rasterizer = registry("rasterizer").get(name)()
    for count in (32, n):  # the first one loads and compiles
        arguments = SCENES[scene](count, device)
        pixels = torch.ones(len(arguments[1]), *arguments[-1].shape, device=device)
        if device == "cuda":
            torch.cuda.reset_peak_memory_stats()
            before = torch.cuda.memory_allocated()
        else:
            Path("/proc/self/clear_refs").write_text("5")  # resets the peak
            before = _status("VmRSS")
        run(rasterizer, arguments, pixels)
        peak = torch.cuda.max_memory_allocated() if device == "cuda" else _status("VmHWM")
    return (peak - before) / 1e6


def _status(key: str) -> int:
    """A figure of this process [bytes]."""
    return 1024 * int(re.search(rf"{key}:\s*(\d+)", Path("/proc/self/status").read_text())[1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=SCENES, default="common")
    parser.add_argument("--splats", type=int, nargs="+", default=[1000, 5000, 20000])
    names = [name for name in registry("rasterizer").names() if name != "fastest"]  # which is one of the others
    parser.add_argument("--rasterizers", nargs="+", default=names)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--device", default="cpu", help="torch device of the tensors")
    parser.add_argument("--figure", type=Path, metavar="FILE.png", help="times against live pairs")
    options = parser.parse_args()
    make_scene = SCENES[options.scene]

    console = Console()
    console.print(f"{options.scene}: {make_scene.__doc__}")
    console.print(f"{torch.get_num_threads()} threads; tensors on {options.device}")
    rasterizers = {}
    small = make_scene(32, options.device)
    for name in options.rasterizers:
        try:
            rasterizer = registry("rasterizer").get(name)()
            run(rasterizer, small, torch.ones(len(small[1]), *small[-1].shape, device=options.device))
            rasterizers[name] = rasterizer
            console.print(f"{name}: {rasterizer.used}")
        except (RuntimeError, TypeError) as error:
            console.print(f"{name} is left out: {error}")
    ceiling = None
    if isinstance(rasterizers.get("opencl"), opencl.OpenCLRasterizer):
        ceiling = Ceiling(small[1].shape[-1], small[3] is not None)

    speed = Table("", *map(escape, SPEED), box=SIMPLE_HEAD, pad_edge=False, collapse_padding=True)
    accuracy = Table("", *map(escape, ACCURACY), box=SIMPLE_HEAD, pad_edge=False)
    for table in (speed, accuracy):
        for column in table.columns[1:]:
            column.justify = "right"
    lines = defaultdict(list)
    for n in options.splats:
        scene = make_scene(n, options.device)
        pairs, live, clear = inspect(scene)
        pixels = clear.to(scene[1])
        times = defaultdict(list)
        for repeat in range(options.repeats + 1):
            for name, rasterizer in rasterizers.items():
                forward, backward, *_ = run(rasterizer, scene, pixels)
                found = {"forward": forward, "backward": backward, "composited": time_compositing(rasterizer, scene)}
                for part, seconds in found.items():
                    if repeat and seconds is not None:  # the first repeat warms up
                        times[name, part].append(1e3 * seconds)
            for way in WAYS if ceiling else ():
                times["ceiling", way].append(1e3 * ceiling.time_pair(way))
        medians = {key: statistics.median(milliseconds) for key, milliseconds in times.items()}
        speed.add_row(f"{n:,} splats")
        for count, kind in ((pairs, "pairs"), (live, "live")) if ceiling else ():
            forward, backward = (count * medians["ceiling", way] for way in WAYS)
            speed.add_row(f"  floor, {count:,} {kind}", "", f"{forward:.2f}", f"{backward:.2f}")
        double = make_scene(n, options.device, torch.float64)
        _, _, truth, true_gradients = run(TorchRasterizer(), double, clear.double())
        for name, rasterizer in rasterizers.items():
            composited = medians.get((name, "composited"))
            cells = [f"{medians[name, 'forward']:.2f}", f"{composited:.2f}" if composited else ""]
            cells.append(f"{medians[name, 'backward']:.2f}")
            for way in WAYS:
                cells.append(f"{medians['torch', way] / medians[name, way]:.1f} x" if "torch" in rasterizers else "")
                lines[name, way].append((live, medians[name, way]))
            speed.add_row(f"  {name}", *cells)
            _, _, image, gradients = run(rasterizer, scene, pixels)
            with multiprocessing.get_context("spawn").Pool(1) as pool:
                memory = pool.apply(peak_memory, (name, options.scene, n, options.device))
            errors = _error(image * clear[:, None], truth * clear[:, None]), max(map(_error, gradients, true_gradients))
            accuracy.add_row(f"{n:,} splats, {name}", f"{memory:.0f}", *(f"{error:.1e}" for error in errors))
    console.print(speed, accuracy)
    if options.figure:
        draw(lines, options.scene).savefig(options.figure, dpi=DPI)


def draw(lines: dict[tuple[str, str], list[tuple[int, float]]], scene: str) -> Figure:
    """Time against live pairs, both logarithmic.

    Args:
        lines: (live pairs, time [ms]) by rasterizer and way, "forward" or "backward".
        scene: Its name.
    """
    with rc_context(STYLE):
        figure = Figure(figsize=(COLUMN, 2.8), layout="constrained")
        ax = figure.subplots()
        ax.set(xscale="log", yscale="log", xlabel=f"live pairs, {scene} scene", ylabel="time [ms]")
        colours = dict(zip((name for name, way in lines if way == "forward"), (BLUE, ORANGE, GREEN), strict=False))
        label = "cost linear in live pairs"
        for (name, way), points in lines.items():
            pairs, milliseconds = np.array(sorted(points)).T
            look = {"color": colours.get(name, PURPLE), "linewidth": 0.9, "markersize": 5, "markeredgecolor": "white"}
            ax.plot(pairs, milliseconds, "o-" if way == "forward" else "s-", label=f"{name}, {way}", **look)
            if way == "forward":  # through its point with most pairs
                ax.plot(pairs, milliseconds[-1] * pairs / pairs[-1], "--", color=GREY, linewidth=0.9, label=label)
                label = None  # one entry of the key for all such lines
        ax.grid()
        figure.legend(loc="outside upper center", ncols=2)
    return figure


def _error(found: Tensor, truth: Tensor) -> float:
    """The largest deviation, relative to the largest value."""
    return float((found - truth).abs().max() / truth.abs().max())


if __name__ == "__main__":
    main()
