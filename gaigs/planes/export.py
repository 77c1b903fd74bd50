"""The learnt room of mirrored Gaussians: tables, figures and files of planes, obstacles and paths."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from gaigs.core.propagation import fresnel
from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.io import meshes
from gaigs.io.files import write_text
from gaigs.io.meshes import Mesh
from gaigs.planes.learnt_room import LearntPath, LearntPlane, LearntRoom, Matter
from gaigs.planes.sheets import Sheet
from gaigs.splatting.gaussians import write_ply
from gaigs.splatting.placement.mirrored.paths import Mirrored

NEPER = 20 / math.log(10)
"""One neper of a field [dB]."""

SEEN = 0.01
"""Share of a link's power from which a bounce counts as a point of its plane."""

TOLERANCE = 0.02
"""Distance that places may lie behind a wall [diagonals], since places and walls are uncertain."""


class Planes(NamedTuple):
    """All learnt planes: unit normals out of the room, offsets from the world's origin [m];
    float64.

    ``losses`` are the least losses of a reflection at normal incidence [dB], ``middles`` the points
    with them [m], ``extents`` the standard deviations of the reflecting areas along the world's
    axes [m].
    """

    normals: Float[ndarray, "w 3"]
    offsets: Float[ndarray, " w"]
    losses: Float[ndarray, " w"]
    middles: Float[ndarray, "w 3"]
    extents: Float[ndarray, "w 3"]


class TracedPaths(NamedTuple):
    """Powers and bounces of the kept paths of some links.

    ``powers`` include free space, 0 for no path; ``bounces`` are points on the planes of each
    sequence, NaN for a missing plane [m].
    """

    sequences: Int[ndarray, "n order"]
    powers: Float[ndarray, "b n"]
    bounces: Float[ndarray, "b n order 3"]
    transmitters: Float[ndarray, "b 3"]
    receivers: Float[ndarray, "b 3"]

    @property
    def shares(self) -> Float[ndarray, "b n"]:
        """Share of each path in its link's power; 0 for a link without power."""
        total = self.powers.sum(1, keepdims=True)
        return self.powers / np.where(total > 0, total, 1)

    @property
    def ends(self) -> Float[ndarray, "k 3"]:
        return np.concatenate((self.transmitters, self.receivers))


def some(query: Query) -> Query:
    """At most 256 of the links, evenly spread."""
    count = len(query)
    return query[torch.linspace(0, count - 1, min(256, count)).long()]


def all_over(scene: Scene) -> Query:
    """Links evenly spread over the training transmitters' box, the receivers and the carriers."""
    number = torch.arange(256)
    shares = torch.quasirandom.SobolEngine(3).draw(len(number)).to(scene.lower)
    carriers = (
        scene.frequencies[number % len(scene.frequencies)] if len(scene.frequencies) else None
    )
    return Query(
        scene.lower + (scene.upper - scene.lower) * shares, number % len(scene.receivers), carriers
    )


@torch.no_grad()
def trace_paths(placement: Mirrored, query: Query) -> TracedPaths:
    """Powers and bounces of the kept paths of some links, without a deformation."""
    device = placement.sequences.device
    sequences = placement.sequences[placement.kept]
    powers, bounces, receivers = [], [], []
    for part in query.parts(64):  # links at a time
        part = part.to(device)
        powers.append(placement(None, part).gains.abs().square())
        _, stands, folded = placement.folded(part)
        receivers.append(placement.scene.positions(stands)[part.receivers])
        points = stands.new_full((len(part), *sequences.shape, 3), torch.nan)
        for back, (first, met) in enumerate(folded.parts(folded.bounces), 1):
            points[:, first:, -back] = met + placement.middle
        bounces.append(points)
    parts = (
        sequences,
        torch.cat(powers).double(),
        torch.cat(bounces),
        query.transmitters,
        torch.cat(receivers),
    )
    return TracedPaths(*(part.cpu().numpy() for part in parts))


