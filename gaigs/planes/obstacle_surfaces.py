"""Surfaces of learnt obstacles, for ray tracers and 3-D programs.

A sheet is a thin absorbing surface around matter, through points of equal density. Sheets replace
learnt obstacles in programs that only know surfaces.
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


@dataclass(frozen=True)
class SurfaceOptions:
    """Options of the fit of sheets, thin absorbing surfaces that replace obstacles."""

    # Number of densities with sheets: more are more exact, but a ray tracer counts each crossing as
    # an interaction.
    densities: int = 3
    candidates: int = 6  # densities that are tried
    faint: float = 1e-4  # share of a link's power, obstacles apart, from which a path counts
    # Conductance from which a sheet is used: 0.1 dB at normal incidence.
    least_conductance: float = 0.023
    # Points of a leg at which the density is computed: 5 cm apart on a leg of 10 m.
    samples: int = 192
    paths: int = 20_000  # largest number of paths to which sheets are fitted
    # Points of the grid on which surfaces are found: 6 cm apart in a room of 100 m³.
    voxels: int = 500_000


class Sheet(NamedTuple):
    """A closed surface of equal density of matter, as a thin absorbing material.

    The sheet is much thinner than the wavelength. ``conductance`` is relative to the admittance of
    free space. With c the cosine of the angle of incidence, the field falls to 1 / (1 + conductance
    / (2 c)) for TE and to 1 / (1 + c conductance / 2) for TM. The phase does not change.

    Source: the limit of ITU-R P.2040-3, equation 43b, for a thin slab.
    """

    conductance: float
    vertices: Float[ndarray, "v 3"]
    faces: Int[ndarray, "f 3"]

    @property
    def loss_db(self) -> float:
        """Loss of a wave that passes the sheet at normal incidence [dB]."""
        return 20 / math.log(10) * math.log1p(self.conductance / 2)


class Legs(NamedTuple):
    """Straight pieces of paths, from the middle of the room."""

    start: Float[Tensor, "s 3"]  # first ends [m]
    along: Float[Tensor, "s 3"]  # from first to last ends [m]
    paths: Int[Tensor, " s"]  # number of each leg's path
    # Densities of matter, at points evenly spread over a leg [Np/m].
    densities: Float[Tensor, "s k"]


class AttenuatedPaths(NamedTuple):
    """Paths of b links, and what obstacles transmit of each."""

    fields: Float[Tensor, "b n"]  # magnitudes without obstacles
    passed: Float[Tensor, "b n"]  # fractions of the fields that obstacles transmit
    legs: Legs


class Crossings(NamedTuple):
    """Points where paths cross surfaces."""

    cosines: Float[Tensor, " c"]  # cosines of the angles of incidence
    tm_shares: Float[Tensor, " c"]  # shares of the TM field in vertical polarisation
    # Numbers of the path and of the surface.
    paths: Int[Tensor, " c"]
    surfaces: Int[Tensor, " c"]

    @property
    def surface_count(self) -> int:
        """Number of surfaces."""
        return int(self.surfaces.max()) + 1

    def losses(self, conductances: Float[Tensor, " k"], count: int) -> Float[Tensor, " p"]:
        """Attenuation [Np] of each of ``count`` paths by surfaces with these ``conductances``."""
        conductance = conductances[self.surfaces]  # at each crossing (c,)
        # Fractions of the field that pass, see ``Sheet``.
        te = 1 / (1 + conductance / (2 * self.cosines))
        tm = 1 / (1 + conductance * self.cosines / 2)
        losses = -torch.lerp(te, tm, self.tm_shares).log()
        return te.new_zeros(count).index_add(0, self.paths, losses)


@dataclass(frozen=True)
class MatterGrid:
    """Logarithm of the density of matter [Np/m] on a grid over a box and slightly beyond.

    ``corner`` is the grid's first point from the middle of the room [m], ``pitch`` the distance
    between its points [m].
    """

    log_densities: Float[ndarray, "x y z"]
    corner: Float[ndarray, "3"]
    pitch: float

    def number_surfaces(self, density: float) -> Int[ndarray, "x y z"]:
        """Number of the surface around each point of the grid, from 1; 0 in thinner matter."""
        numbers, _ = ndimage.label(self.log_densities > math.log(density))
        return numbers

    def mesh(
        self, density: float, number: int
    ) -> tuple[Float[ndarray, "v 3"], Int[ndarray, "f 3"]]:
        """Vertices [m] and triangles of surface ``number`` at a density.

        Vertices are relative to the middle of the room. A surface that reaches beyond the grid's
        box is closed there.

        Source: Lewiner et al., Efficient implementation of marching cubes' cases with topological
        guarantees, 2003.
        """
        level = math.log(density)
        numbers = self.number_surfaces(density)
        # Points in other surfaces become empty; thinner matter between surfaces stays.
        is_near = (numbers == number) | (numbers == 0)
        logs = np.where(is_near, np.minimum(self.log_densities, level + 9), level - 1)
        # Values far from the level do not matter, but must be finite. An empty margin closes the
        # surface at the edge of the grid.
        logs = np.pad(np.maximum(logs, level - 9), 1, constant_values=level - 1)
        vertices, faces, _, _ = marching_cubes(logs, level, spacing=(self.pitch,) * 3)
        return vertices + (self.corner - self.pitch), faces


def measure_densities(obstacles: Obstacles, points: Float[Tensor, "k 3"]) -> Float[Tensor, "k n"]:
    """Density of each Gaussian [Np/m] at points from the middle of the room [m], float64."""
    weights = (-2 * obstacles.log_widths.double()).exp()
    centres = obstacles.centres.double()
    points = points.double()
    # sum w (x - c)² = sum w x² - 2 sum w x c + sum w c²: products of matrices.
    squares = points.square() @ weights.T - 2 * points @ (weights * centres).T  # (k, n)
    squares = squares + (weights * centres.square()).sum(1)
    return (obstacles.log_densities.double() - squares / 2).exp()


def sample_matter(
    obstacles: Obstacles, lower: Float[ndarray, "3"], upper: Float[ndarray, "3"], voxels: int
) -> MatterGrid:
    """Samples matter at about ``voxels`` points of a box, and two more points on each side.

    The corners ``lower`` and ``upper`` are relative to the middle of the room [m].
    """
    pitch = float((np.prod(upper - lower) / voxels) ** (1 / 3))
    corner = lower - 2 * pitch
    shape = np.ceil((upper - corner) / pitch).astype(int) + 3
    axes = [torch.from_numpy(corner[axis] + pitch * np.arange(shape[axis])) for axis in range(3)]
    points = torch.cartesian_prod(*axes).to(obstacles.unit.device)
    parts = [measure_densities(obstacles, part).sum(1) for part in points.split(65536)]
    return MatterGrid(torch.cat(parts).log().view(*shape).cpu().numpy(), corner, pitch)


def find_crossings(
    obstacles: Obstacles, matter: MatterGrid, density: float, legs: Legs
) -> Crossings:
    """Points where legs of paths cross the surfaces of one density of matter.

    Numbers of the surfaces are those of ``matter`` minus 1.
    """
    # Crossings lie between two samples of a leg, one inside and one outside (c,).
    is_inside = legs.densities > density
    leg, step = (is_inside[:, 1:] != is_inside[:, :-1]).nonzero().T
    before, after = legs.densities[leg, step], legs.densities[leg, step + 1]
    spacing = legs.along[leg] / (legs.densities.shape[1] - 1)  # [m] from one sample to the next
    share = (density - before) / (after - before)  # of the spacing, by linear interpolation
    points = legs.start[leg] + (step + share)[:, None] * spacing
    # The normal is the gradient of the density, sum_i rho_i w_i (c_i - x), but for its sign, with
    # the densities rho, weights w and centres c of the Gaussians.
    densities = measure_densities(obstacles, points)  # (c, n)
    weights = (-2 * obstacles.log_widths.double()).exp()
    weighted_centres = weights * obstacles.centres.double()
    gradients = points * (densities @ weights) - densities @ weighted_centres
    normals = functional.normalize(gradients)
    cosines = (normals * functional.normalize(spacing)).sum(1).abs().clamp_min(1e-3)
    # The inner sample shows the surface. Its nearest grid point may be just outside: a dilation
    # gives such a point its neighbour's number.
    inner = legs.start[leg] + (step + (after > before))[:, None] * spacing
    numbers = matter.number_surfaces(density)
    numbers = np.where(numbers, numbers, ndimage.grey_dilation(numbers, 3))
    cells = np.rint((inner.cpu().numpy() - matter.corner) / matter.pitch).astype(int)
    cells = np.clip(cells, 0, np.array(numbers.shape) - 1)
    surfaces = torch.from_numpy(numbers[tuple(cells.T)]).to(leg)
    exists = surfaces > 0  # matter thinner than the pitch is not on the grid
    return Crossings(
        cosines=cosines[exists],
        tm_shares=normals[exists, 2].square(),
        paths=legs.paths[leg[exists]],
        surfaces=surfaces[exists] - 1,
    )


def sheets_of_boxes(obstacles: Obstacles, middle: Float[ndarray, "3"]) -> list[Sheet]:
    """A sheet for each box; a path crosses two faces, each with half the loss."""
    import trimesh.creation  # slow to import

    axes = obstacles.box_axes.cpu().double().numpy()
    bounds = obstacles.boxes[obstacles.used].cpu().double().numpy()
    depths = obstacles.box_depths[obstacles.used].clamp_min(0).tolist()
    sheets = []
    for corners, depth in zip(bounds, depths, strict=True):
        mesh = trimesh.creation.box(bounds=corners)
        conductance = 2 * math.expm1(depth / 2)  # 1 / (1 + conductance / 2)² = exp(-depth)
        sheets.append(Sheet(conductance, mesh.vertices @ axes.T + middle, mesh.faces))
    return sheets


def attenuate_paths(
    placement: Mirrored, obstacles: Obstacles, query: Query, options: SurfaceOptions
) -> AttenuatedPaths:
    """At most ``options.paths`` paths of a query, and the fractions that obstacles transmit."""
    sequences = placement.sequences[placement.kept]
    every = math.ceil(len(query) * len(sequences) / options.paths)
    query = query[::every].to(placement.middle.device)
    seen, receivers, folded = placement.folded(query)
    strengths = placement.strengths(query, folded, blocked=False).abs()
    fields = strengths / (seen[-1] - receivers[:, None]).norm(dim=-1)
    fields = fields.double()
    powers = fields.square()
    fields[powers < options.faint * powers.sum(1, keepdim=True)] = 0
    # Legs of the paths whose field is not 0, over all links (s,).
    link, leg = (fields > 0)[:, folded.path].nonzero().T
    paths = link * len(sequences) + folded.path[leg]
    start = folded.start[link, leg].double()
    along = folded.end[link, leg].double() - start
    # Boxes become sheets of their own, so only the Gaussians attenuate here.
    no_boxes = torch.zeros(len(start), int(obstacles.used.sum()), dtype=torch.bool)
    depths = obstacles(start.float(), (start + along).float(), no_boxes).real.double()
    depths = fields.new_zeros(fields.numel()).index_add(0, paths, depths)  # (b n,), of each path
    steps = torch.linspace(0, 1, options.samples).to(along)[:, None]  # (k, 1)
    densities = []
    for first, way in zip(start, along, strict=True):
        densities.append(measure_densities(obstacles, first + steps * way).sum(1))
    legs = Legs(start, along, paths, torch.stack(densities))
    return AttenuatedPaths(fields, (-depths).exp().view_as(fields), legs)


def choose_densities(paths: AttenuatedPaths, count: int) -> list[float]:
    """``count`` densities of matter [Np/m] in which paths lose their fields.

    Logarithms of the densities are evenly spaced. A tenth of the loss is in matter thinner than the
    first density, and a tenth in matter denser than the last. The list is empty if paths lose
    nothing.
    """
    densities = paths.legs.densities  # (s, k)
    # The loss of each leg's path, spread over the leg's samples in proportion to their density.
    path_losses = (paths.fields * (1 - paths.passed)).flatten()  # (b n,)
    losses = path_losses[paths.legs.paths, None] * densities
    losses = losses / densities.sum(1, keepdim=True).clamp_min(1e-300)
    order = densities.flatten().argsort()
    cumulative = losses.flatten()[order].cumsum(0)
    if not cumulative[-1] > 0:
        return []
    tenths = cumulative[-1] * cumulative.new_tensor([0.1, 0.9])
    ranks = torch.searchsorted(cumulative, tenths)
    low, high = densities.flatten()[order[ranks]].log().tolist()
    return torch.linspace(low, high, count).exp().tolist()


class SheetFit:
    """Fit of conductances, so that sheets attenuate paths like the obstacles.

    Errors of a link's fields are in decibels and averaged over links, so neither links in deep
    shadow nor the strongest links dominate.

    Args:
        paths: Fields of paths, and the fractions that obstacles transmit.
        crossings: Crossings for each density.
    """

    def __init__(self, paths: AttenuatedPaths, crossings: list[Crossings]):
        self.fields = paths.fields
        self.passed = paths.passed
        self.crossings = crossings
        self.powers = (self.fields * self.passed).square().sum(1)  # (b,), behind obstacles
        if not (self.powers > 0).any():
            raise ValueError(
                "obstacles absorb every path, so none shows their surfaces; train the model first"
            )

    def error(
        self, chosen: Sequence[int], logs: Sequence[Tensor], gain: Tensor
    ) -> Float[Tensor, ""]:
        """Mean error of the links [dB], with a common gain of all paths [Np].

        ``logs`` has the logarithms of the surfaces' conductances, for each chosen density.
        """
        count = self.fields.numel()
        losses = self.fields.new_zeros(count)
        for number, log in zip(chosen, logs, strict=True):
            losses = losses + self.crossings[number].losses(log.exp(), count)
        passed = (gain - losses).exp().view_as(self.fields)
        squares = (self.fields * (passed - self.passed)).square().sum(1)  # (b,)
        is_reached = self.powers > 0
        # Errors below -40 dB hardly count.
        return 10 * (squares[is_reached] / self.powers[is_reached] + 1e-4).log10().mean()

    def fit(
        self, chosen: Sequence[int], sizes: Sequence[int], start: Tensor
    ) -> tuple[float, Tensor]:
        """Conductances of the lowest error, by L-BFGS.

        Args:
            chosen: Numbers of densities.
            sizes: Number of conductances for each density: one for all its surfaces, or one for
                each.
            start: Initial logarithms of all conductances, then the gain of all paths [Np].

        Returns:
            The error [dB], and the values in the order of ``start``.
        """
        values = start.clone().requires_grad_()
        descent = torch.optim.LBFGS([values], max_iter=50, line_search_fn="strong_wolfe")

        def measure() -> Tensor:
            """The error of ``values``."""
            *logs, gain = values.split((*sizes, 1))
            of_surfaces = []
            for number, log in zip(chosen, logs, strict=True):
                of_surfaces.append(log.expand(self.crossings[number].surface_count))
            return self.error(chosen, of_surfaces, gain)

        def step() -> Tensor:
            descent.zero_grad()
            error = measure()
            error.backward()
            return error

        with torch.enable_grad():
            descent.step(step)
        return measure().item(), values.detach()


@torch.no_grad()
def fit_sheets(
    placement: Mirrored,
    query: Query,
    lower: Float[ndarray, "3"],
    upper: Float[ndarray, "3"],
    options: SurfaceOptions | None = None,
) -> tuple[list[Sheet], float]:
    """Sheets that attenuate a query's paths like the learnt obstacles.

    A sheet is a thin absorbing surface through matter of one density. Candidates are densities in
    which these paths lose their fields. All sets of ``options.densities`` densities are fitted,
    with one conductance for each density. In the best set each surface is then fitted with its own
    conductance.

    Args:
        placement: The learnt room; without obstacles there are no sheets.
        query: Links.
        lower, upper: Corners of the room [m].

    Returns:
        The sheets, and a gain [Np] that all paths have besides the losses in sheets.
    """
    options = options or SurfaceOptions()
    obstacles = placement.obstacles
    if obstacles is None:
        return [], 0.0
    middle = placement.middle.cpu().numpy()
    boxes = sheets_of_boxes(obstacles, middle)
    paths = attenuate_paths(placement, obstacles, query, options)
    candidates = choose_densities(paths, options.candidates)
    if not candidates:
        return boxes, 0.0
    matter = sample_matter(obstacles, lower - middle, upper - middle, options.voxels)
    crossings = [find_crossings(obstacles, matter, density, paths.legs) for density in candidates]
    fit = SheetFit(paths, crossings)
    crossed = [number for number, part in enumerate(crossings) if len(part.paths)]
    size = min(options.densities, len(crossed))
    trials = {}
    for numbers in itertools.combinations(crossed, size):
        start = paths.fields.new_zeros(size + 1)
        trials[numbers] = fit.fit(numbers, (1,) * size, start)
    chosen = min(trials, key=lambda numbers: trials[numbers][0])
    _, values = trials[chosen]
    # The conductance of each density is the start for all its surfaces.
    sizes = [crossings[number].surface_count for number in chosen]
    logs = [log.expand(size) for log, size in zip(values[:-1], sizes, strict=True)]
    _, values = fit.fit(chosen, sizes, torch.cat([*logs, values[-1:]]))
    sheets = boxes
    for number, log in zip(chosen, values[:-1].split(sizes), strict=True):
        for surface, conductance in enumerate(log.exp().tolist(), 1):
            if conductance < options.least_conductance:
                continue
            vertices, faces = matter.mesh(candidates[number], surface)
            sheets.append(Sheet(conductance, vertices + middle, faces))
    return sheets, values[-1].item()
