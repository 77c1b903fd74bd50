"""Inverse-distance weighting of the labels of the nearest known links."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.core.query import Batch, Query, evenly
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.kriging.links import (
    Near,
    at_directions,
    coordinates,
    distances,
    folds_of,
    known_links,
    nearest_places,
    scale_bounds,
)
from gaigs.model import LookUp, Prediction
from gaigs.registry import register

COUNTS = (1, 2, 3, 5, 8, 12, 20, 30, 50)
"""Numbers of neighbours to choose from."""


class HeldOutLinks(NamedTuple):
    """Held-out links of one receiver."""

    rows: Int[Tensor, " h"]  # their rows among the receiver's known links
    # Distances to the known links [m]; infinite to links that are held out with them.
    apart: Float[Tensor, "h k"]
    index: Int[Tensor, " k"]  # the receiver's known links


@register("model", "knn")
class KNearestNeighbours(LookUp):
    """The mean of the k known labels nearest to the transmitter, weighted by 1 / distance^power.

    Links as far as the k-th one count too, so the order of links has no effect. Channels of
    unknown phase are aligned to the nearest one. The look-up stores all links, with one byte a
    pixel for images.

    If the training links have several carriers, distances combine place and frequency, d² = |dx|² +
    (s d ln f)². ``fit`` chooses the scale s [m] that predicts known links from links at other
    places with the least squared error.

    Args:
        k: Number of neighbours; with fewer known links, all of them. None: 3; for noisy labels the
            number in ``COUNTS`` with the best cross-validation, see
            ``gaigs.kriging.links.folds_of``.
        power: Exponent of the distance; 0 weights all neighbours equally. None: 2, or 1 for noisy
            labels.

    Attributes:
        chosen: Number of neighbours in use.
        scale: s [m]; NaN with one carrier.
        home: Scene of the known links; ``scene`` differs in a copy for other receivers.

    Source: look-up in the README of the NeRF² data sets; Shepard, 1968.
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
        self.home = scene

    @property
    def any_receiver(self) -> bool:  # type: ignore[override]
        """True if the receivers are places of one radio; neighbours are then near at both ends."""
        return self.scene.one_radio

    def fit(self, links: Links) -> None:
        """Stores the links; chooses the scale of frequencies, and the number of neighbours."""
        self.links, self.known = links, known_links(links)
        self.scale = math.nan
        self.chosen = self.k or 3
        if self.scene.has_band:
            low, high = (math.log10(bound) for bound in scale_bounds(self.scene))
            scales = torch.logspace(low, high, 16, dtype=torch.float64).tolist()
            self.scale = min(scales, key=self._squared_error)
        if self.k is None:
            folds = [folds_of(links, index) for index in self.known]
            held_out = [*self._held_out(folds)]
            self.chosen = min(COUNTS, key=lambda count: self._cost(count, held_out))

    def get_extra_state(self) -> dict:
        state = super().get_extra_state()
        return state if self.home is self.scene else {**state, "home": self.home.state()}

    def set_extra_state(self, state: dict) -> None:
        super().set_extra_state(state)
        if "home" in state:  # a copy at other receivers
            self.home = Scene.from_state(state["home"])

    def facts(self) -> dict[str, float]:
        """``neighbours`` if they were chosen, and with several carriers ``frequency_scale_m``."""
        facts: dict[str, float] = {"neighbours": self.chosen} if self.k is None else {}
        return facts if math.isnan(self.scale) else {**facts, "frequency_scale_m": self.scale}

    def forward(self, batch: Batch) -> Prediction:
        query = batch.query
        labels = torch.empty(len(query), *self.scene.task.shape, dtype=self.scene.task.dtype)
        radios = self.scene.radio_of(query.receivers)
        for radio in radios.unique():
            is_here = radios == radio
            index = self.known[radio]
            if not self.scene.task.shape:  # links may be too many for a matrix of all distances
                labels[is_here] = self._levels(query[is_here], index, self.chosen + 1)
                continue
            apart = self._distances(query[is_here], index, self.scale)
            labels[is_here] = self._look_up(apart, index)
        return Prediction(at_directions(labels, batch, self.scene), {})

    def _distances(
        self, query: Query, index: Int[Tensor, " k"], scale: float
    ) -> Float[Tensor, "b k"]:
        """Distances from the places of links to the places of known links [m]."""
        asked = coordinates(self.scene, query, scale)
        known = coordinates(self.home, self.links.query[index], scale)
        return distances(asked, known)

    def _levels(
        self, query: Query, index: Int[Tensor, " k"], count: int, size: int = 2**20
    ) -> Float[Tensor, " b"]:
        """Predictions of scalar labels for a receiver with known links ``index``.

        The function averages the ``count`` nearest known links by ``_weights``. Where links beyond
        these may be as near as the last neighbour in use, it calls itself with four times
        ``count``. At most ``size`` distances are in memory.
        """
        asked = coordinates(self.scene, query, self.scale)
        known = coordinates(self.home, self.links.query[index], self.scale)
        near = nearest_places(asked, known, count)
        labels = self._mean(near, index)
        if count < len(index):
            # Several links at one place are equally near: all must count.
            is_tied = near.apart[:, -1] <= near.apart[:, self.chosen - 1]
            tied_rows = is_tied.nonzero()[:, 0]
            for rows in tied_rows.split(max(1, size // (4 * count))):
                labels[rows] = self._levels(query[rows], index, 4 * count, size)
        return labels

    def _weights(self, apart: Float[Tensor, "b j"]) -> Float[Tensor, "b j"]:
        """Weights of known links in a mean, by their distances [m]; each row has the sum 1.

        Weights are 0 beyond the last neighbour, and at an infinite distance.
        """
        nearest = apart.topk(min(self.chosen, apart.shape[1]), largest=False).values
        is_near = (apart <= nearest[:, -1:]) & apart.isfinite()
        # A transmitter within a micrometre of a measured one gets that label.
        apart = apart.clamp_min(1e-6)
        # 1 / apart^power would overflow, so distances are relative to the least.
        weights = is_near * (apart.amin(1, keepdim=True) / apart) ** self.power
        return weights / weights.sum(1, keepdim=True)

    def _mean(self, near: Near, index: Int[Tensor, " k"]) -> Float[Tensor, " b"]:
        """Weighted means of the labels of the nearest known links, for scalar labels."""
        labels = self.links.labels[index]
        return (self._weights(near.apart).to(labels) * labels[near.rows]).sum(1)

    def _look_up(self, apart: Float[Tensor, "b k"], index: Int[Tensor, " k"]) -> Tensor:
        """Weighted means (b, *shape) of the labels of known links, for labels with a shape."""
        weights = self._weights(apart)
        is_used = weights.any(0)  # by any of the b links
        labels = self.links.labels[index[is_used]]
        nearest = apart[:, is_used].argmin(1).tolist()
        means = []
        for link_weights, first in zip(weights[:, is_used], nearest, strict=True):
            rows = link_weights.nonzero()[:, 0]
            # Unknown phases would cancel in a mean: all are aligned to the nearest link's.
            aligned = self.scene.task.align(labels[rows], labels[first : first + 1])
            means.append(torch.tensordot(link_weights[rows].to(labels), aligned, 1))
        return torch.stack(means)

    def _held_out(self, folds: Sequence[Int[Tensor, " _"]] | None = None) -> Iterator[HeldOutLinks]:
        """Yields groups of at most 32 held-out links of a receiver; about 256 links in all.

        All known links at the place of a held-out link are held out, too. ``folds`` holds the fold
        of each known link of each receiver; with it the whole fold of a held-out link is held out.
        """
        links_per_receiver = max(1, 256 // len(self.known))
        for receiver, index in enumerate(self.known):
            sample = evenly(torch.arange(len(index)), links_per_receiver)
            for rows in sample.split(32):
                asked, known = self.links.query[index[rows]], self.links.query[index]
                is_hidden = (asked.transmitters[:, None] == known.transmitters).all(-1)  # (h, k)
                if folds is not None:
                    is_hidden |= folds[receiver][rows][:, None] == folds[receiver]
                apart = self._distances(asked, index, self.scale).masked_fill(is_hidden, math.inf)
                has_others = apart.isfinite().any(1)  # a place may be the only one
                if has_others.any():
                    yield HeldOutLinks(rows[has_others], apart[has_others], index)

    def _predicted(self, held_out: HeldOutLinks) -> tuple[Tensor, Tensor]:
        """Labels of held-out links, aligned to the predictions, and their predictions."""
        if self.scene.task.shape:
            values = self._look_up(held_out.apart, held_out.index)
        else:
            # More than the largest number of neighbours, since several links may be equally near.
            count = min(4 * max(COUNTS), len(held_out.index))
            near = Near(*held_out.apart.topk(count, largest=False))
            values = self._mean(near, held_out.index)
        labels = self.links.labels[held_out.index[held_out.rows]]
        return self.scene.task.align(labels, values), values

    def _squared_error(self, scale: float) -> float:
        """Mean squared error of held-out links with a scale of frequencies [m].

        Sets ``scale``.
        """
        self.scale = scale
        errors = []
        for held_out in self._held_out():
            labels, values = self._predicted(held_out)
            errors.append((values - labels).abs().double().square().flatten())
        return torch.cat(errors).mean().item() if errors else 0.0

    def _cost(self, count: int, groups: Sequence[HeldOutLinks]) -> float:
        """Mean monitored score of held-out links with ``count`` neighbours; lower is better.

        Sets ``chosen`` to ``count``.
        """
        self.chosen = count
        task = self.scene.task
        scores = []
        for held_out in groups:
            labels, values = self._predicted(held_out)
            scores.append(task.scores(labels, values)[task.monitor])
        mean = torch.cat(scores).mean().item() if scores else 0.0
        return -mean if task.higher_is_better else mean