def facts(placement: Mirrored, query: Query) -> dict[str, list]:
    """Tables of planes, strongest first, and of paths by their number of bounces, for
    ``metrics.json``.

    ``unseen`` has a sentence for each axis that places do not span, see ``Scene.flat_axes``.

    Shares are those of the kept paths in the received power, means over the links of the query.
    """
    found = trace_paths(placement, query)
    all_planes = _planes(placement, found)
    shares = _plane_shares(found)
    planes = [
        {
            "number": number,
            "normal": [round(part, 4) for part in all_planes.normals[number].tolist()],
            "offset_m": round(all_planes.offsets[number].item(), 4),
            "loss_db": round(all_planes.losses[number].item(), 2),
            "share": round(share, 5),
            "paths": int((found.sequences == number).any(1).sum()),
        }
        for number, share in shares.items()
    ]
    for plane in planes:
        other = other_offset(placement.scene, all_planes, plane["number"])
        if other is not None:
            plane["other_offset_m"] = round(other, 4)
    counts = (found.sequences >= 0).sum(1)
    means = found.shares.mean(0)
    paths = []
    for bounces in range(found.sequences.shape[1] + 1):
        own = counts == bounces
        paths.append(
            {"bounces": bounces, "kept": int(own.sum()), "share": round(means[own].sum().item(), 5)}
        )
    unseen = [str(flat) for flat in placement.scene.flat_axes]
    return {"planes": planes, "paths": paths} | ({"unseen": unseen} if unseen else {})


def other_offset(scene: Scene, planes: Planes, number: int) -> float | None:
    """Offset at which a plane would reflect paths of the same lengths [m]; None without one, see
    ``FlatAxis``.
    """
    normal = planes.normals[number]
    for flat in scene.flat_axes:
        if abs(normal[flat.axis]) > 0.99:
            return float(
                normal[flat.axis] * (flat.transmitters + flat.receivers) - planes.offsets[number]
            )
    return None


@torch.no_grad()
def _planes(placement: Mirrored, found: TracedPaths) -> Planes:
    permittivities = torch.complex(
        1 + placement.log_permittivities.exp(), -placement.log_conductivities.exp()
    )
    reflected, _ = fresnel(permittivities, torch.ones_like(permittivities.real))
    gains = reflected.abs().log() + placement.plane_gains
    middles = placement.middles + placement.middle.double()
    parts = placement.normals, placement.planes[:, 3], gains, middles, placement.log_extents.exp()
    normals, offsets, gains, middles, extents = (part.double().cpu().numpy() for part in parts)
    # The middle of the reflecting area need not lie on the plane: take the plane's point with the
    # least loss.
    steep = extents**2 * normals
    spread = (steep * normals).sum(1)
    apart = offsets - (normals * middles).sum(1)
    middles = middles + (apart / spread)[:, None] * steep
    losses = NEPER * (apart**2 / spread / 2 - gains)
    centre = (found.ends.min(0) + found.ends.max(0)) / 2
    signs = np.where(normals @ centre > offsets, -1.0, 1.0)
    return Planes(signs[:, None] * normals, signs * offsets, losses, middles, extents)


def _plane_shares(found: TracedPaths) -> dict[int, float]:
    """Share of each used plane's paths in the power, largest first."""
    means = found.shares.mean(0)
    numbers = np.unique(found.sequences[found.sequences >= 0]).tolist()
    shares = {number: means[(found.sequences == number).any(1)].sum().item() for number in numbers}
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


