"""Channels that Sionna RT traces in a learnt room, beside the model's and the measured ones.

    python benchmarks/learnt_room.py            trains +experiment=mirrored_csi in runs/learnt_room
    python benchmarks/learnt_room.py runs/room  a finished run of channels by mirrored Gaussians

The room is exported as a scene of Mitsuba, loaded by Sionna RT, and traced at the test places, with
as many reflections as the model's paths have and up to ``DEPTH`` crossings of furniture. Each
receiver's channels have the gain that stands in the scene's file; nothing is fitted to the links
that are compared. Prints tables in Markdown. Needs sionna-rt.
"""

import cmath
import math
import re
import sys
import tempfile
from pathlib import Path

import torch
from common import words
from jaxtyping import Complex
from torch import Tensor

import gaigs
from gaigs.core.query import Query
from gaigs.data import Links
from gaigs.data.synthetic.image_source import respond
from gaigs.model.kriging import Kriging
from gaigs.planes.materials import materials
from gaigs.planes.room_files import summarize
from gaigs.report.table import markdown
from gaigs.runs import links_of, load

sys.path.append(str(Path(__file__).parents[1] / "plugins/sionna"))  # the plug-in
from gaigs_sionna.tracing import open_scene, trace_scene

FOLDER = Path("runs/learnt_room")

DEPTH = 6
"""Largest number of crossings of a path. Fewer leave paths out, and with many more Sionna RT misses
strong ones.
"""

TOGETHER = 2
"""Transmitters traced at a time: chains of surfaces to all of them share a table, in which some
displace others.
"""


def trace(file: Path, links: Links, query: Query, order: int) -> Complex[Tensor, "b e s"]:
    """Channels in an exported scene from the transmitters of a query."""
    carrier = float(links.scene.frequencies[0])
    scene, offsets = open_scene(carrier, file), links.task.frequencies - carrier
    gains = re.findall(
        r"those traced times (\S+), turned by (\S+) degrees", file.read_text(encoding="utf-8")
    )
    found = torch.zeros(len(query), *links.task.shape, dtype=torch.complex128)
    for k, (receiver, (size, turn)) in enumerate(zip(links.receivers, gains, strict=True)):
        gain = cmath.rect(float(size), math.radians(float(turn)))
        rows = (query.receivers == k).nonzero()[:, 0]
        for own in rows.split(TOGETHER):
            paths = trace_scene(
                scene, receiver.pose.position, query.transmitters[own], order + DEPTH, order
            )
            found[own, : len(receiver.array)] = gain * respond(paths, receiver, carrier, offsets)
    return found


@torch.no_grad()
def main(folder: Path) -> None:
    if not (folder / "metrics.json").is_file():
        gaigs.run(gaigs.compose("+experiment=mirrored_csi"), folder)
    model, links = load(folder), links_of(folder)
    own = model.trend if isinstance(model, Kriging) else model
    placement, query, carrier = (
        own.placement,
        links.query[links.split.test],
        float(links.scene.frequencies[0]),
    )
    bounces = int((placement.sequences[placement.kept] >= 0).sum(1).max())
    lines = [("plane", "normal", "offset [m]", "share of the power", "material", "slab")]
    chosen = materials(placement, own.traced, carrier)
    for plane in summarize(placement, own.traced)["planes"]:
        material, thickness = chosen[plane["number"]]
        normal = " ".join(f"{part:.2f}" for part in plane["normal"])
        slab = f"{1e3 * thickness:.3g} mm" if thickness < 1 else "half-space"
        lines.append(
            (
                f"{plane['number']}",
                normal,
                f"{plane['offset_m']:.3f}",
                f"{plane['share']:.3f}",
                material,
                slab,
            )
        )
    print(markdown(lines) + "\n")
    with tempfile.TemporaryDirectory() as scratch:
        gaigs.export(model, f"{scratch}/room.xml")
        traced = trace(Path(scratch) / "room.xml", links, query, bounces)
    if own.pooling.array_sign > 0:  # the data's time dependence is exp(-j omega t)
        traced = traced.conj()
    measured, plain = links.labels[links.split.test], own.predict(query)
    rows = [
        ("the model", "measured", model.predict(query), measured),
        ("the model without kriging", "measured", plain, measured),
        ("traced", "measured", traced.to(measured.dtype), measured),
        ("traced", "the model without kriging", traced.to(plain.dtype), plain),
    ]
    lines = [("channels", "against", "median SNR [dB]", "mean SINAD [dB]", "NMSE [dB]")]
    for name, other, values, labels in rows:
        numbers = links.task.summarise(links.task.scores(labels, values))
        keys = f"{links.task.compared_by}_median", "sinad_db_mean", "nmse_db"
        lines.append((name, other, *(f"{numbers[key]:.1f}" for key in keys)))
    print(f"split {links.split.name}, {len(query)} links\n\n{markdown(lines)}")


if __name__ == "__main__":
    main(*map(Path, words(__doc__, "FOLDER")[:1] or [FOLDER]))
