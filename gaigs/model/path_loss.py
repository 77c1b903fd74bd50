"""Log-distance path loss: the signal strength that distance alone explains."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.data import Links
from gaigs.kriging.links import known_links
from gaigs.model import Model, Prediction
from gaigs.query import Batch
from gaigs.registry import register
from gaigs.scene import Scene

NEAR = 0.1
"""Smaller distances count as this one [m]: within about a wavelength the field does not follow the law, and at 0 it
has no value."""

SPREAD = 1.01
"""Ratio of the largest to the smallest distance below which the slope is not determined: one unit of the exponent then
changes the labels by less than 0.05 dB."""


@register("model", "path_loss")
class PathLoss(Model):
    """T - 10 gamma log10(distance / 1 m) for each receiver, by least squares; NaN until it is fitted.

    It is meant for RSSI [dBm], and takes any task of one real number a link. Exponents are kept as fitted, negative
    ones too, which say that distance explains nothing there. Where all links of a receiver are equally long, gamma is
    2, that of free space, and only T is fitted.

    Raises:
        ValueError: A label is more than one real number.

    Source: Rappaport, Wireless Communications, 2nd edition, section 4.9.
    """

    def __init__(self, scene: Scene):
        super().__init__(scene)
        if scene.task.shape or scene.task.dtype.is_complex:
            raise ValueError(
                f"model path_loss must have one real number a link as label, got {scene.task.quantity} of shape "
                f"{scene.task.shape}; choose model=mean or model=knn"
            )
        self.register_buffer("levels", torch.full((len(scene.receivers),), torch.nan))  # T [dBm]
        self.register_buffer("exponents", torch.full((len(scene.receivers),), torch.nan))  # gamma

    def fit(self, links: Links) -> None:
        """Fits level and exponent of each receiver.

        Raises:
            ValueError: A receiver has no links to learn from.
        """
        for receiver, index in enumerate(known_links(links)):
            labels = links.labels[index].double()
            decades = self._decades(links.query.transmitters[index].double(), links.query.receivers[index])
            centred = decades - decades.mean()
            exponent = torch.tensor(2.0)
            if 10 ** (decades.max() - decades.min()) >= SPREAD:
                exponent = -(centred @ labels) / (10 * centred.square().sum())
            self.exponents[receiver] = exponent
            self.levels[receiver] = labels.mean() + 10 * exponent * decades.mean()

    def forward(self, batch: Batch) -> Prediction:
        receivers = batch.query.receivers
        decades = self._decades(batch.query.transmitters, receivers)
        return Prediction(self.levels[receivers] - 10 * self.exponents[receivers] * decades, {})

    def _decades(self, transmitters: Float[Tensor, "b 3"], receivers: Int[Tensor, "b"]) -> Float[Tensor, "b"]:
        """Logarithm of the distances [m] to base 10."""
        return (transmitters - self.scene.positions(transmitters)[receivers]).norm(dim=-1).clamp_min(NEAR).log10()
