"""The room that mirrored Gaussians have learnt: planes, obstacles and paths for tables, figures and other programs."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from gaigs.data import Links
from gaigs.gaussians import write_ply
from gaigs.io.files import write_text
from gaigs.placement.learnt_room import LearntPath, LearntPlane, LearntRoom, Matter
from gaigs.placement.mirrored.paths import Mirrored
from gaigs.placement.mirrored.reflections import fold, images
from gaigs.propagation import fresnel
from gaigs.query import Query
from gaigs.scene import Scene

NEPER = 20 / math.log(10)
"""One neper of a field [dB]."""

SEEN = 0.01
"""Share of a link's power from which a bounce tells how far the room reaches."""

TOLERANCE = 0.02
"""Distance that places may lie behind a wall [diagonals]: places and walls are known to some centimetres."""


class Planes(NamedTuple):
    """All learnt planes; float64.

    Attributes:
        normals: Unit normals, out of the room.
        offsets: Offsets along them, from the world's origin [m].
        losses: Loss of a reflection at normal incidence, in the plane's middle [dB].
        middles: Points where the planes reflect best [m].
        extents: Standard deviations of their windows along the world's axes [m].
    """

    normals: Float[ndarray, "w 3"]
    offsets: Float[ndarray, " w"]
    losses: Float[ndarray, " w"]
    middles: Float[ndarray, "w 3"]
    extents: Float[ndarray, "w 3"]


class Survey(NamedTuple):
    """Powers and courses of the kept paths of some links.

    Attributes:
        sequences: Planes of each kept path.
        powers: Received powers, free space included; 0 where there is no path.
        bounces: Points on the planes of each sequence; NaN in place of a plane [m].
        transmitters, receivers: Ends of the links [m].
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
        """Transmitters and receivers [m]."""
        return np.concatenate((self.transmitters, self.receivers))


def some(query: Query) -> Query:
    """At most 256 of the links, evenly spread."""
    count = len(query)
    return query[torch.linspace(0, count - 1, min(256, count)).long()]


def all_over(scene: Scene) -> Query:
    """Links evenly spread over the training transmitters' box, the receivers and the carriers."""
    number = torch.arange(256)
    shares = torch.quasirandom.SobolEngine(3).draw(len(number)).to(scene.lower)
    known = scene.frequencies
    return Query(
        scene.lower + (scene.upper - scene.lower) * shares,
        number % len(scene.receivers),
        known[number % len(known)] if len(known) else None,
    )


@torch.no_grad()
def survey(placement: Mirrored, query: Query) -> Survey:
    """Powers and courses of the kept paths of some links, before a deformation or a rasterizer changes them."""
    device = placement.sequences.device
    sequences, normals, offsets = placement.sequences[placement.kept], placement.normals, placement.offsets
    positions = placement.scene.positions(normals)
    powers, bounces, receivers = [], [], []
    for part in query.parts(64):  # links at a time
        part = part.to(device)
        powers.append(placement(None, part).gains.abs().square())
        receivers.append(positions[part.receivers])
        seen = images(part.transmitters, sequences, normals, offsets)
        folded = fold(seen, receivers[-1], sequences, normals, offsets)
        points = normals.new_full((len(part), *sequences.shape, 3), torch.nan)
        for back, met in enumerate(folded.bounces, 1):
            points[:, met.first :, -back] = met.points
        bounces.append(points)
    parts = sequences, torch.cat(powers).double(), torch.cat(bounces), query.transmitters, torch.cat(receivers)
    return Survey(*(part.cpu().numpy() for part in parts))


# --- tables ---


def facts(placement: Mirrored, query: Query) -> dict[str, list[dict]]:
    """Tables of planes and paths for ``metrics.json``.

    Args:
        placement: The planes and paths.
        query: Links over which shares of the received power are means.

    Returns:
        ``planes``, the strongest first: number, unit normal out of the room, offset along it from the world's origin
        [m], loss of a reflection at normal incidence [dB], and share of the power and number of the kept paths by way
        of it. ``paths``, by their number of bounces: number kept, and share.
    """
    found = survey(placement, query)
    all_planes = _planes(placement, found)
    shares = _plane_shares(found)
    planes = [
        {
            "number": number,
            "normal": [round(part, 4) for part in all_planes.normals[number].tolist()],
            "offset_m": round(all_planes.offsets[number].item(), 4),
            "loss_db": round(all_planes.losses[number].item(), 2),
            "share": round(shares[number], 5),
            "paths": int((found.sequences == number).any(1).sum()),
        }
        for number in shares
    ]
    counts = (found.sequences >= 0).sum(1)
    means = found.shares.mean(0)
    paths = [
        {
            "bounces": bounces,
            "kept": int((counts == bounces).sum()),
            "share": round(means[counts == bounces].sum().item(), 5),
        }
        for bounces in range(found.sequences.shape[1] + 1)
    ]
    return {"planes": planes, "paths": paths}


