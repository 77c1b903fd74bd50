"""Known readings around places. The nearest readings make farther ones nearly irrelevant."""

import math
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gaigs.core.query import evenly
from gaigs.core.scene import Scene
from gaigs.kriging.links import Near, distances, edges_of, nearest_places, scale_bounds, scaled


class Nearest(NamedTuple):
    """Rows of the j known readings nearest to each of m places."""

    rows: Int[Tensor, "m j"]  # rows of the readings
    exists: Bool[Tensor, "m j"]  # False beyond a receiver's readings


class Around(NamedTuple):
    """The j nearest readings of the same receiver around each of m asked places.

    In ``apart`` and ``bands`` the asked place itself comes last.
    """

    rows: Int[Tensor, "m j"]  # rows of the readings
    exists: Bool[Tensor, "m j"]  # False for rows beyond a receiver's readings
    receivers: Int[Tensor, " m"]  # receivers of the asked places
    # Distances of places [m] (m, j + 1, j + 1), 1e15 for rows that do not exist: nothing
    # correlates.
    apart: Float[Tensor, "m i i"]
    # Squared distances of carriers, see ``coordinates`` of scale 1 (m, j + 1, j + 1); None without
    # a band.
    bands: Float[Tensor, "m i i"] | None


class HeldOutReadings(NamedTuple):
    """Rows of held-out readings, and the readings of other folds around each."""

    rows: Int[Tensor, " m"]
    around: Around


class Readings(NamedTuple):
    """Known readings, with a search for the nearest readings of a place."""

    scene: Scene  # receivers and carriers
    places: Float[Tensor, "k d"]  # places, see ``coordinates`` of scale 1
    receivers: Int[Tensor, " k"]
    count: int  # number of readings around a place

    def nearest(
        self,
        places: Float[Tensor, "m d"],
        receivers: Int[Tensor, " m"],
        own: Int[Tensor, " m"] | None = None,
        folds: Int[Tensor, " k"] | None = None,
        reach: bool = False,
        size: int = 2048,
        most: int = 6000,
    ) -> Nearest:
        """The ``count`` known readings nearest to each place, of the same receiver.

        Args:
            places, receivers: Asked places, ``coordinates`` of scale 1, and their receivers.
            own: Fold of each asked place, whose readings are left out; None: no folds.
            folds: Folds of the known readings.
            reach: True to choose half of the readings at growing distances, since near ones alone
                hardly determine correlation lengths. Used only with folds.
            size: Number of places whose neighbours are held in memory at a time.
            most: With folds, number of a receiver's readings that are searched, evenly chosen.

        Source: Stein, Chi and Welty, Approximating likelihoods for large spatial data sets, 2004.
        """
        rows = receivers.new_zeros(len(places), self.count)
        exists = torch.zeros_like(rows, dtype=torch.bool)
        # With several carriers a middle scale decides which readings are nearest, so that they stay
        # the same during a fit of the scale.
        scale = math.nan
        if self.scene.has_band:
            scale = math.sqrt(math.prod(scale_bounds(self.scene)))
        last_search: tuple[Tensor, Tensor, Near] | None = None
        for receiver in receivers.unique().tolist():
            known = (self.receivers == receiver).nonzero()[:, 0]
            if not len(known):
                continue
            asked_rows = (receivers == receiver).nonzero()[:, 0]
            if own is None or folds is None:
                ends = scaled(places[asked_rows], scale), scaled(self.places[known], scale)
                # One search for all receivers with readings at the same places.
                if last_search is None or not all(map(torch.equal, ends, last_search)):
                    last_search = (*ends, nearest_places(*ends, self.count))
                nearest_rows = last_search[2].rows  # (a, j)
                rows[asked_rows, : nearest_rows.shape[1]] = known[nearest_rows]
                exists[asked_rows, : nearest_rows.shape[1]] = True
                continue
            known = evenly(known, most)
            known_places = scaled(self.places[known], scale)
            count = min(self.count, len(known))
            for asked in asked_rows.split(size):
                apart = distances(scaled(places[asked], scale), known_places)  # (asked, known)
                is_own = own[asked, None] == folds[known]
                apart = apart.masked_fill(is_own, math.inf)
                farthest = int(apart.isfinite().sum(1).min())  # rank that all places have
                if reach and farthest > self.count:
                    ranks = self._far_ranks(farthest)
                    rows[asked] = known[apart.argsort(1)[:, ranks]]
                    exists[asked] = True
                    continue
                near = apart.topk(count, largest=False)
                rows[asked, :count] = known[near.indices]
                exists[asked, :count] = near.values.isfinite()
        return Nearest(rows, exists)

    def _far_ranks(self, farthest: int) -> Int[Tensor, " j"]:
        """Ranks by distance of ``count`` readings: the nearest half, then a geometric series."""
        half = self.count // 2
        far = torch.from_numpy(np.geomspace(half, farthest - 1, half)).round().long()
        return torch.cat((torch.arange(half), far))

    def around(
        self, places: Float[Tensor, "m d"], receivers: Int[Tensor, " m"], nearest: Nearest
    ) -> Around:
        """Distances among each place and the readings near it."""
        points = torch.cat((self.places[nearest.rows], places[:, None]), 1)  # (m, j + 1, d)
        exists = torch.nn.functional.pad(nearest.exists, (0, 1), value=True)
        pairs = exists[:, :, None] & exists[:, None]
        edges = edges_of(points)
        apart = distances(points[..., :edges], points[..., :edges]).where(pairs, 1e15)
        bands = None
        if self.scene.has_band:
            bands = (points[..., edges:] - points[..., edges:].mT).square()
        return Around(nearest.rows, nearest.exists, receivers, apart, bands)

    def held_out(
        self, rows: Int[Tensor, " h"], folds: Int[Tensor, " k"], most: int
    ) -> HeldOutReadings:
        """Held-out readings, evenly chosen from ``rows``, with readings of other folds around each.

        About ``most`` are chosen for all receivers together. Each receiver has at least 16, unless
        the sum would then exceed four times ``most``.
        """
        receivers = self.receivers[rows].unique()
        per_receiver = max(1, most // len(receivers), min(16, 4 * most // len(receivers)))
        parts = []
        for receiver in receivers:
            parts.append(evenly(rows[self.receivers[rows] == receiver], per_receiver))
        asked = torch.cat(parts)
        places, asked_receivers = self.places[asked], self.receivers[asked]
        nearest = self.nearest(places, asked_receivers, folds[asked], folds, reach=True)
        return HeldOutReadings(asked, self.around(places, asked_receivers, nearest))
