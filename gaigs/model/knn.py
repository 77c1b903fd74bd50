"""Inverse-distance weighting of the nearest training links: what a look-up scores."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.data import Links, Scene
from gaigs.model import Batch, Model, Prediction
from gaigs.model._known import known_links
from gaigs.registry import register


@register("model", "knn")
class KNearestNeighbours(Model):
    """The mean of the k training labels nearest to the transmitter, weighted by 1 / distance^power.

    Links that stand as near as the k-th count too, so it does not matter in which order they come. It keeps the whole
    training set, one byte a pixel where the labels are images.

    Args:
        k: Neighbours; as many as there are, if fewer.
        power: Of the distance; 0 weighs all neighbours alike.

    Raises:
        ValueError: ``k`` or ``power`` is out of range.

    Source: reference look-up of the data sets' own README; Shepard, 1968.
    """

    def __init__(self, scene: Scene, k: int, power: float = 2.0):
        super().__init__(scene)
        if k < 1:
            raise ValueError(f"model.k must be at least 1, got {k}")
        if not 0 <= power < math.inf:
            raise ValueError(f"model.power must be 0 or more, and finite, got {power}")
        self.k, self.power = k, power
        self.links, self.known = None, None

    def fit(self, links: Links) -> None:
        """Keeps the links.

        Raises:
            ValueError: A receiver has no links to learn from.
        """
        self.links, self.known = links, known_links(links)

    def forward(self, batch: Batch) -> Prediction:
        labels = self.links.labels[self.known[0][:0]]  # none, of the right shape
        labels = labels.new_empty(len(batch.transmitters), *labels.shape[1:])
        for receiver in batch.receivers.unique():
            own = batch.receivers == receiver
            labels[own] = self._look_up(batch.transmitters[own], self.known[receiver])
        return Prediction(labels, {})

    def _look_up(self, transmitters: Float[Tensor, "b 3"], index: Int[Tensor, "k"]) -> Tensor:
        """Labels of one receiver from its known links."""
        # Plain differences: by the matrix product, links at one place would get different distances.
        distances = torch.cdist(
            transmitters.double(),
            self.links.transmitters[index].double(),
            compute_mode="donot_use_mm_for_euclid_dist",
        )
        farthest = distances.topk(min(self.k, len(index)), largest=False).values[:, -1:]
        near = distances <= farthest
        # A transmitter that stands where one was measured, to a micrometre, gets that label.
        distances = distances.clamp_min(1e-6)
        weights = near * (distances.amin(1, keepdim=True) / distances) ** self.power  # relative: none is infinite
        weights = (weights / weights.sum(1, keepdim=True)).float()
        used = near.any(0)
        return torch.tensordot(weights[:, used], self.links.labels[index[used]], 1)