@torch.no_grad()
def _planes(placement: Mirrored, found: Survey) -> Planes:
    permittivities = torch.complex(1 + placement.log_permittivities.exp(), -placement.log_conductivities.exp())
    reflected, _ = fresnel(permittivities, torch.ones_like(permittivities.real))
    gains = reflected.abs().log() + placement.plane_gains
    parts = placement.normals, placement.offsets, gains, placement.middles, placement.log_extents.exp()
    normals, offsets, gains, middles, extents = (part.double().cpu().numpy() for part in parts)
    # A window's middle need not lie on its plane: the point of the plane with the least loss, and that loss [Np].
    steep = extents**2 * normals
    spread = (steep * normals).sum(1)
    apart = offsets - (normals * middles).sum(1)
    middles = middles + (apart / spread)[:, None] * steep
    losses = NEPER * (apart**2 / spread / 2 - gains)
    centre = (found.ends.min(0) + found.ends.max(0)) / 2
    signs = np.where(normals @ centre > offsets, -1.0, 1.0)
    return Planes(signs[:, None] * normals, signs * offsets, losses, middles, extents)


def _plane_shares(found: Survey) -> dict[int, float]:
    """Share of the power by way of each used plane, the largest first."""
    means = found.shares.mean(0)
    numbers = np.unique(found.sequences[found.sequences >= 0]).tolist()
    shares = {number: means[(found.sequences == number).any(1)].sum().item() for number in numbers}
    return dict(sorted(shares.items(), key=lambda item: -item[1]))


# --- shapes ---


def outlines(placement: Mirrored, found: Survey) -> list[LearntPlane]:
    """The planes as convex polygons, the strongest first.

    A wall has all transmitters and receivers on one side. It reaches to the other walls, to the edge of its window, or
    to the box around the surveyed points, whichever is nearest. A plane that cuts through the room, as furniture does,
    is the rectangle in which paths bounce off it, within walls and box. Planes that no path meets, or that lie outside
    the box, are left out.
    """
    normals, offsets, _, middles, extents = _planes(placement, found)
    shares = _plane_shares(found)
    weights = found.shares
    seen = np.concatenate((found.ends, found.bounces[weights >= SEEN].reshape(-1, 3)))
    seen = seen[~np.isnan(seen).any(1)]
    lower, upper = seen.min(0), seen.max(0)
    diagonal = np.linalg.norm(upper - lower)
    box = _sides(lower - 0.1 * diagonal, upper + 0.1 * diagonal)  # so large that planes meet within it
    walls = [k for k in shares if (found.ends @ normals[k] - offsets[k] <= TOLERANCE * diagonal).all()]
    drawn = []
    for number, share in shares.items():
        normal, offset = normals[number], offsets[number]
        link, path, step = np.nonzero((found.sequences == number) & (weights > 0)[..., None])
        if not len(link):
            continue
        basis = _basis(normal)
        # Walls that face the same way, such as one behind another, do not cut each other.
        sides = box + [(normals[k], offsets[k]) for k in walls if k != number and normals[k] @ normal < 0.9]
        if number in walls:
            middle = (lower + upper) / 2
            middle = middle - (middle @ normal - offset) * normal
            corners = _rectangle(middle, basis, np.full(2, -2 * diagonal), np.full(2, 2 * diagonal))
            edge = 2 * extents[number]  # there it reflects 17 dB less than in its middle
            sides += _sides(middles[number] - edge, middles[number] + edge)
        else:
            own = weights[link, path]
            points = found.bounces[link, path, step][own >= SEEN * own.max()]
            flat = (points - offset * normal) @ basis
            rim = TOLERANCE * diagonal
            corners = _rectangle(offset * normal, basis, flat.min(0) - rim, flat.max(0) + rim)
        for side in sides:
            corners = _cut(corners, *side)
        if len(corners):
            drawn.append(LearntPlane(number, corners, normal, share))
    return drawn


def _sides(lower: Float[ndarray, "3"], upper: Float[ndarray, "3"]) -> list[tuple[Float[ndarray, "3"], float]]:
    """A box as six planes: normals outwards, and offsets [m]."""
    axes = np.eye(3)
    return [*zip(axes, upper, strict=True), *zip(-axes, -lower, strict=True)]