def outlines(placement: Mirrored, found: TracedPaths) -> list[LearntPlane]:
    """The planes as convex polygons, strongest first.

    A wall has all transmitters and receivers on one side. It reaches to the other walls, to the
    edge of its reflecting area, or to the box around the paths' ends, whichever is nearest. Any
    other plane, such as furniture, is the rectangle around its bounces, within walls and box.
    Planes without paths, or outside the box, are left out.
    """
    normals, offsets, _, middles, extents = _planes(placement, found)
    shares = _plane_shares(found)
    weights = found.shares
    seen = np.concatenate((found.ends, found.bounces[weights >= SEEN].reshape(-1, 3)))
    seen = seen[~np.isnan(seen).any(1)]
    lower, upper = seen.min(0), seen.max(0)
    diagonal = np.linalg.norm(upper - lower)
    box = _sides(
        lower - 0.1 * diagonal, upper + 0.1 * diagonal
    )  # so large that planes meet within it
    walls = [
        k for k in shares if (found.ends @ normals[k] - offsets[k] <= TOLERANCE * diagonal).all()
    ]
    drawn = []
    for number, share in shares.items():
        normal, offset = normals[number], offsets[number]
        link, path, step = np.nonzero((found.sequences == number) & (weights > 0)[..., None])
        if not len(link):
            continue
        # Two unit vectors of the plane, right-handed with its normal; the first is level.
        level = np.cross((0.0, 0.0, 1.0), normal)
        length = np.linalg.norm(level)
        level = level / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])
        basis = np.stack((level, np.cross(normal, level)), 1)
        # Walls that face the same way, such as one behind another, do not cut each other.
        sides = box + [
            (normals[k], offsets[k]) for k in walls if k != number and normals[k] @ normal < 0.9
        ]
        if number in walls:
            middle = (lower + upper) / 2
            middle = middle - (middle @ normal - offset) * normal
            low, high = np.full(2, -2 * diagonal), np.full(2, 2 * diagonal)
            edge = 2 * extents[number]  # there it reflects 17 dB less than in its middle
            sides += _sides(middles[number] - edge, middles[number] + edge)
        else:
            own = weights[link, path]
            points = found.bounces[link, path, step][own >= SEEN * own.max()]
            middle = offset * normal
            flat = (points - middle) @ basis
            low, high = flat.min(0) - TOLERANCE * diagonal, flat.max(0) + TOLERANCE * diagonal
        # Counterclockwise against the normal.
        flat = np.array(
            [(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])]
        )
        corners = middle + flat @ basis.T
        for side in sides:
            corners = _cut(corners, *side)
        if len(corners):
            drawn.append(LearntPlane(number, corners, normal, share))
    return drawn


def _sides(
    lower: Float[ndarray, "3"], upper: Float[ndarray, "3"]
) -> list[tuple[Float[ndarray, "3"], np.floating]]:
    """A box as six planes: normals outwards, and offsets [m]."""
    axes = np.eye(3)
    return [*zip(axes, upper, strict=True), *zip(-axes, -lower, strict=True)]


def _cut(
    corners: Float[ndarray, "c 3"], normal: Float[ndarray, "3"], offset: np.floating
) -> Float[ndarray, "k 3"]:
    """The part of a convex polygon with normal . x <= offset.

    Source: Sutherland and Hodgman, Reentrant polygon clipping, 1974.
    """
    heights = corners @ normal - offset
    kept = []
    for k in range(len(corners)):
        here, there = corners[k - 1], corners[k]
        above, below = heights[k - 1], heights[k]
        if (above > 0) != (below > 0):
            kept.append(here + above / (above - below) * (there - here))
        if below <= 0:
            kept.append(there)
    return np.array(kept).reshape(-1, 3)


@torch.no_grad()
def learnt_room(placement: Mirrored, links: Links | None = None) -> LearntRoom:
    """The room by the training links, and the strongest paths of the first test transmitter, for
    figures.

    Without links it is the room by links ``all_over`` the scene, without paths.
    """
    found = trace_paths(
        placement,
        all_over(placement.scene) if links is None else some(links.query[links.split.train]),
    )
    matter = None
    if placement.obstacles is not None:
        blobs = placement.obstacles
        parts = blobs.centres + placement.middle, blobs.widths, NEPER * blobs.densities
        matter = Matter(*(part.cpu().double().numpy() for part in parts))
    paths: list[LearntPath] = []
    if links is not None:
        test = links.query[links.split.test]
        first = (test.transmitters == test.transmitters[:1]).all(1)
        if test.frequencies is not None:
            first &= test.frequencies == test.frequencies[:1]
        paths = learnt_paths(placement, test[first])
    return LearntRoom(outlines(placement, found), matter, paths)


