"""Log-distance path loss, and the loss by buildings on a map."""

import logging
import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.constants import speed_of_light
from scipy.optimize import nnls
from torch import Tensor

from gaigs.core.query import Batch, Query
from gaigs.core.roofs import Roofs, obstruct, rasterize_roofs
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.data.geojson import read_buildings
from gaigs.kriging.gross_errors import without_gross_errors
from gaigs.model import Model, Prediction
from gaigs.model.path_loss import PathLoss
from gaigs.registry import register

log = logging.getLogger(__name__)


@register("model", "site")
class Site(Model):
    """``path_loss`` of each receiver, minus a common loss by buildings; NaN before ``fit``.

    Loss = c1 [a roof is above the direct path] + c2 10 log10(1 + length inside / 1 m) + c3 (walls
    crossed) + c4 (knife-edge loss over the roofs). The coefficients are fitted by least squares
    together with the level and exponent of each receiver, see ``shared_coefficients``. ``fit``
    reads the file. A checkpoint stores the roofs on a grid of 1 m, or coarser for a large site.

    Args:
        buildings: GeoJSON file, see ``gaigs.data.geojson.read_buildings``. Coordinates are
            longitude and latitude, or easting and northing, if the data have a frame; otherwise
            metres of the data.
        height: Height of buildings without this property [m]; None: each must have it.

    Raises:
        FileNotFoundError: ``fit`` finds no such file.
        ValueError: A label is more than one real number. In ``fit``: the file has a defect, or no
            building is near the links.

    Source: ITU-R P.526-15, sections 4.1 and 4.5.1; Lawson and Hanson, Solving Least Squares
    Problems, 1974, chapter 23.
    """

    any_receiver = True

    def __init__(self, scene: Scene, buildings: str, height: float | None = None):
        super().__init__(scene)
        self.buildings = buildings
        self.height = height
        self.law = PathLoss(scene)
        self.register_buffer("losses", torch.full((4,), torch.nan))  # c1 to c4
        self.register_buffer("roofs", torch.zeros(1, 1))  # (rows, columns) [m]
        self.register_buffer("grid", torch.zeros(3))  # lower corner, cell [m]

    def _load_from_state_dict(self, state_dict, prefix, *args):
        self.roofs = torch.empty_like(state_dict.get(f"{prefix}roofs", self.roofs))  # a grid's size
        super()._load_from_state_dict(state_dict, prefix, *args)

    def fit(self, links: Links) -> None:
        """Reads the buildings, and fits coefficients and path loss."""
        roofs = self._read_roofs()
        self.roofs = roofs.heights.to(self.roofs)
        self.grid.copy_(torch.tensor([*roofs.lower, roofs.cell]))
        kept = without_gross_errors(links)
        index = kept.split.known
        query = links.query[index]
        features = self._features(query).double()  # (k, 4)
        if not features[:, 0].any():
            log.warning(
                "%s: no roof is above the direct path of any link\n"
                "compare heights of buildings and places: both are above 0 of the data's z",
                self.buildings,
            )
        columns = torch.cat((links.labels[index, None].double(), -features), 1)  # (k, 5)
        positions = self.scene.positions(query.transmitters)[query.receivers]  # (k, 3)
        lengths = (query.transmitters - positions).norm(dim=1).double()
        self.losses.copy_(shared_coefficients(columns, lengths, query.receivers))
        log.info("losses by buildings, their length, walls and edges: %s", self.losses.tolist())
        corrected = links.labels.clone()
        corrected[index] += (features @ self.losses.double()).to(corrected)
        self.law.fit(replace(kept, labels=corrected))

    def forward(self, batch: Batch) -> Prediction:
        loss = self._features(batch.query) @ self.losses
        return Prediction(self.law(batch).value - loss, {})

    def _features(self, query: Query) -> Float[Tensor, "b 4"]:
        """The features of c1 to c4 in the loss of each link; NaN before ``fit``."""
        x, y, cell = self.grid.tolist()
        if not cell:  # before the fit
            return query.transmitters.new_full((len(query), 4), torch.nan)
        # Another wavelength adds a constant to the loss behind an edge, which c1 takes.
        wavelength = speed_of_light / (self.scene.middle_frequency or 2e9)
        positions = self.scene.positions(query.transmitters)[query.receivers]  # (b, 3)
        features = obstruct(
            Roofs(self.roofs, (x, y), cell), positions, query.transmitters, wavelength
        )
        features[:, 1] = 10 * (1 + features[:, 1]).log10()
        return features

    def _read_roofs(self) -> Roofs:
        """Roofs in the area where predictions give no warning of extrapolation."""
        buildings = read_buildings(self.buildings, self.scene.frame, self.height)
        corners = np.concatenate([rings[0] for rings, _ in buildings])
        lower, upper = (corner[:2].double().numpy() for corner in self.scene.box)
        first = np.maximum(lower - self.scene.extent, corners.min(0))
        last = np.minimum(upper + self.scene.extent, corners.max(0))
        if (first >= last).any():
            ends = [*corners.min(0), *corners.max(0), *lower, *upper]
            raise ValueError(
                "{}: buildings from ({:.0f}, {:.0f}) to ({:.0f}, {:.0f}) m are far from the links, "
                "({:.0f}, {:.0f}) to ({:.0f}, {:.0f}) m\n"
                "give both in one frame: data.epsg of the links, or buildings less their "
                "origin".format(self.buildings, *ends)
            )
        return rasterize_roofs(buildings, first, last)


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
