"""The mean of the training labels: what any model must beat."""

import torch

from gaigs.data import Links, Scene
from gaigs.model import Batch, Model, Prediction
from gaigs.registry import register


@register("model", "mean")
class Mean(Model):
    """Predicts each receiver's mean training label, wherever the transmitter stands."""

    def __init__(self, scene: Scene):
        super().__init__(scene)
        self.register_buffer("means", torch.empty(0))

    def fit(self, links: Links) -> None:
        parts = []
        for receiver in range(len(links.receivers)):
            index = links.known(receiver)
            total = sum(links.labels[part].sum(0, dtype=torch.float64) for part in index.split(256))
            parts.append(total / len(index))
        self.means = torch.stack(parts).float()

    def forward(self, batch: Batch) -> Prediction:
        mean = self.means[batch.receiver]
        return Prediction(mean.expand(len(batch.transmitters), *mean.shape), {})
