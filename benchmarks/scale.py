"""Seconds of a whole run by stage, and how they grow with places:
python benchmarks/scale.py [--places 1000 4000] [--gateways 30] [KEY=VALUE ...].

Each size is an invented floor of 60 m x 40 m: path loss with exponent 3, shadowing of 4 dB over
3 m, noise of 2 dB, seed 0. It is written as a wide CSV, which a run of ``+experiment=mirrored_rssi``
reads in a process of its own. The last column is the exponent of time over places between the
smallest and the largest size.

``--dense DIR``, the folder of ble-flat, prints the error of tiled processes instead.
"""

import argparse
import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import common
import numpy as np

import gaigs
from gaigs.core.query import Batch
from gaigs.kriging.scalar import ScalarProcess
from gaigs.registry import registry
from gaigs.report.table import markdown

FLOOR = (60.0, 40.0)
"""Sides of the floor [m]."""


def shadowing(places, rng, deviation=4.0, length=3.0, waves=256):
    """A Gaussian field over places (n, 2) as a sum of plane waves [dB]."""
    vectors = rng.standard_normal((2, waves)) / length
    phases = places @ vectors + rng.uniform(0, 2 * math.pi, waves)
    return deviation * np.sqrt(2 / waves) * np.cos(phases).sum(1)


def write_survey(folder, places, gateways, seed=0):
    """Files of an invented survey: ``survey.csv``, a column a gateway, and ``gateways.csv``."""
    rng = np.random.default_rng(seed)
    transmitters = np.column_stack((rng.uniform(0, FLOOR, (places, 2)), np.full(places, 1.3)))
    receivers = np.column_stack((rng.uniform(0, FLOOR, (gateways, 2)), np.full(gateways, 2.5)))
    names = [f"g{number}" for number in range(gateways)]
    columns = [transmitters]
    for receiver in receivers:
        apart = np.linalg.norm(transmitters - receiver, axis=1)
        levels = -40 - 30 * np.log10(apart) + shadowing(transmitters[:, :2], rng)
        columns.append(levels + 2 * rng.standard_normal(places))
    head = ",".join(["x", "y", "z", *names])
    table = np.column_stack(columns)
    np.savetxt(folder / "survey.csv", table, "%.2f", ",", header=head, comments="")
    rows = [
        ",".join([name, *(f"{edge:.2f}" for edge in place)])
        for name, place in zip(names, receivers, strict=True)
    ]
    (folder / "gateways.csv").write_text("\n".join(["name,x,y,z", *rows]) + "\n")


def measure(folder, overrides):
    """Seconds of a run by stage, of the whole process as ``all``, of the processor, which other
    programs hardly change, and memory as ``GB``.
    """
    words = ["+experiment=mirrored_rssi", "data=rssi_wide", f"data.file={folder / 'survey.csv'}"]
    words += [f"data.gateways={folder / 'gateways.csv'}", f"hydra.run.dir={folder / 'run'}"]
    start = time.perf_counter()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run([sys.executable, "-m", "gaigs", *words, *overrides], check=True)
    seconds = time.perf_counter() - start
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    stages = json.loads((folder / "run" / "metrics.json").read_text())["seconds"]
    stages["start and rest"] = seconds - sum(stages.values())
    return stages | {"all": seconds, "processor": processor, "GB": after.ru_maxrss / 1e6}


def compare_tiles(root):
    """Prints differences of tiled solutions of a Gaussian process from the dense one."""
    links = gaigs.links("nerf2_rssi", root=root)
    model = registry("model").build({"name": "gaussian_process", "trend": None}, scene=links.scene)
    model.fit(links)
    process, test = model.scalar, links.split.test
    known = process.places, process.receivers, process.values
    query, labels = links.query[test], links.labels[test]
    dense = None
    for core, size in ((0, 0), (128, 512), (64, 256), (32, 128)):
        together = 1500 if size else 10**9
        process.options = replace(ScalarProcess.options, together=together)
        process.tiles.core, process.tiles.size = core, size
        process.solve(*known)
        values = model(Batch(query)).value
        dense = values if dense is None else dense
        apart = (values - dense).square().mean().sqrt()
        print(f"{size} {core}: {apart:.3f} dB, MAE {(values - labels).abs().mean():.4f} dB")


def main():
    shape = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=shape)
    parser.add_argument("overrides", nargs="*", metavar="KEY=VALUE", help="of a run")
    parser.add_argument("--places", nargs="+", type=common.positive, default=[1000, 4000])
    parser.add_argument("--gateways", type=common.positive, default=30)
    parser.add_argument("--dense", metavar="DIR", help="folder of ble-flat")
    options = parser.parse_args()
    if options.dense:
        compare_tiles(options.dense)
        return
    found = {}
    for places in sorted(options.places):  # the largest last: memory is the most of all so far
        with tempfile.TemporaryDirectory() as name:
            write_survey(Path(name), places, options.gateways)
            found[places] = measure(Path(name), options.overrides)
    sizes = [*found]
    rows = [["stage [s]", *(f"{size:,} x {options.gateways}" for size in sizes), "exponent"]]
    for stage in found[sizes[-1]]:
        values = [found[size].get(stage, 0.0) for size in sizes]
        exponent = ""
        if len(sizes) > 1 and min(values) > 0 and stage != "GB":
            exponent = f"{math.log(values[-1] / values[0], sizes[-1] / sizes[0]):.2f}"
        rows.append([stage, *(f"{value:.1f}" for value in values), exponent])
    print(markdown(rows))


if __name__ == "__main__":
    main()
