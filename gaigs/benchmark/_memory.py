"""Peak memory of a pass, in a fresh process for each, as what one has freed another one finds."""

import multiprocessing
import re
from pathlib import Path

import torch

from gaigs.benchmark._passes import Passes
from gaigs.benchmark._scenes import SCENES, cast
from gaigs.registry import registry

FEW = 32
"""Gaussians of the pass before, which loads and compiles."""

STATUS, RESET = Path("/proc/self/status"), Path("/proc/self/clear_refs")


def peak_mb(rasterizer: str, scene: str, n: int, grid: tuple[int, int], dtype: str, device: str) -> float | None:
    """What a forward and a backward pass add to the memory in use at most [MB]; None where the system does not tell."""
    # A server with all modules loaded is forked for each process, which takes a tenth of loading them anew.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["gaigs.__main__", "gaigs.benchmark._memory"])
    with context.Pool(1) as pool:
        return pool.apply(_measure, (rasterizer, scene, n, grid, dtype, device, torch.get_num_threads()))


def _measure(name, scene, n, grid, dtype, device, threads) -> float | None:
    torch.set_num_threads(threads)
    rasterizer = registry("rasterizer").build({"name": name})
    for count in (FEW, n):
        run = Passes(rasterizer, cast(SCENES[scene](count, *grid), device, getattr(torch, dtype)))
        before = _reset(device)
        if before is None:
            return None
        run.forward()
        run.backward()
        peak = torch.cuda.max_memory_allocated() if device == "cuda" else _status("VmHWM")
    return (peak - before) / 1e6


def _reset(device: str) -> int | None:
    """Resets the peak; gives the memory in use [bytes], or None where that is not to be had."""
    if device == "cuda":
        torch.cuda.reset_peak_memory_stats()
        return torch.cuda.memory_allocated()
    try:
        with RESET.open("w") as file:
            file.write("5")
    except OSError:  # not on Linux, or not allowed
        return None
    return _status("VmRSS")


def _status(key: str) -> int:
    """A figure of this process [bytes]."""
    return 1024 * int(re.search(rf"{key}:\s*(\d+)", STATUS.read_text())[1])
