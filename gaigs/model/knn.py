"""Inverse-distance weighting of the nearest known links: the simplest look-up."""

import math
from collections.abc import Iterator, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.core.query import Batch, Query, evenly
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.kriging.links import (
    at_directions,
    coordinates,
    distances,
    folds_of,
    known_links,
    scale_bounds,
)
from gaigs.model import LookUp, Prediction
from gaigs.registry import register

COUNTS = (1, 2, 3, 5, 8, 12, 20, 30, 50)
"""Numbers of neighbours to choose from."""


@register("model", "knn")
class KNearestNeighbours(LookUp):
    """The mean of the k known labels nearest to the transmitter, weighted by 1 / distance^power.

    Links as near as the k-th count too, so that the order of links does not matter. Channels of
    unknown phase are aligned to the nearest. The look-up keeps all links, one byte a pixel for
    images.

    Where the training links have several carriers, the distance is that in place and frequency, d²
    = |dx|² + (s d ln f)². ``fit`` takes the scale s [m] with the least squared error of known links
    that are predicted from those at other places.

    Args:
        k: Number of neighbours; with fewer known links, all of them. None: 3, or of noisy labels
            that of ``COUNTS`` with the least error of known links that are predicted from those of
            other folds, see ``gaigs.kriging.links.folds_of``.
        power: Exponent of the distance; 0 weights all neighbours equally. None: 2, or 1 of noisy
            labels.

    Source: reference look-up of the data sets' own README; Shepard, 1968.
    """

    learnt = "chosen", "scale"

    def __init__(self, scene: Scene, k: int | None = None, power: float | None = None):
        super().__init__(scene)
        if k is not None and k < 1:
            raise ValueError(f"model.k must be at least 1 or null, got {k}")
        if power is not None and not 0 <= power < math.inf:
            raise ValueError(f"model.power must be 0 or more, and finite, got {power}")
        is_noisy = scene.task.is_noisy
        self.k = k or (None if is_noisy else 3)
        usual_power = 1.0 if is_noisy else 2.0
        self.power = usual_power if power is None else power
        self.chosen = self.k or 3
        self.scale = math.nan

    def fit(self, links: Links) -> None:
        """Keeps the links, and chooses the scale of frequencies, and the number of neighbours if it
        is None.
        """
        self.links, self.known = links, known_links(links)
        self.scale = math.nan
        self.chosen = self.k or 3
        if self.scene.has_band:
            low, high = (math.log10(bound) for bound in scale_bounds(self.scene))
            scales = torch.logspace(low, high, 16, dtype=torch.float64).tolist()
            self.scale = min(scales, key=self._squared_error)
        if self.k is None:
            folds = [folds_of(links, index) for index in self.known]
            self.chosen = min(COUNTS, key=lambda count: self._rank(count, folds))

    def facts(self) -> dict[str, float]:
        """``neighbours`` if they were chosen, and with several carriers ``frequency_scale_m``."""
        facts: dict[str, float] = {"neighbours": self.chosen} if self.k is None else {}
        return facts if math.isnan(self.scale) else {**facts, "frequency_scale_m": self.scale}

    def forward(self, batch: Batch) -> Prediction:
        query = batch.query
        labels = torch.empty(len(query), *self.scene.task.shape, dtype=self.scene.task.dtype)
        for receiver in query.receivers.unique():
            is_asked = query.receivers == receiver
            apart = self._distances(query[is_asked], self.known[receiver], self.scale)
            labels[is_asked] = self._look_up(apart, self.known[receiver])
        return Prediction(at_directions(labels, batch, self.scene), {})

    def _distances(
        self, query: Query, index: Int[Tensor, " k"], scale: float
    ) -> Float[Tensor, "b k"]:
        asked = coordinates(self.scene, query, scale)
        known = coordinates(self.scene, self.links.query[index], scale)
        return distances(asked, known)

    def _look_up(self, apart: Float[Tensor, "b k"], index: Int[Tensor, " k"]) -> Tensor:
        """Labels from those of known links and their distances; links at an infinite distance are
        left out.
        """
        farthest = apart.topk(min(self.chosen, len(index)), largest=False).values[:, -1:]
        near = (apart <= farthest) & apart.isfinite()
        # A transmitter within a micrometre of a measured one gets that label.
        apart = apart.clamp_min(1e-6)
        weights = near * (apart.amin(1, keepdim=True) / apart) ** self.power  # ratios stay finite
        weights = weights / weights.sum(1, keepdim=True)
        used = near.any(0)
        labels, align = self.links.labels[index[used]], self.scene.task.align
        if not self.scene.task.shape:  # a radio map of many receivers asks for millions of numbers
            return weights[:, used].to(labels) @ labels
        rows = []
        for row, first in zip(weights[:, used], apart[:, used].argmin(1).tolist(), strict=True):
            near = row.nonzero()[:, 0]
            aligned = align(labels[near], labels[first : first + 1])  # to the nearest
            rows.append(torch.tensordot(row[near].to(labels), aligned, 1))
        return torch.stack(rows)

    def _held_out(
        self, folds: Sequence[Int[Tensor, " _"]] | None = None
    ) -> Iterator[tuple[Tensor, Tensor]]:
        """Labels of known links, and what links of other folds predict for them, or for None those
        at other places.
        """
        for receiver, index in enumerate(self.known):
            for rows in evenly(torch.arange(len(index)), max(1, 256 // len(self.known))).split(32):
                asked, known = self.links.query[index[rows]], self.links.query[index]
                here = (asked.transmitters[:, None] == known.transmitters).all(-1)
                if folds is not None:
                    here |= folds[receiver][rows][:, None] == folds[receiver]
                apart = self._distances(asked, index, self.scale).masked_fill(here, math.inf)
                has_others = apart.isfinite().any(1)  # a place may be the only one
                if has_others.any():
                    values = self._look_up(apart[has_others], index)
                    labels = self.links.labels[index[rows[has_others]]]
                    yield self.scene.task.align(labels, values), values

    def _squared_error(self, scale: float) -> float:
        self.scale = scale
        errors = []
        for labels, values in self._held_out():
            errors.append((values - labels).abs().double().square().flatten())
        return torch.cat(errors).mean().item() if errors else 0.0

    def _rank(self, count: int, folds: Sequence[Int[Tensor, " _"]]) -> float:
        """Mean score of known links by some neighbours, an error or a negative similarity."""
        self.chosen = count
        task = self.scene.task
        held = self._held_out(folds)
        scores = [task.scores(labels, values)[task.monitor] for labels, values in held]
        mean = torch.cat(scores).mean().item() if scores else 0.0
        return -mean if task.higher_is_better else mean
