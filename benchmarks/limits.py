"""Times of ``rasterizer=opencl`` beside the bare arithmetic of its kernels, on the scene
``common``.

    python benchmarks/limits.py
    python benchmarks/limits.py 1000 5000 --repeats 50

The floor is the time of the kernels' arithmetic for all pairs of a splat and a pixel, and for the
live ones, with every operand at hand: no lists, no rows that miss, no tiles to load. A pair is live
if the transmittance in front of it is at least 1e-4, where the rasterizer of 3D Gaussian Splatting
(Kerbl et al., 2023) stops. Composited is the forward pass without sorting and listing. Needs
gaigs[opencl]. docs/speed.md has the numbers.
"""

import argparse
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyopencl as cl
import torch
from scenes import DrawnScene, cast_scene, common, footprints_of, passes

from gaigs.registry import registry
from gaigs.report.table import markdown
from gaigs.splatting.rasterizer import ALPHA_MAX, ALPHA_MIN, OPAQUE, STEEPEST, opencl

WAYS = "forward", "backward"


class Ceiling:
    """The kernels' arithmetic for a pair of a splat and a pixel with all lanes live."""

    def __init__(self, channels: int, attenuation: bool):
        self.queue = opencl.open_queue(None)
        macros = {
            "CHANNELS": channels,
            "ATTENUATION": int(attenuation),
            "TRANSMITTERS": 1,
            "SEPARABLE": 1,
        }
        bounds = {
            "ALPHA_MIN": ALPHA_MIN,
            "ALPHA_MAX": ALPHA_MAX,
            "OPAQUE": OPAQUE,
            "STEEPEST": STEEPEST,
        }
        macros |= {bound: opencl._literal(value) for bound, value in bounds.items()}
        source = opencl._source() + Path(__file__).with_name("ceiling.cl").read_text()
        program = cl.Program(self.queue.context, source)
        program.build(["-w", *(f"-D{macro}={value}" for macro, value in macros.items())])
        self.kernels = {way: cl.Kernel(program, f"ceiling_{way}") for way in WAYS}
        self.items = 4 * self.queue.device.max_compute_units
        values = np.full(64 + self.items, 0.01, np.float32)
        self.memory = cl.Buffer(self.queue.context, cl.mem_flags.COPY_HOST_PTR, hostbuf=values)

    def measure(self, way: str, chunks: int = 100) -> float:
        """Time of a pair [s]."""
        start = time.perf_counter()
        self.kernels[way](self.queue, (self.items,), (1,), self.memory, np.int32(chunks)).wait()
        layout = opencl.LAYOUT
        pairs = self.items * layout.chunk * layout.rows * layout.columns * chunks
        return (time.perf_counter() - start) / pairs


def compositor(scene: DrawnScene) -> Callable[[], object]:
    """The forward pass without sorting and listing, which are done here."""
    splats, *others = cast_scene(scene, "cpu", torch.float32)
    render = opencl._Render(opencl.open_queue(None), splats, *others)
    return lambda: render.forward(differentiate=True)


def count(scene: DrawnScene) -> tuple[int, int]:
    """Numbers of pairs and of live pairs, estimated on a coarser grid."""
    coarse = scene.coarse()
    order, footprints = footprints_of(coarse.splats, coarse.plane)
    product = coarse.opacities[:, order, None, None] * footprints
    acts = product >= ALPHA_MIN
    passed = torch.where(acts, 1 - product.clamp_max(ALPHA_MAX), 1)
    before = torch.cat((torch.ones_like(passed[:, :1]), passed[:, :-1].cumprod(1)), 1)
    share = (
        len(coarse.plane.v)
        * coarse.plane.u.shape[1]
        / (len(scene.plane.v) * scene.plane.u.shape[1])
    )
    return tuple(round(int(pairs.sum()) / share) for pairs in (acts, acts & (before >= 1e-4)))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("gaussians", nargs="*", type=int, default=[1000, 5000, 20000])
    parser.add_argument("--repeats", type=int, default=20)
    options = parser.parse_args()
    ceiling = Ceiling(3, False)
    head = [
        "splats",
        "pairs",
        "live",
        "floor forward, all / live [ms]",
        "backward",
        "forward [ms]",
        "composited",
    ]
    lines = [[*head, "backward"]]
    for n in options.gaussians:
        scene = common(n, 90, 360)
        turn = passes(registry("rasterizer").build({"name": "opencl"}), scene, "cpu", torch.float32)
        composite, times = compositor(scene), defaultdict(list)
        for _ in range(options.repeats + 1):
            for way, seconds in zip(WAYS, turn(), strict=True):
                times[way].append(seconds)
                times[f"floor {way}"].append(ceiling.measure(way))
            start = time.perf_counter()
            composite()
            times["composited"].append(time.perf_counter() - start)
        ms = {name: 1e3 * statistics.median(values[1:]) for name, values in times.items()}
        pairs = count(scene)
        floors = [
            " / ".join(f"{ms[f'floor {way}'] * number:.2f}" for number in pairs) for way in WAYS
        ]
        found = [f"{ms[name]:.2f}" for name in ("forward", "composited", "backward")]
        lines.append([f"{n:,}", *(f"{number:,}" for number in pairs), *floors, *found])
    print(markdown(lines))


if __name__ == "__main__":
    main()
