"""Learnt obstacles as surfaces: thin sheets around Gaussians of matter, for ray tracers and 3-D
programs.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import ndimage
from skimage.measure import marching_cubes
from torch import Tensor
from torch.nn import functional

from gaigs.core.query import Query
from gaigs.splatting.placement.mirrored.obstacles import Obstacles
from gaigs.splatting.placement.mirrored.paths import Mirrored

DENSITIES = 3
"""Number of densities with sheets: more are more exact, but a ray tracer counts each crossing as an
interaction.
"""

CANDIDATES = 6
"""Densities that are tried."""

FAINTEST = 1e-4
"""Share of a link's power, obstacles apart, from which a path counts."""

LEAST = 0.023
"""Conductance from which a sheet is kept: 0.1 dB at normal incidence."""

SAMPLES = 192
"""Points of a leg at which the density is computed: 5 cm apart on a leg of 10 m."""

PATHS = 20_000
"""Largest number of paths to which sheets are fitted."""

VOXELS = 500_000
"""Points of the grid on which surfaces are found: 6 cm apart in a room of 100 m³."""


class Sheet(NamedTuple):
    """One closed surface of even density of matter, of a material that absorbs and is far thinner
    than the wavelength.

    ``conductance`` is that of a square of it, over free space's. With c the cosine of the angle of
    incidence, the field falls to 1 / (1 + conductance / (2 c)) for TE and to 1 / (1 + c conductance
    / 2) for TM. Its phase does not turn.

    Source: the limit of ITU-R P.2040-3, equation 43b, for a thin slab.
    """

    conductance: float
    vertices: Float[ndarray, "v 3"]
    faces: Int[ndarray, "f 3"]

    @property
    def loss_db(self) -> float:
        """Of a wave that passes it at normal incidence."""
        return 20 / math.log(10) * math.log1p(self.conductance / 2)


class Legs(NamedTuple):
    """Straight pieces of paths, from the middle of the room [m], and the densities of matter along
    them [Np/m].
    """

    start: Float[Tensor, "s 3"]
    along: Float[Tensor, "s 3"]
    paths: Int[Tensor, " s"]
    densities: Float[Tensor, "s k"]


class Crossings(NamedTuple):
    """Points where paths cross surfaces: cosines of incidence, shares of TM, numbers of the paths
    and the surfaces.
    """

    cosines: Float[Tensor, " c"]
    shares: Float[Tensor, " c"]
    paths: Int[Tensor, " c"]
    surfaces: Int[Tensor, " c"]

    def losses(self, conductances: Float[Tensor, " k"], count: int) -> Float[Tensor, " p"]:
        """Attenuation of each path [Np]."""
        own = conductances[self.surfaces]
        te, tm = 1 / (1 + own / (2 * self.cosines)), 1 / (1 + own * self.cosines / 2)
        return te.new_zeros(count).index_add(0, self.paths, -torch.lerp(te, tm, self.shares).log())


@dataclass(frozen=True)
class MatterGrid:
    """Logarithm of the density of matter [Np/m] on a grid over a box and a little beyond.

    ``corner`` is the grid's first point from the middle of the room, ``pitch`` the distance of its
    points [m].
    """

    log_densities: Float[ndarray, "x y z"]
    corner: Float[ndarray, "3"]
    pitch: float

    def surfaces(self, density: float) -> tuple[Int[ndarray, "x y z"], int]:
        """Number of the surface around each point, 0 outside, and how many there are."""
        return ndimage.label(self.log_densities > math.log(density))

    def surface(
        self, density: float, number: int
    ) -> tuple[Float[ndarray, "v 3"], Int[ndarray, "f 3"]]:
        """Corners, from the middle of the room [m], and triangles of one of the ``surfaces``,
        closed by the box.

        Source: Lewiner et al., Efficient implementation of marching cubes' cases with topological
        guarantees, 2003.
        """
        least = math.log(density)
        numbers, _ = self.surfaces(density)
        # Other surfaces lie at least a point apart.
        logs = np.where(
            (numbers == number) | (numbers == 0),
            np.minimum(self.log_densities, least + 9),
            least - 1,
        )
        logs = np.pad(np.maximum(logs, least - 9), 1, constant_values=least - 1)
        vertices, faces, _, _ = marching_cubes(logs, least, spacing=(self.pitch,) * 3)
        return vertices + (self.corner - self.pitch), faces


