"""Peak memory that a forward and a backward pass of each rasterizer add, on the scene ``common``.

    python benchmarks/memory.py
    python benchmarks/memory.py 1000 5000 --rasterizers torch

Each pass runs in a process of its own, where memory that another pass has freed cannot hide the
peak. Linux only. docs/speed.md has the numbers.
"""

import argparse
import multiprocessing
import re
from pathlib import Path

import torch
from scenes import common, passes

from gaigs.registry import registry
from gaigs.report.table import markdown


def status(key: str) -> int:
    """A figure of this process [bytes]."""
    return 1024 * int(re.search(rf"{key}:\s*(\d+)", Path("/proc/self/status").read_text())[1])


def peak_mb(name: str, n: int) -> float:
    """Memory that both passes of a rasterizer add at most [MB]; a small scene before loads and
    compiles.
    """
    rasterizer = registry("rasterizer").build({"name": name})
    for count in (32, n):
        turn = passes(rasterizer, common(count, 90, 360), "cpu", torch.float32)
        Path("/proc/self/clear_refs").write_text("5")  # resets the peak
        before = status("VmRSS")
        turn()
    return (status("VmHWM") - before) / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("gaussians", nargs="*", type=int, default=[1000, 5000, 20000])
    parser.add_argument("--rasterizers", nargs="+", default=["opencl", "torch"])
    options = parser.parse_args()
    lines = [["splats", *(f"{name} [MB]" for name in options.rasterizers)]]
    for n in options.gaussians:
        with multiprocessing.get_context("spawn").Pool(1, maxtasksperchild=1) as pool:
            peaks = [pool.apply(peak_mb, (name, n)) for name in options.rasterizers]
        lines.append([f"{n:,}", *(f"{peak:.0f}" for peak in peaks)])
    print(markdown(lines))


if __name__ == "__main__":
    main()
