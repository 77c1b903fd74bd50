"""Fails where a rasterizer has lost more than 30 % of its speed, or its error has grown more than
ten times.

    python benchmarks/guard.py
    python benchmarks/guard.py --record

Speeds are ratios of processor times, each the least of some repeats: of the bare arithmetic of the
kernels to ``opencl``, of exponentials of 2^18 numbers to the forward pass of ``torch``, and of that
to its backward pass. ``baseline.json`` has both by processor, torch and OpenCL driver; ``--record``
adds this machine. Needs gaigs[opencl].
"""

import argparse
import importlib.metadata
import json
import re
import time
from collections import defaultdict
from pathlib import Path

import torch
from limits import WAYS, Ceiling, compositor
from scenes import SCENES, Truth, passes

from gaigs.io.files import write_text
from gaigs.registry import registry
from gaigs.report.table import markdown
from gaigs.runs.evaluation import device_name

BASELINE = Path(__file__).with_name("baseline.json")

TIMED = {("opencl", "common"): (5000, 90, 360), ("opencl", "training"): (200, 45, 180)}
TIMED |= {("torch", "common"): (200, 23, 90), ("torch", "training"): (8, 23, 45)}
"""Gaussians, rows and columns by rasterizer and scene: passes of a few milliseconds."""

CHECKED = {"common": (300, 23, 90), "training": (50, 23, 90)}
"""The same of the scenes on which errors are measured."""


def machine() -> str:
    """Processor, torch and OpenCL driver."""
    info = Path("/proc/cpuinfo").read_text()
    family, model = (
        re.search(rf"^{key}\s*: (.*)", info, re.M)[1] for key in ("cpu family", "model")
    )
    drivers = {
        f"{d.name} {d.version}" for d in importlib.metadata.distributions() if "pocl" in d.name
    }
    name = re.sub(r", \d+ threads?$", "", device_name(torch.device("cpu")))
    return ", ".join(
        [name, f"family {family} model {model}", f"torch {torch.__version__}", *sorted(drivers)]
    )


def ratios(repeats: int) -> dict[str, float]:
    """Speeds by rasterizer, scene and pass."""
    torch.set_num_threads(1)  # other threads spin while they wait, and count as work
    numbers, turns, references = torch.full((2**18,), -1.0), {}, {}
    for (name, scene), sizes in TIMED.items():
        built = SCENES[scene](*sizes)
        turns[name, scene] = passes(
            registry("rasterizer").build({"name": name}),
            built,
            "cpu",
            torch.float32,
            time.process_time,
        )
        if name == "opencl":
            ceiling = Ceiling(built.signal.shape[-1], built.attenuations is not None)
            references[scene] = ceiling, compositor(built)
    least = defaultdict(lambda: float("inf"))

    def time_of(key, work) -> None:
        start = time.process_time()
        work()
        least[key] = min(least[key], time.process_time() - start)

    for _ in range(repeats + 1):
        time_of("numbers", lambda: [numbers.exp() for _ in range(8)])
        for (name, scene), turn in turns.items():
            for way, seconds in zip(WAYS, turn(), strict=True):
                least[name, scene, way] = min(least[name, scene, way], seconds)
            if name == "opencl":
                ceiling, composite = references[scene]
                time_of((name, scene, "compositing"), composite)
                for way in WAYS:
                    time_of(("ceiling", scene, way), lambda c=ceiling, w=way: c.measure(w, 60))
    return _relative(least, list(turns))


def _relative(least: dict, turns: list) -> dict[str, float]:
    """Speeds relative to what the processor can do, from the least times [s]."""
    found = {}
    for name, scene in turns:
        there, back = least[name, scene, "forward"], least[name, scene, "backward"]
        if name == "opencl":
            floor = least["ceiling", scene, "forward"]
            found[f"{name}, {scene}, compositing"] = floor / least[name, scene, "compositing"]
            found[f"{name}, {scene}, forward"] = floor / there
            found[f"{name}, {scene}, backward"] = least["ceiling", scene, "backward"] / back
        else:
            found[f"{name}, {scene}, forward"] = least["numbers"] / there
            found[f"{name}, {scene}, backward"] = there / back
    return found


def errors() -> dict[str, float]:
    """Largest errors by rasterizer, scene and pass."""
    found = {}
    truths = {scene: Truth(SCENES[scene](*sizes)) for scene, sizes in CHECKED.items()}
    for name, scene in TIMED:
        own = truths[scene].errors(
            registry("rasterizer").build({"name": name}), "cpu", torch.float32
        )
        found |= {
            f"{name}, {scene}, {way}, error": error
            for way, error in zip(WAYS, own.values(), strict=True)
        }
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--record", action="store_true", help="write this machine's baseline")
    parser.add_argument("--repeats", type=int, default=20)
    options = parser.parse_args()
    baselines = json.loads(BASELINE.read_text())
    known, speeds = baselines.get(machine(), {}), ratios(options.repeats)
    found = speeds | errors()
    lines = [["quantity", "found", "baseline"]]
    print(
        markdown(
            lines
            + [
                [key, f"{value:.3g}", f"{known.get(key, float('nan')):.3g}"]
                for key, value in found.items()
            ]
        )
    )
    if options.record:
        write_text(
            BASELINE, json.dumps(baselines | {machine(): found}, indent=2, sort_keys=True) + "\n"
        )
    elif not known:
        raise SystemExit(f"{BASELINE.name} has no baseline of {machine()}; --record adds it")
    else:
        lost = [key for key in known if key in speeds and speeds[key] < 0.7 * known[key]]
        lost += [
            key
            for key in known
            if key in found.keys() - speeds.keys() and not found[key] <= 10 * known[key]
        ]
        raise SystemExit("worse than the baseline: " + ", ".join(lost) if lost else 0)


if __name__ == "__main__":
    main()