def densities(obstacles: Obstacles, points: Float[Tensor, "k 3"]) -> Float[Tensor, "k n"]:
    """Density of each Gaussian at points, from the middle of the room [m]; [Np/m], float64."""
    weights, centres, points = (
        (-2 * obstacles.log_widths.double()).exp(),
        obstacles.centres.double(),
        points.double(),
    )
    squares = (
        points.square() @ weights.T
        - 2 * points @ (weights * centres).T
        + (weights * centres.square()).sum(1)
    )
    return (obstacles.log_densities.double() - squares / 2).exp()


def sample(
    obstacles: Obstacles, lower: Float[ndarray, "3"], upper: Float[ndarray, "3"]
) -> MatterGrid:
    """Matter in a box, whose corners are from the middle of the room [m]."""
    pitch = float((np.prod(upper - lower) / VOXELS) ** (1 / 3))
    corner = lower - 2 * pitch
    shape = np.ceil((upper - corner) / pitch).astype(int) + 3
    axes = [torch.from_numpy(corner[axis] + pitch * np.arange(shape[axis])) for axis in range(3)]
    points = torch.cartesian_prod(*axes).to(obstacles.unit.device)
    found = torch.cat([densities(obstacles, part).sum(1) for part in points.split(65536)])
    return MatterGrid(found.log().view(*shape).cpu().numpy(), corner, pitch)


def cross(obstacles: Obstacles, matter: MatterGrid, density: float, legs: Legs) -> Crossings:
    """Crossings of legs with the surfaces of a density, counted from 0."""
    above = legs.densities > density
    leg, step = (above[:, 1:] != above[:, :-1]).nonzero().T
    before, after = legs.densities[leg, step], legs.densities[leg, step + 1]
    unit = legs.along[leg] / (SAMPLES - 1)
    points = legs.start[leg] + (step + (density - before) / (after - before))[:, None] * unit
    own, weights = densities(obstacles, points), (-2 * obstacles.log_widths.double()).exp()
    normals = functional.normalize(
        points * (own @ weights) - own @ (weights * obstacles.centres.double())
    )
    cosines = (normals * functional.normalize(unit)).sum(1).abs().clamp_min(1e-3)
    inside = legs.start[leg] + (step + (after > before))[:, None] * unit
    numbers, _ = matter.surfaces(density)
    numbers = np.where(numbers, numbers, ndimage.grey_dilation(numbers, 3))
    cells = np.rint((inside.cpu().numpy() - matter.corner) / matter.pitch).astype(int)
    found = torch.from_numpy(numbers[tuple(np.clip(cells, 0, np.array(numbers.shape) - 1).T)]).to(
        leg
    )
    kept = found > 0  # the grid has no matter thinner than its pitch
    return Crossings(
        cosines[kept], normals[kept, 2].square(), legs.paths[leg[kept]], found[kept] - 1
    )


