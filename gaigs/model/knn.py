"""Inverse-distance weighting of the nearest known links: the simplest look-up."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.data import Links
from gaigs.kriging.links import at_directions, coordinates, distances, evenly, known_links, scale_bounds
from gaigs.model import Model, Prediction
from gaigs.query import Batch, Query
from gaigs.registry import register
from gaigs.scene import Scene


@register("model", "knn")
class KNearestNeighbours(Model):
    """The mean of the k known labels nearest to the transmitter, weighted by 1 / distance^power.

    Links as near as the k-th count too, so that the order of links does not matter. Channels of unknown phase are
    aligned to the nearest. The look-up keeps all links, one byte a pixel for images.

    Where the training links have several carriers, the distance is that in place and frequency,
    d² = |dx|² + (s d ln f)². ``fit`` takes the scale s [m] with the least squared error of known links that are
    predicted from those at other places.

    Args:
        k: Number of neighbours; with fewer known links, all of them.
        power: Exponent of the distance; 0 weights all neighbours equally.

    Source: reference look-up of the data sets' own README; Shepard, 1968.
    """

    def __init__(self, scene: Scene, k: int = 3, power: float = 2.0):
        super().__init__(scene)
        if k < 1:
            raise ValueError(f"model.k must be at least 1, got {k}")
        if not 0 <= power < math.inf:
            raise ValueError(f"model.power must be 0 or more, and finite, got {power}")
        self.k, self.power = k, power
        self.scale = math.nan

    def fit(self, links: Links) -> None:
        """Keeps the links, and chooses the scale of frequencies."""
        self.links, self.known, self.scale = links, known_links(links), math.nan
        if self.scene.has_band:
            low, high = scale_bounds(self.scene)
            scales = torch.logspace(math.log10(low), math.log10(high), 16, dtype=torch.float64).tolist()
            self.scale = min(scales, key=self._leave_one_out)

    def facts(self) -> dict[str, float]:
        """``frequency_scale_m``, with several carriers."""
        return {} if math.isnan(self.scale) else {"frequency_scale_m": self.scale}

    def forward(self, batch: Batch) -> Prediction:
        query = batch.query
        labels = torch.empty(len(query), *self.scene.task.shape, dtype=self.scene.task.dtype)
        for receiver in query.receivers.unique():
            own = query.receivers == receiver
            apart = self._distances(query[own], self.known[receiver], self.scale)
            labels[own] = self._look_up(apart, self.known[receiver])
        return Prediction(at_directions(labels, batch, self.scene), {})

    def _distances(self, query: Query, index: Int[Tensor, " k"], scale: float) -> Float[Tensor, "b k"]:
        asked, known = (coordinates(self.scene, part, scale) for part in (query, self.links.query[index]))
        return distances(asked, known)

    def _look_up(self, apart: Float[Tensor, "b k"], index: Int[Tensor, " k"]) -> Tensor:
        """Labels from those of known links and their distances; links at an infinite distance are left out."""
        farthest = apart.topk(min(self.k, len(index)), largest=False).values[:, -1:]
        near = (apart <= farthest) & apart.isfinite()
        # A transmitter within a micrometre of a measured one gets that label.
        apart = apart.clamp_min(1e-6)
        weights = near * (apart.amin(1, keepdim=True) / apart) ** self.power  # ratios stay finite
        weights = weights / weights.sum(1, keepdim=True)
        used = near.any(0)
        labels, align = self.links.labels[index[used]], self.scene.task.align
        rows = []
        for own, first in zip(weights[:, used], apart[:, used].argmin(1).tolist(), strict=True):
            near = own.nonzero()[:, 0]
            rows.append(torch.tensordot(own[near].to(labels), align(labels[near], labels[first : first + 1]), 1))
        return torch.stack(rows)

    def _leave_one_out(self, scale: float) -> float:
        """Mean squared error of known links that are predicted from those at other places, as test links are."""
        errors, count = 0.0, 0
        for index in self.known:
            for part in evenly(index, max(1, 256 // len(self.known))).split(32):
                asked, known = self.links.query[part], self.links.query[index]
                here = (asked.transmitters[:, None] == known.transmitters).all(-1)
                apart = self._distances(asked, index, scale).masked_fill(here, math.inf)
                found = apart.isfinite().any(1)  # a place may be the only one
                part = part[found]
                values = self._look_up(apart[found], index)
                error = values - self.scene.task.align(self.links.labels[part], values)
                errors += error.abs().double().square().sum().item()
                count += len(part)
        return errors / max(count, 1)
