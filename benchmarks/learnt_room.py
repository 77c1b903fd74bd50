"""Channels that Sionna RT traces in a learnt room, beside the model's and the measured ones.

    python benchmarks/learnt_room.py            trains +experiment=mirrored_csi in runs/learnt_room
    python benchmarks/learnt_room.py runs/room  a finished run of channels by mirrored Gaussians

The room is exported as a scene of Mitsuba, loaded by Sionna RT, and traced at the test places, with as many reflections
as the model has. Furniture is no part of the scene: the model knows it as Gaussians of matter. So traced channels are
compared with the model's without them, and also after the attenuation by them along each traced path. Each receiver's
traced channels have one complex gain, ``fit_gain`` to what they are compared with: the model's own gain of a receiver
makes up for the mean attenuation by its obstacles. Two rows are without it. Prints tables in Markdown. Needs
gaigs[sionna].
"""

import copy
import sys
import tempfile
from pathlib import Path

import torch
from jaxtyping import Complex, Float
from torch import Tensor

import gaigs
from gaigs.data import Links
from gaigs.data.sionna.tracing import open_scene, respond, trace_scene
from gaigs.data.synthetic.image_source import Paths
from gaigs.model.kriging import Kriging
from gaigs.placement.mirrored.export import facts
from gaigs.placement.mirrored.materials import materials
from gaigs.placement.mirrored.paths import Mirrored
from gaigs.placement.mirrored.reflections import fold, images
from gaigs.propagation import fit_gain
from gaigs.query import Query
from gaigs.report.table import markdown
from gaigs.runs import links_of, model_of

FOLDER = Path("runs/learnt_room")


def trace(file: Path, links: Links, query: Query, order: int) -> list[Paths]:
    """Paths in an exported scene from the transmitters of a query, by receiver."""
    scene = open_scene(float(links.scene.frequencies[0]), file)
    places = [receiver.pose.position for receiver in links.receivers]
    return [
        trace_scene(scene, place, query.transmitters[query.receivers == k], order) for k, place in enumerate(places)
    ]


def depths(placement: Mirrored, paths: Paths, query: Query) -> Float[Tensor, "b p"]:
    """Optical depth of the learnt obstacles along traced paths; the image of a path tells its planes."""
    sequences = placement.sequences[torch.isin(placement.sequences, placement.used).eq(placement.sequences >= 0).all(1)]
    normals, offsets = placement.normals, placement.offsets
    seen = images(query.transmitters - placement.middle, sequences, normals, offsets)
    receivers = (placement.scene.positions(normals) - placement.middle)[query.receivers]
    folded = fold(seen, receivers, sequences, normals, offsets)
    legs = placement.obstacles(folded.start.flatten(0, 1), folded.end.flatten(0, 1)).view(len(query), -1)
    found = torch.zeros(len(query), len(sequences)).index_add(1, folded.path, legs)
    apart = torch.cdist(paths.images.float(), seen[-1] + placement.middle) + 1e3 * ~folded.exists[:, None]
    return found.gather(1, apart.argmin(2))


def fitted(
    channels: Complex[Tensor, "b e s"], others: Complex[Tensor, "b e s"], query: Query
) -> Complex[Tensor, "b e s"]:
    """Channels with one gain for each receiver, that over other channels."""
    found = channels.clone()
    for own in (query.receivers == receiver for receiver in query.receivers.unique()):
        found[own] *= fit_gain(others[own], found[own])
    return found.to(others.dtype)


@torch.no_grad()
def main(folder: Path) -> None:
    if not (folder / "metrics.json").is_file():
        gaigs.run(gaigs.compose("+experiment=mirrored_csi"), folder)
    model, links = model_of(folder), links_of(folder)
    own = model.trend if isinstance(model, Kriging) else model
    placement, query, carrier = own.placement, links.query[links.split.test], float(links.scene.frequencies[0])
    lines = [("plane", "normal", "offset [m]", "share of the power", "material", "slab")]
    chosen = materials(placement, own.surveyed, carrier)
    for plane in facts(placement, own.surveyed)["planes"]:
        material, thickness = chosen[plane["number"]]
        normal = " ".join(f"{part:.2f}" for part in plane["normal"])
        slab = f"{1e3 * thickness:.3g} mm" if thickness < 1 else "half-space"
        lines.append(
            (f"{plane['number']}", normal, f"{plane['offset_m']:.3f}", f"{plane['share']:.3f}", material, slab)
        )
    print(markdown(lines) + "\n")
    with tempfile.TemporaryDirectory() as scratch:
        gaigs.export(model, f"{scratch}/room.xml")
        paths = trace(Path(scratch) / "room.xml", links, query, placement.order)
    offsets = links.task.frequencies - carrier
    traced = torch.zeros(len(query), *links.task.shape, dtype=torch.complex128)
    dimmed = traced.clone()
    for k, (receiver, found) in enumerate(zip(links.receivers, paths, strict=True)):
        rows, count = query.receivers == k, len(receiver.array)
        lost = depths(placement, found, query[rows])
        traced[rows, :count] = respond(found, receiver, carrier, offsets)
        dimmed[rows, :count] = respond(
            Paths(found.images, found.gains * (-lost.double()).exp()), receiver, carrier, offsets
        )
    if own.pooling.array_sign > 0:  # the data's time dependence is exp(-j omega t)
        traced, dimmed = traced.conj(), dimmed.conj()
    bare = copy.deepcopy(own)
    bare.placement.obstacles = None
    measured, plain, walls = links.labels[links.split.test], own.predict(query), bare.predict(query)
    rows = [
        ("the model", "measured", model.predict(query), measured),
        ("the model without kriging", "measured", plain, measured),
        ("traced", "measured", fitted(traced, measured, query), measured),
        ("traced", "the model without kriging", fitted(traced, plain, query), plain),
        ("traced", "the model without kriging and obstacles", fitted(traced, walls, query), walls),
        ("traced, with the learnt obstacles", "the model without kriging", fitted(dimmed, plain, query), plain),
        ("traced, with the learnt obstacles", "measured", fitted(dimmed, measured, query), measured),
        ("traced, no gain", "the model without kriging and obstacles", traced.to(walls.dtype), walls),
        ("traced, no gain, with the learnt obstacles", "the model without kriging", dimmed.to(plain.dtype), plain),
    ]
    lines = [("channels", "against", "median SNR [dB]", "mean SINAD [dB]", "NMSE [dB]")]
    for name, other, values, labels in rows:
        numbers = links.task.summarise(links.task.scores(labels, values))
        keys = f"{links.task.compared_by}_median", "sinad_db_mean", "nmse_db"
        lines.append((name, other, *(f"{numbers[key]:.1f}" for key in keys)))
    print(f"split {links.split.name}, {len(query)} links\n\n{markdown(lines)}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else FOLDER)
