"""The mean of the training labels: what any model must beat."""

import torch

from gaigs.data import Links, Scene
from gaigs.model import Batch, Model, Prediction
from gaigs.model._known import known_links
from gaigs.registry import register


@register("model", "mean")
class Mean(Model):
    """Predicts each receiver's mean training label, wherever the transmitter stands; NaN until it is fitted."""

    def __init__(self, scene: Scene):
        super().__init__(scene)
        shape = scene.grid.shape if scene.grid else ()
        self.register_buffer("means", torch.full((len(scene.receivers), *shape), torch.nan))

    def fit(self, links: Links) -> None:
        """Takes the means.

        Raises:
            ValueError: A receiver has no links to learn from.
        """
        for receiver, index in enumerate(known_links(links)):
            total = sum(links.labels[part].sum(0, dtype=torch.float64) for part in index.split(256))
            self.means[receiver] = total / len(index)

    def forward(self, batch: Batch) -> Prediction:
        return Prediction(self.means[batch.receivers], {})
