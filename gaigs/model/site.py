"""Log-distance path loss, and the loss by buildings and terrain on a map."""

import logging
import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.constants import speed_of_light
from scipy.optimize import nnls
from torch import Tensor
from torch.nn import functional

from gaigs.core.query import Batch, Query
from gaigs.core.roofs import Roofs, obstruct, plan_grid, rasterize_roofs
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.data.geojson import read_buildings
from gaigs.data.terrain import read_extent, read_ground
from gaigs.kriging.gross_errors import without_gross_errors
from gaigs.model import Model, Prediction
from gaigs.model.path_loss import PathLoss
from gaigs.registry import register

log = logging.getLogger(__name__)


@register("model", "site")
class Site(Model):
    """``path_loss`` of each receiver, minus a common loss by buildings and terrain.

    Loss = c1 [a roof is above the direct path] + c2 10 log10(1 + length inside / 1 m) + c3 (walls
    crossed) + c4 (knife-edge loss over roofs and ground). The coefficients are fitted by least
    squares together with the level and exponent of each receiver, see ``shared_coefficients``. They
    are NaN before ``fit``, which reads the files. A checkpoint stores roofs and ground on a grid of
    1 m, or coarser for a large site; without buildings it has the pixels of the terrain.

    Args:
        buildings: GeoJSON file, see ``gaigs.data.geojson.read_buildings``. Coordinates are
            longitude and latitude, or easting and northing, if the data have a frame; otherwise
            metres of the data.
        height: Height of buildings without this property [m]; None: each must have it.
        terrain: GeoTIFF file of heights of the ground [m], see ``gaigs.data.terrain.read_ground``.
        above_ground: True if the heights of transmitters and receivers are above the terrain, False
            if they have its zero. None: above it if half of them would be below the ground
            otherwise. Distances of path loss do not change.

    Raises:
        FileNotFoundError: ``fit`` finds no such file.
        ImportError: rasterio is not installed, which terrain needs.
        ValueError: A label is more than one real number, or neither file is given. In ``fit``: a
            file has a defect, or is not near the links.

    Source: ITU-R P.526-15, sections 4.1 and 4.5.1; Lawson and Hanson, Solving Least Squares
    Problems, 1974, chapter 23.
    """

    any_receiver = True
    roofs: Tensor
    ground: Tensor

    def __init__(
        self,
        scene: Scene,
        buildings: str | None = None,
        height: float | None = None,
        terrain: str | None = None,
        above_ground: bool | None = None,
    ):
        super().__init__(scene)
        if buildings is None and terrain is None:
            raise ValueError(
                "model 'site' needs a map\ngive buildings, a GeoJSON file, terrain, a GeoTIFF "
                "file, or both"
            )
        self.buildings = buildings
        self.height = height
        self.terrain = terrain
        self.above_ground = above_ground
        self.law = PathLoss(scene)
        self.register_buffer("losses", torch.full((4,), torch.nan))  # c1 to c4
        self.register_buffer("roofs", torch.zeros(1, 1))  # (rows, columns) [m]
        self.register_buffer("ground", torch.zeros(0, 0))  # the same, empty without terrain [m]
        self.register_buffer("grid", torch.zeros(3))  # lower corner, cell [m]
        self.register_buffer("is_lifted", torch.tensor(False))  # heights are above the ground

    def _load_from_state_dict(self, state_dict, prefix, *args):
        # Older checkpoints have no terrain.
        for name in ("ground", "is_lifted"):
            state_dict.setdefault(f"{prefix}{name}", getattr(self, name))
        for name in ("roofs", "ground"):  # a grid's size
            setattr(self, name, torch.empty_like(state_dict.get(f"{prefix}{name}", self.roofs)))
        super()._load_from_state_dict(state_dict, prefix, *args)

    def fit(self, links: Links) -> None:
        """Reads the maps, and fits coefficients and path loss."""
        roofs = self._read_roofs(links)
        self.roofs = roofs.heights.to(self.roofs)
        if roofs.ground is not None:
            self.ground = roofs.ground.to(self.roofs)
        self.grid.copy_(torch.tensor([*roofs.lower, roofs.cell]))
        links = without_gross_errors(links)
        index = links.split.known
        query = links.query[index]
        features = self._features(query).double()  # (k, 4)
        if self.buildings and not features[:, 0].any():
            log.warning(
                "%s: no roof is above the direct path of any link\n"
                "compare heights of buildings, ground and places: they need one zero",
                self.buildings,
            )
        columns = torch.cat((links.labels[index, None].double(), -features), 1)  # (k, 5)
        positions = self.scene.positions(query.transmitters)[query.receivers]  # (k, 3)
        lengths = (query.transmitters - positions).norm(dim=1).double()
        self.losses.copy_(shared_coefficients(columns, lengths, query.receivers))
        log.info("losses by roofs, length inside, walls and edges: %s", self.losses.tolist())
        corrected = links.labels.clone()
        corrected[index] += (features @ self.losses.double()).to(corrected)
        self.law.fit(replace(links, labels=corrected))

    def forward(self, batch: Batch) -> Prediction:
        loss = self._features(batch.query) @ self.losses
        return Prediction(self.law(batch).value - loss, {})

    def _features(self, query: Query) -> Float[Tensor, "b 4"]:
        """The factors of c1 to c4 in the loss of each link, see ``Site``; NaN before ``fit``."""
        x, y, cell = self.grid.tolist()
        if not cell:  # before the fit
            return query.transmitters.new_full((len(query), 4), torch.nan)
        # With an unknown carrier, 2 GHz: another one adds a constant to the loss behind an edge,
        # which c1 includes.
        wavelength = speed_of_light / (self.scene.middle_frequency or 2e9)
        starts = self.scene.positions(query.transmitters)[query.receivers].clone()  # (b, 3)
        ends = query.transmitters.clone()
        roofs = Roofs(self.roofs, (x, y), cell, self.ground if self.ground.numel() else None)
        if self.is_lifted:
            starts[:, 2] += roofs.ground_at(starts)
            ends[:, 2] += roofs.ground_at(ends)
        features = obstruct(roofs, starts, ends, wavelength)
        features[:, 1] = 10 * (1 + features[:, 1]).log10()
        return features

    def _read_roofs(self, links: Links) -> Roofs:
        """Roofs and ground in the area where predictions give no warning of extrapolation."""
        frame = self.scene.frame
        buildings = read_buildings(self.buildings, frame, self.height) if self.buildings else []
        lower, upper = (corner[:2].double().numpy() for corner in self.scene.box)
        cell = 1.0  # [m]
        maps = []  # lower and upper corner of each map (2, 2) [m]
        if self.buildings:
            edges = np.concatenate([building.rings[0] for building in buildings])
            maps.append(np.stack((edges.min(0), edges.max(0))))
            self._check_near("buildings", self.buildings, maps[-1])
        if self.terrain:
            extent = read_extent(self.terrain, frame)
            maps.append(np.stack((extent.lower, extent.upper)))
            self._check_near("terrain", self.terrain, maps[-1])
            cell = cell if self.buildings else extent.cell
        corners = np.stack(maps)  # (maps, 2, 2)
        lower = np.maximum(lower - self.scene.extent, corners[:, 0].min(0))
        upper = np.minimum(upper + self.scene.extent, corners[:, 1].max(0))
        grid = plan_grid(lower, upper, cell)
        if not self.terrain:
            return rasterize_roofs(buildings, grid)
        ground, is_known = read_ground(self.terrain, frame, grid)
        roofs = rasterize_roofs(buildings, grid, ground)
        # The file has no heights beyond the grid: a margin of one cell has the value 0.
        known = functional.pad(torch.from_numpy(is_known).float(), (1, 1, 1, 1))
        padded_lower = roofs.lower[0] - roofs.cell, roofs.lower[1] - roofs.cell
        covered = roofs._replace(ground=known, lower=padded_lower)
        self._choose_zero(links, roofs, covered)
        return roofs

    def _check_near(self, content: str, file: str, corners: Float[np.ndarray, "2 2"]) -> None:
        """Raises a ``ValueError`` if a map with these corners [m] is far from the links."""
        lower, upper = (corner[:2].double().numpy() for corner in self.scene.box)
        is_beside = (corners[0] >= upper + self.scene.extent).any()
        if is_beside or (corners[1] <= lower - self.scene.extent).any():
            ends = [*corners.flatten(), *lower, *upper]
            raise ValueError(
                "{}: {} from ({:.0f}, {:.0f}) to ({:.0f}, {:.0f}) m are far from the links, "
                "({:.0f}, {:.0f}) to ({:.0f}, {:.0f}) m\n"
                "give both in one frame: data.epsg of the links, or the map less their "
                "origin".format(file, content, *ends)
            )

    def _choose_zero(self, links: Links, roofs: Roofs, covered: Roofs) -> None:
        """Sets ``is_lifted``: True if heights of transmitters and receivers are above the ground.

        Args:
            links: Links, whose known transmitters and receivers are compared with the ground.
            roofs: Roofs and ground.
            covered: A grid whose ``ground`` is 1 where the file has a height, else 0.
        """
        known = links.query[links.split.known]
        positions = self.scene.positions(known.transmitters)[known.receivers]
        ends = torch.cat((known.transmitters, positions))  # (2 k, 3)
        outside = (covered.ground_at(ends) < 0.5).float().mean().item()
        if outside:
            log.warning(
                "%s: no height of the ground at %.0f %% of the ends of links\n"
                "they get the nearest one; give terrain of the whole site",
                self.terrain,
                100 * outside,
            )
        is_above = self.above_ground
        heights = ends[:, 2] - roofs.ground_at(ends)  # above the ground, if z has the file's zero
        if is_above is None:
            is_above = bool(heights.median() < 0)
        self.is_lifted.fill_(is_above)
        heights = ends[:, 2] if is_above else heights
        below = (heights < -2.0).float().mean().item()  # [m]; terrain is seldom known better
        if below > 0.05:
            log.warning(
                "%s: %.0f %% of the ends of links are over 2 m below the ground\n"
                "set above_ground=%s, or compare the zeros of terrain and places",
                self.terrain,
                100 * below,
                not is_above,
            )
        reference = "the ground" if is_above else "the zero of the terrain"
        log.info(
            "z of transmitters and receivers is above %s: they stand %.0f m above the ground "
            "(median)",
            reference,
            heights.median().item(),
        )


