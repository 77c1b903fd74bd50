"""Inverse-distance weighting of the nearest training links: what a look-up scores."""

import torch

from gaigs.data import Links, Scene
from gaigs.model import Batch, Model, Prediction
from gaigs.registry import register


@register("model", "knn")
class KNearestNeighbours(Model):
    """The mean of the k training labels nearest to the transmitter, weighted by the inverse squared distance.

    It keeps the whole training set, one byte a pixel where the labels are images.

    Args:
        k: Neighbours; as many as there are, if fewer.

    Source: reference look-up of the data sets' own README; Shepard, 1968.
    """

    def __init__(self, scene: Scene, k: int):
        super().__init__(scene)
        if k < 1:
            raise ValueError(f"model.k must be at least 1, got {k}")
        self.k = k
        self.links = None

    def fit(self, links: Links) -> None:
        self.links = links

    def forward(self, batch: Batch) -> Prediction:
        index = self.links.known(batch.receiver)
        positions = self.links.transmitters[index].double()
        squares = torch.cdist(batch.transmitters.double(), positions).square()
        nearest = squares.topk(min(self.k, len(index)), largest=False)
        # A transmitter that stands where one was measured gets that label: 1e-12 m² is a micrometre.
        weights = 1 / nearest.values.clamp_min(1e-12)
        weights = (weights / weights.sum(1, keepdim=True)).float()
        labels = self.links.labels[index[nearest.indices].flatten()].unflatten(0, weights.shape)
        return Prediction(torch.einsum("bk,bk...->b...", weights, labels), {})
