"""A baseline that predicts the mean of the known labels."""

import torch

from gaigs.core.propagation import common_gain
from gaigs.core.query import Batch
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.kriging.links import at_directions, known_links
from gaigs.model import Model, Prediction
from gaigs.registry import register


@register("model", "mean")
class Mean(Model):
    """Predicts each receiver's mean label for any transmitter; NaN before ``fit``.

    Channels of unknown phase are aligned to the phase of the first known link.
    """

    any_receiver = True
    of_receivers = ("means",)

    def __init__(self, scene: Scene):
        super().__init__(scene)
        shape = (scene.radios, *scene.task.shape)
        self.register_buffer("means", torch.full(shape, torch.nan, dtype=scene.task.dtype))

    def fit(self, links: Links) -> None:
        """Computes the means; a receiver without links gets ``common_gain`` of the other means."""
        known = known_links(links, any_receiver=True)
        for receiver, index in enumerate(known):
            if not len(index):
                continue
            wide = torch.promote_types(self.scene.task.dtype, torch.float64)
            first, align = links.labels[index[:1]], self.scene.task.align
            total = sum(
                align(links.labels[part], first).sum(0).to(wide) for part in index.split(256)
            )
            self.means[receiver] = (total / len(index)).to(self.means)
        is_known = torch.tensor([*map(len, known)]) > 0
        self.means[~is_known] = common_gain(self.means[is_known])

    def forward(self, batch: Batch) -> Prediction:
        means = self.means[self.scene.radio_of(batch.query.receivers)]
        return Prediction(at_directions(means, batch, self.scene), {})