def shared_coefficients(
    columns: Float[Tensor, "k c"], lengths: Float[Tensor, " k"], receivers: Tensor
) -> Float[Tensor, " f"]:
    """Non-negative coefficients c of features x in y = level + exponent log10(d) + c . x.

    Each receiver has its own level and exponent; c is shared. A ridge shrinks each coefficient,
    with the weight of one more link. If level and exponent explain a feature, its coefficient is 0.

    Args:
        columns: Level y of each link [dBm], then its features x. Losses are negative features,
            since c is not negative.
        lengths: Distances d [m].
        receivers: Number of each link's receiver.

    Source: Frisch and Waugh, Partial time regressions as compared with individual trends, 1933.
    """
    columns = columns.clone()
    decades = lengths.clamp_min(0.1).log10()
    # Least squares of c alone give the same c if level and exponent are regressed out of y and x
    # first (Frisch and Waugh, 1933).
    for receiver in receivers.unique():
        rows = receivers == receiver
        law = torch.stack((torch.ones_like(decades[rows]), decades[rows]), 1)  # (j, 2)
        fitted = torch.linalg.lstsq(law, columns[rows], driver="gelsd").solution  # (2, c)
        columns[rows] -= law @ fitted
    residual = columns[:, 0]
    features = columns[:, 1:]  # (k, f)
    spreads = features.square().mean(0).sqrt()  # (f,)
    # A feature that the law explains has only rounding left: an infinite spread makes its c 0.
    spreads = spreads.where(spreads > 1e-6, math.inf)
    # Ridge regression: one more row for each coefficient in units of its spread, with the value 0.
    ridge = torch.eye(len(spreads)).double()
    matrix = torch.cat((features / spreads, ridge))
    values = torch.cat((residual, torch.zeros(len(spreads)).double()))
    scaled, _ = nnls(matrix.cpu().numpy(), values.cpu().numpy())
    return torch.from_numpy(scaled) / spreads.cpu()
