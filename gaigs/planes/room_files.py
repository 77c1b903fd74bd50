"""The learnt room of mirrored Gaussians as tables and files."""

import math
from collections.abc import Sequence
from pathlib import Path

import torch
from numpy import ndarray

from gaigs.core.query import Query
from gaigs.io import meshes
from gaigs.io.files import write_text
from gaigs.io.meshes import Mesh
from gaigs.planes.learnt_room import LearntPlane, other_offset, outline_planes, tabulate_planes
from gaigs.planes.obstacle_surfaces import Sheet
from gaigs.planes.room_paths import TracedPaths, trace_paths
from gaigs.splatting.gaussians import write_ply
from gaigs.splatting.placement.mirrored.paths import Mirrored


def summarize(placement: Mirrored, query: Query) -> dict[str, list]:
    """Tables of the learnt planes and paths, for ``metrics.json``.

    ``planes`` has the strongest plane first. ``paths`` has a row for each number of reflections.
    ``unseen`` has a sentence for each axis along which places do not vary, see ``Scene.flat_axes``.
    Fractions of the received power are averages over the links of the query.
    """
    traced = trace_paths(placement, query)
    facts: dict[str, list] = {
        "planes": _summarize_planes(placement, traced),
        "paths": _summarize_paths(traced),
    }
    unseen = [str(flat) for flat in placement.scene.flat_axes]
    if unseen:
        facts["unseen"] = unseen
    return facts


def _summarize_planes(placement: Mirrored, traced: TracedPaths) -> list[dict]:
    """A row for each plane: position, loss, and fraction of the received power; strongest first."""
    table = tabulate_planes(placement, traced.ends)
    planes = []
    for number, share in traced.plane_shares.items():
        plane = {
            "number": number,
            "normal": [round(part, 4) for part in table.normals[number].tolist()],
            "offset_m": round(table.offsets[number].item(), 4),
            "loss_db": round(table.losses[number].item(), 2),
            "share": round(share, 5),
            "paths": int((traced.sequences == number).any(1).sum()),
        }
        other = other_offset(placement.scene, table, number)
        if other is not None:
            plane["other_offset_m"] = round(other, 4)
        planes.append(plane)
    return planes


def _summarize_paths(traced: TracedPaths) -> list[dict]:
    """A row for 0, 1, ... reflections: number of kept paths, and their fraction of the power."""
    counts = (traced.sequences >= 0).sum(1)
    means = traced.shares.mean(0)
    paths = []
    for bounces in range(traced.sequences.shape[1] + 1):
        chosen = counts == bounces
        share = round(means[chosen].sum().item(), 5)
        paths.append({"bounces": bounces, "kept": int(chosen.sum()), "share": share})
    return paths


@torch.no_grad()
def write_room(placement: Mirrored, query: Query, folder: Path) -> None:
    """Writes ``planes.obj``, with planes cut to their paths, and ``obstacles.ply`` if any."""
    write_text(folder / "planes.obj", wavefront_obj(placement, trace_paths(placement, query)))
    obstacles = placement.obstacles
    if obstacles is None:
        return
    # Obstacles are grey. The opacity is the share of power lost through the middle: the integral of
    # a Gaussian density along a line is density sqrt(2 pi) width, here with the mean width.
    mean_widths = obstacles.widths.log().mean(1).exp()
    depths = obstacles.densities * math.sqrt(2 * math.pi) * mean_widths  # [Np]
    parts = {
        "means": obstacles.centres + placement.middle,
        "quats": torch.tensor([1.0, 0, 0, 0]).expand(len(obstacles), 4),
        "log_scales": obstacles.log_widths,
        # log((1 - t) / t) with t = exp(-2 depth), without a difference of nearly equal numbers.
        "opacity_logits": 2 * depths + torch.log(-torch.expm1(-2 * depths)),
        "signal": torch.zeros(len(obstacles), 3, 1),
    }
    comment = "gaigs: obstacles; places in metres; opacity: share of power lost through the middle"
    write_ply(folder / "obstacles.ply", parts, comment)


def wavefront_obj(placement: Mirrored, traced: TracedPaths, sheets: Sequence[Sheet] = ()) -> str:
    """The text of a Wavefront OBJ file [m], z up, of planes and of obstacles as ``sheets``.

    A plane is one face, counterclockwise as seen from outside.
    """
    table = tabulate_planes(placement, traced.ends)
    planes = outline_planes(placement, traced)
    heading = [
        "Planes learnt by gaigs; coordinates in metres, z up, the world frame of the data.",
        "loss: of a reflection at normal incidence; share: of the plane's paths in the received "
        "power.",
        *map(str, placement.scene.flat_axes),
    ]
    notes = []
    for plane in planes:
        normal = " ".join(f"{part:.4f}" for part in plane.normal)
        offset = f"{table.offsets[plane.number]:.3f} m"
        other = other_offset(placement.scene, table, plane.number)
        if other is not None:
            offset += f" or {other:.3f} m"
        loss = f"{table.losses[plane.number]:.1f} dB"
        share = f"{100 * plane.share:.2f} %"
        notes.append([f"normal {normal}, offset {offset}, loss {loss}", f"share {share}"])
    notes += [[f"loss {sheet.loss_db:.1f} dB"] for sheet in sheets]
    return meshes.wavefront_obj(to_meshes(planes, sheets), heading, notes)


def to_meshes(planes: Sequence[LearntPlane], sheets: Sequence[Sheet]) -> list[Mesh]:
    """Meshes without materials: one face for each plane, and the sheets of obstacles."""
    parts = []
    for plane in planes:
        face = tuple(range(len(plane.corners)))
        parts.append(Mesh(f"plane_{plane.number}", "", _rows(plane.corners), (face,)))
    for number, sheet in enumerate(sheets):
        parts.append(Mesh(f"obstacle_{number}", "", _rows(sheet.vertices), _rows(sheet.faces)))
    return parts


def _rows(array: ndarray) -> tuple:
    """Rows of an array as tuples of numbers."""
    return tuple(map(tuple, array.tolist()))
