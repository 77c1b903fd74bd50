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
        wide = torch.promote_types(self.scene.task.dtype, torch.float64)  # sums without rounding
        for receiver, index in enumerate(known):
            if not len(index):
                continue
            first = links.labels[index[:1]]
            total = torch.zeros_like(first[0], dtype=wide)
            for rows in index.split(256):  # labels may be too large for memory
                aligned = self.scene.task.align(links.labels[rows], first)
                total += aligned.sum(0).to(wide)
            self.means[receiver] = (total / len(index)).to(self.means)
        has_links = torch.tensor([len(index) for index in known]) > 0
        self.means[~has_links] = common_gain(self.means[has_links])

    def forward(self, batch: Batch) -> Prediction:
        means = self.means[self.scene.radio_of(batch.query.receivers)]
        return Prediction(at_directions(means, batch, self.scene), {})
