"""Free-space propagation: only the direct wave."""

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from gaigs.core.phases import TELLING
from gaigs.core.propagation import common_gain, fit_gain
from gaigs.core.query import Batch, Query
from gaigs.core.scene import Scene, check_elements, direct_gains, direct_waves
from gaigs.data import Links
from gaigs.kriging.links import known_links
from gaigs.model import Model, Prediction
from gaigs.registry import register


@register("model", "friis")
class Friis(Model):
    """h = g a lambda / (4 pi d) exp(-j 2 pi f d / c) at each element; each receiver has a gain g.

    a is the elements' pattern towards the transmitter. The complex gain g, ``fit_gain`` of the
    known links, contains transmit power, cables and the clock's phase; it is NaN before ``fit``.
    The sign of the phase is estimated from the known links, since both time conventions are in use.
    With fewer than ``TELLING`` links a receiver the sign is -1. If enough links support neither
    sign, gains are 0.

    Raises:
        ValueError: The labels are not channels, or their number of elements differs from the
            array's.

    Source: Friis, A note on a simple transmission formula, 1946.
    """

    any_frequency = True
    any_receiver = True
    of_receivers = ("gains",)

    def __init__(self, scene: Scene):
        super().__init__(scene)
        self.task = check_elements("model 'friis'", scene, pads=True)
        gains = torch.full((scene.radios,), torch.nan, dtype=torch.complex64)
        self.register_buffer("gains", gains)
        self.register_buffer("sign", torch.tensor(-1))

    @property
    def frequencies(self) -> Float[Tensor, " s"]:
        """The subcarriers of the present scene [Hz]; ``Model.at_frequencies`` replaces it."""
        return self.scene.task.frequencies

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Fits the sign and the gains."""
        known = known_links(links, any_receiver=True)
        index = torch.cat(known)
        labels, query = links.labels[index].to(torch.complex128), links.query[index]
        waves = direct_waves(self.scene, query, self.frequencies)
        labels = self.scene.equalised(query, labels)
        sign = self.task.phase_sign(labels, waves, self.scene.radio_of(query.receivers))
        self.sign.fill_(sign or -1)  # 0: unknown
        self.gains.zero_()
        has_few_links = len(index) < TELLING * len(known)
        if sign != 0 or has_few_links:
            for receiver, rows in enumerate(known):
                gain = fit_gain(links.labels[rows], self._waves(links.query[rows]))
                self.gains[receiver] = gain.to(self.gains)
        has_links = torch.tensor([len(rows) for rows in known]) > 0
        self.gains[~has_links] = common_gain(self.gains[has_links])

    def forward(self, batch: Batch) -> Prediction:
        waves = self._waves(batch.query).to(self.gains)
        gains = self.gains[self.scene.radio_of(batch.query.receivers)]
        return Prediction(gains[:, None, None] * waves, {})

    def _waves(self, query: Query) -> Complex[Tensor, "b e s"]:
        """The direct wave after each element's front end, with a gain of 1."""
        waves = direct_waves(self.scene, query, self.frequencies, int(self.sign))
        waves = direct_gains(self.scene, query)[:, None, None] * waves
        return self.scene.received(query, waves)