@torch.no_grad()
def fit_sheets(
    placement: Mirrored, query: Query, lower: Float[ndarray, "3"], upper: Float[ndarray, "3"]
) -> tuple[list[Sheet], float]:
    """Sheets that attenuate a query's paths most as the obstacles do, and the gain of all paths
    beside them [Np].

    Candidates are densities at which these paths lose their fields. All sets of ``DENSITIES`` are
    fitted, each density with one conductance. In the best set each surface gets a conductance of
    its own. The error is that of a link's fields in decibels, in the mean over links: neither deep
    shadow nor the best links decide. ``lower`` and ``upper`` are corners of the room [m].

    Raises:
        ValueError: No path passes the obstacles.
    """
    obstacles, sequences, middle = (
        placement.obstacles,
        placement.sequences[placement.kept],
        placement.middle,
    )
    if obstacles is None:
        return [], 0.0
    query = query[:: math.ceil(len(query) * len(sequences) / PATHS)].to(middle.device)
    seen, receivers, folded = placement.folded(query)
    fields = placement.strengths(query, folded, blocked=False).abs() / (
        seen[-1] - receivers[:, None]
    ).norm(dim=-1)
    fields, count = fields.double(), fields.numel()
    fields[fields.square() < FAINTEST * fields.square().sum(1, keepdim=True)] = 0
    link, leg = (fields > 0)[:, folded.path].nonzero().T
    paths, start = link * len(sequences) + folded.path[leg], folded.start[link, leg].double()
    along = folded.end[link, leg].double() - start
    depths = obstacles(start.float(), (start + along).float()).real.double()
    left = (-fields.new_zeros(count).index_add(0, paths, depths)).exp().view_as(fields)
    steps = torch.linspace(0, 1, SAMPLES).to(along)[:, None]
    met = torch.stack(
        [densities(obstacles, a + steps * b).sum(1) for a, b in zip(start, along, strict=True)]
    )
    legs = Legs(start, along, paths, met)
    # Each leg's loss, spread over its matter.
    lost = (
        (fields * (1 - left)).flatten()[paths, None]
        * met
        / met.sum(1, keepdim=True).clamp_min(1e-300)
    )
    order = met.flatten().argsort()
    shares = lost.flatten()[order].cumsum(0)
    if not shares[-1] > 0:
        return [], 0.0
    ends = met.flatten()[
        order[torch.searchsorted(shares, shares[-1] * shares.new_tensor([0.1, 0.9]))]
    ]
    low, high = ends.log().tolist()
    options = torch.linspace(low, high, CANDIDATES).exp().tolist()
    matter = sample(obstacles, lower - middle.cpu().numpy(), upper - middle.cpu().numpy())
    crossings = [cross(obstacles, matter, density, legs) for density in options]
    wanted = (fields * left).square().sum(1)
    if not (wanted > 0).any():
        raise ValueError(
            "obstacles absorb every path, so none tells their surfaces; train the model first"
        )

    def error(chosen: Sequence[int], logs: Sequence[Tensor], gain: Tensor) -> Float[Tensor, ""]:
        losses = fields.new_zeros(count)
        for number, log in zip(chosen, logs, strict=True):
            losses = losses + crossings[number].losses(log.exp(), count)
        off = (fields * ((gain - losses).exp().view_as(fields) - left)).square().sum(1)
        return (
            10 * (off[wanted > 0] / wanted[wanted > 0] + 1e-4).log10().mean()
        )  # below -40 dB nothing is gained

    def fit(chosen: Sequence[int], sizes: Sequence[int], start: Tensor) -> tuple[float, Tensor]:
        """Least error [dB]; logarithms of the conductances, and the gain."""
        values = start.clone().requires_grad_()
        descent = torch.optim.LBFGS([values], max_iter=50, line_search_fn="strong_wolfe")

        def own() -> Tensor:
            *logs, gain = values.split((*sizes, 1))
            spread = [
                log.expand(int(crossings[k].surfaces.max()) + 1)
                for k, log in zip(chosen, logs, strict=True)
            ]
            return error(chosen, spread, gain)

        def step() -> Tensor:
            descent.zero_grad()
            found = own()
            found.backward()
            return found

        with torch.enable_grad():
            descent.step(step)
        return own().item(), values.detach()

    heard = [number for number, found in enumerate(crossings) if len(found.paths)]
    size = min(DENSITIES, len(heard))
    trials = {
        some: fit(some, (1,) * size, fields.new_zeros(size + 1))
        for some in itertools.combinations(heard, size)
    }
    chosen = min(trials, key=lambda some: trials[some][0])
    values = trials[chosen][1]
    sizes = [int(crossings[number].surfaces.max()) + 1 for number in chosen]
    start = torch.cat(
        [*(log.expand(size) for log, size in zip(values[:-1], sizes, strict=True)), values[-1:]]
    )
    _, values = fit(chosen, sizes, start)
    sheets = []
    for number, logs in zip(chosen, values[:-1].split(sizes), strict=True):
        for surface, conductance in enumerate(logs.exp().tolist(), 1):
            if conductance < LEAST:
                continue
            vertices, faces = matter.surface(options[number], surface)
            sheets.append(Sheet(conductance, vertices + middle.cpu().numpy(), faces))
    return sheets, values[-1].item()
