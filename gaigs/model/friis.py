"""Free space: the direct wave, as if the room were empty."""

import torch
from jaxtyping import Complex
from torch import Tensor

from gaigs.data import Links
from gaigs.model import Model, Prediction
from gaigs.model._known import known_links
from gaigs.propagation import check_elements, direct_gains, direct_waves, phase_sign
from gaigs.query import Batch, Query
from gaigs.registry import register
from gaigs.scene import Scene


@register("model", "friis")
class Friis(Model):
    """h = g a lambda / (4 pi d) exp(-j 2 pi f d / c) at each element, with one complex gain g for each receiver.

    a is the elements' pattern towards the transmitter. The gain is the least-squares one over the known links, each
    weighed by its own power: it stands for transmit power, cables and the clock's phase. The sign of the phase is what
    the known links show, as either time convention is in use; -1 where they show none. NaN until it is fitted.

    Raises:
        ValueError: The labels are no channels, or an array has another number of elements than they.

    Source: Friis, A note on a simple transmission formula, 1946.
    """

    def __init__(self, scene: Scene):
        super().__init__(scene)
        check_elements("model 'friis'", scene)
        self.register_buffer("gains", torch.full((len(scene.receivers),), torch.nan, dtype=torch.complex64))
        self.register_buffer("sign", torch.tensor(-1))

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Fits sign and gains.

        Raises:
            ValueError: A receiver has no links to learn from.
        """
        known = known_links(links)
        index = torch.cat(known)
        labels, query = links.labels[index].to(torch.complex128), links.query[index]
        waves = direct_waves(self.scene, query, self.scene.task.frequencies)
        self.sign.fill_(phase_sign(labels, waves, query.receivers) or -1)
        for receiver, own in enumerate(known):
            labels, waves = links.labels[own].to(torch.complex128), self._waves(links.query[own])
            weights = 1 / labels.abs().square().sum((1, 2), keepdim=True)
            power = (weights * waves.abs().square()).sum()
            # An array that has all known links at its back hears nothing directly.
            gain = (weights * waves.conj() * labels).sum() / power if power > 0 else torch.zeros_like(power)
            self.gains[receiver] = gain.to(self.gains)

    def forward(self, batch: Batch) -> Prediction:
        waves = self._waves(batch.query).to(self.gains)
        return Prediction(self.gains[batch.query.receivers][:, None, None] * waves, {})

    def _waves(self, query: Query) -> Complex[Tensor, "b e s"]:
        """What each element hears of the direct wave at a gain of 1."""
        waves = direct_waves(self.scene, query, self.scene.task.frequencies, int(self.sign))
        return direct_gains(self.scene, query)[:, None, None] * waves
