"""Times predictions of mirrored Gaussians, without a map and by way of one, interleaved in one
process.

    python benchmarks/mirrored.py
    python benchmarks/mirrored.py data=synthetic_rssi --links 256
    python benchmarks/mirrored.py --checkpoint runs/a-run/best.ckpt

Overrides are those of ``python -m gaigs +experiment=mirrored``. Every way gets the same Gaussians:
those of a checkpoint, without its kriging, or untrained ones, none of them pruned. Phases count.
Rendering is the rasterizer alone, or the sum over paths; a prediction is everything from position
to label. Times are medians for one link; judge them by their ratios within one run, as other work
on the machine slows all of them.
"""

import argparse
import statistics
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path

import torch
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from scipy.constants import speed_of_light

import gaigs
from gaigs.core.query import Batch
from gaigs.core.scene import carriers
from gaigs.data import Links, load
from gaigs.model import Model
from gaigs.registry import registry
from gaigs.runs.evaluation import device_name

POOLINGS = {"spectrum": "array_response", "rssi": "mean_power", "csi": "element_sum"}
"""Pooling of maps by task."""

MAPS = 8
"""Links whose maps are drawn at a time: a rasterizer takes one after the other."""


def build(overrides: list[str], checkpoint: Path | None) -> tuple[Model, Links]:
    """A model with phases, and its data."""
    config = gaigs.compose("+experiment=mirrored", *overrides)
    torch.manual_seed(config["seed"])
    links = load(config["data"], config["split"])
    model = registry("model").build(config["model"], scene=links.scene)
    model.fit(links)
    if checkpoint is None:
        model.placement.enable_phases(
            speed_of_light / carriers(links.scene, links.query).mean().item()
        )
    else:
        trained = gaigs.load(checkpoint)
        model.placement.load_state_dict(getattr(trained, "trend", trained).placement.state_dict())
    return model.eval(), links


def median_times(ways: dict[str, tuple[Callable, int]], repeats: int) -> dict[str, float]:
    """Milliseconds for one link, by way: a function and the links that it takes at a time."""
    times = defaultdict(list)
    for _ in range(repeats + 1):
        for name, (function, links) in ways.items():
            start = time.perf_counter()
            function()
            times[name].append(1e3 * (time.perf_counter() - start) / links)
    return {name: statistics.median(values[1:]) for name, values in times.items()}


@torch.no_grad()
def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE")
    parser.add_argument(
        "--checkpoint", type=Path, help="of a model trained with the same overrides"
    )
    parser.add_argument("--links", type=int, default=64, help="links predicted at a time")
    parser.add_argument("--repeats", type=int, default=20)
    options = parser.parse_intermixed_args()
    if min(options.links, options.repeats) < 1:
        parser.error(
            f"--links and --repeats must be at least 1, got {options.links} and {options.repeats}"
        )
    renderings, predictions, refusals = {}, {}, []
    task = gaigs.compose("+experiment=mirrored", *options.overrides)["task"]["name"]
    for name in ("paths", "torch", "opencl"):
        maps = [f"rasterizer={name}", "projection=mercator", f"pooling={POOLINGS.get(task)}"]
        overrides = [] if name == "paths" else maps
        try:
            model, links = build([*options.overrides, *overrides], options.checkpoint)
            count = options.links if name == "paths" else MAPS
            query = links.query[torch.arange(count) % len(links)]
            batch = Batch(query, links.task.directions)
            rendering = model.rendering(batch)
            rendering()
        except (ValueError, RuntimeError) as error:
            refusals.append(f"{name}: {error}")
            continue
        own = int((query.receivers == query.receivers[0]).sum())
        renderings[name] = rendering, own
        predictions[name] = lambda model=model, batch=batch: model.evaluate(batch), count
        paths = int(model.placement.kept.sum())
    if not renderings:
        parser.error("; ".join(refusals))
    rendering, prediction = (
        median_times(ways, options.repeats) for ways in (renderings, predictions)
    )
    title = f"{paths} paths, task {links.task.name}; {device_name(torch.device('cpu'))}"
    table = Table("", *map(str, rendering), title=title, box=SIMPLE_HEAD)
    for title, times in ("rendering", rendering), ("prediction", prediction):
        table.add_row(f"{title} [ms]", *(f"{value:.3f}" for value in times.values()))
        ratios = (value / times["paths"] for value in times.values()) if "paths" in times else ()
        table.add_row("over the paths'", *(f"{ratio:.1f}" for ratio in ratios))
    console = Console()
    console.print(table)
    for refusal in refusals:
        console.print(refusal, markup=False)


if __name__ == "__main__":
    main()