def _basis(normal: Float[ndarray, "3"]) -> Float[ndarray, "3 2"]:
    """Two unit vectors of a plane, which with its normal are right-handed; the first is level."""
    level = np.cross((0.0, 0.0, 1.0), normal)
    length = np.linalg.norm(level)
    level = level / length if length > 1e-6 else np.array([1.0, 0.0, 0.0])  # of floor and ceiling any is level
    return np.stack((level, np.cross(normal, level)), 1)


def _rectangle(origin, basis, low, high) -> Float[ndarray, "4 3"]:
    """Corners, counterclockwise against the normal."""
    flat = np.array([(low[0], low[1]), (high[0], low[1]), (high[0], high[1]), (low[0], high[1])])
    return origin + flat @ basis.T


def _cut(corners: Float[ndarray, "c 3"], normal: Float[ndarray, "3"], offset: float) -> Float[ndarray, "k 3"]:
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
def learnt_room(placement: Mirrored, links: Links) -> LearntRoom:
    """The room by the training links, and the strongest paths of the first test transmitter, for figures."""
    found = survey(placement, some(links.query[links.split.train]))
    test = links.query[links.split.test]
    first = (test.transmitters == test.transmitters[:1]).all(1)
    if test.frequencies is not None:
        first &= test.frequencies == test.frequencies[:1]
    matter = None
    if placement.obstacles is not None:
        blobs = placement.obstacles
        parts = blobs.centres, blobs.widths, NEPER * blobs.densities
        matter = Matter(*(part.cpu().double().numpy() for part in parts))
    return LearntRoom(outlines(placement, found), matter, strongest(survey(placement, test[first])))


def strongest(found: Survey) -> list[LearntPath]:
    """The strongest paths of all links, at most 20, and within 30 dB of the strongest."""
    powers = found.powers / found.powers.max(initial=np.finfo(float).tiny)
    order = np.argsort(-powers, axis=None)[:20]
    paths = []
    for link, path in zip(*np.unravel_index(order, powers.shape), strict=True):
        if powers[link, path] < 1e-3:
            break
        bounces = found.bounces[link, path][found.sequences[path] >= 0]
        points = np.concatenate((found.transmitters[link, None], bounces, found.receivers[link, None]))
        paths.append(LearntPath(points, 10 * math.log10(powers[link, path])))
    return paths


# --- files ---


def export(placement: Mirrored, query: Query, folder: Path) -> None:
    """Writes ``planes.obj``, and ``obstacles.ply`` where there are obstacles.

    Args:
        placement: The planes and obstacles.
        query: Links whose paths tell how far planes reach.
        folder: Folder of the files.
    """
    found = survey(placement, query)
    write_text(folder / "planes.obj", wavefront_obj(placement, found))
    if placement.obstacles is not None:
        save_obstacles(placement, folder / "obstacles.ply")


def wavefront_obj(placement: Mirrored, found: Survey) -> str:
    """The planes as a Wavefront OBJ file [m]: an object of one face each, counterclockwise as seen from outside."""
    planes = _planes(placement, found)
    lines = [
        "# Planes learnt by gaigs; coordinates in metres, z up, the world frame of the data.",
        "# loss: of a reflection at normal incidence; share: of the received power that comes by way of the plane.",
    ]
    count = 0
    for plane in outlines(placement, found):
        k = plane.number
        normal = " ".join(f"{part:.4f}" for part in plane.normal)
        lines += [
            f"# normal {normal}, offset {planes.offsets[k]:.3f} m, loss {planes.losses[k]:.1f} dB",
            f"# share {100 * plane.share:.2f} %",
            f"o plane_{k}",
            *("v " + " ".join(f"{part:.4f}" for part in corner) for corner in plane.corners),
            "f " + " ".join(str(count + corner + 1) for corner in range(len(plane.corners))),
        ]
        count += len(plane.corners)
    return "\n".join(lines) + "\n"


@torch.no_grad()
def save_obstacles(placement: Mirrored, path: Path) -> None:
    """Writes the obstacles as a .ply for viewers of 3-D Gaussian splatting.

    They are grey, and as opaque as the share of power lost through the middle of an obstacle of its mean width.
    """
    blobs = placement.obstacles
    depths = blobs.densities * math.sqrt(2 * math.pi) * blobs.widths.log().mean(1).exp()
    # log((1 - t) / t) with t = exp(-2 depth), without the difference that would lose all digits of a faint one.
    logits = 2 * depths + torch.log(-torch.expm1(-2 * depths))
    parts = {
        "means": blobs.centres,
        "quats": torch.tensor([1.0, 0, 0, 0]).expand(len(blobs), 4),
        "log_scales": blobs.log_widths,
        "opacity_logits": logits,
        "signal": torch.zeros(len(blobs), 3, 1),
    }
    write_ply(path, parts, "gaigs: obstacles; places in metres; opacity: share of power lost through the middle")