def learnt_paths(placement: Mirrored, query: Query) -> list[LearntPath]:
    """At most 20 paths of some links together, within 30 dB of the strongest, which comes first."""
    heard = trace_paths(placement, query)
    powers = heard.powers / heard.powers.max(initial=np.finfo(float).tiny)
    paths = []
    for link, path in zip(
        *np.unravel_index(np.argsort(-powers, axis=None)[:20], powers.shape), strict=True
    ):
        if powers[link, path] >= 1e-3:
            bounces = heard.bounces[link, path][heard.sequences[path] >= 0]
            points = np.concatenate(
                (heard.transmitters[link, None], bounces, heard.receivers[link, None])
            )
            paths.append(LearntPath(points, 10 * math.log10(powers[link, path])))
    return paths


@torch.no_grad()
def export(placement: Mirrored, query: Query, folder: Path) -> None:
    """Writes ``planes.obj``, the planes as far as the query's paths reach, and ``obstacles.ply``
    for any obstacles.
    """
    write_text(folder / "planes.obj", wavefront_obj(placement, trace_paths(placement, query)))
    blobs = placement.obstacles
    if blobs is None:
        return
    # Grey, and as opaque as the share of power lost through the middle of an obstacle of its mean
    # width.
    depths = blobs.densities * math.sqrt(2 * math.pi) * blobs.widths.log().mean(1).exp()
    parts = {
        "means": blobs.centres + placement.middle,
        "quats": torch.tensor([1.0, 0, 0, 0]).expand(len(blobs), 4),
        "log_scales": blobs.log_widths,
        # log((1 - t) / t) with t = exp(-2 depth), without a difference of nearly equal numbers.
        "opacity_logits": 2 * depths + torch.log(-torch.expm1(-2 * depths)),
        "signal": torch.zeros(len(blobs), 3, 1),
    }
    comment = "gaigs: obstacles; places in metres; opacity: share of power lost through the middle"
    write_ply(folder / "obstacles.ply", parts, comment)


def wavefront_obj(placement: Mirrored, found: TracedPaths, sheets: Sequence[Sheet] = ()) -> str:
    """The planes, and sheets of obstacles, as objects of a Wavefront OBJ file [m].

    A plane is one face, counterclockwise as seen from outside.
    """
    planes = _planes(placement, found)
    drawn = outlines(placement, found)
    heading = [
        "Planes learnt by gaigs; coordinates in metres, z up, the world frame of the data.",
        "loss: of a reflection at normal incidence; share: of the plane's paths in the received "
        "power.",
        *map(str, placement.scene.flat_axes),
    ]
    notes = []
    for plane in drawn:
        normal = " ".join(f"{part:.4f}" for part in plane.normal)
        offset = f"{planes.offsets[plane.number]:.3f} m"
        other = other_offset(placement.scene, planes, plane.number)
        if other is not None:
            offset += f" or {other:.3f} m"
        loss = f"{planes.losses[plane.number]:.1f} dB"
        notes.append(
            [f"normal {normal}, offset {offset}, loss {loss}", f"share {100 * plane.share:.2f} %"]
        )
    notes += [[f"loss {sheet.loss_db:.1f} dB"] for sheet in sheets]
    return meshes.wavefront_obj(to_meshes(drawn, sheets), heading, notes)


def to_meshes(planes: Sequence[LearntPlane], sheets: Sequence[Sheet]) -> list[Mesh]:
    """Planes, a face each, and sheets of obstacles as meshes without materials."""
    parts = []
    for plane in planes:
        face = tuple(range(len(plane.corners)))
        parts.append(Mesh(f"plane_{plane.number}", "", _rows(plane.corners), (face,)))
    for number, sheet in enumerate(sheets):
        parts.append(Mesh(f"obstacle_{number}", "", _rows(sheet.vertices), _rows(sheet.faces)))
    return parts


def _rows(array: ndarray) -> tuple:
    return tuple(map(tuple, array.tolist()))
