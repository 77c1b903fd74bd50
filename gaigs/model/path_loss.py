"""Log-distance path loss: signal strength as a function of distance alone."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.data import Links
from gaigs.kriging.links import known_links
from gaigs.model import Model, Prediction
from gaigs.query import Batch
from gaigs.registry import register
from gaigs.scene import Scene


@register("model", "path_loss")
class PathLoss(Model):
    """T - 10 gamma log10(distance / 1 m) for each receiver, by least squares; NaN before ``fit``.

    It is meant for RSSI [dBm], and accepts any task of one real number a link. Negative exponents are kept: there
    distance explains nothing. If all links of a receiver are equally long, gamma is 2 as in free space, and only T is
    fitted. Distances below 0.1 m count as 0.1 m: within about a wavelength the field does not follow the law.

    Raises:
        ValueError: A label is more than one real number.

    Source: Rappaport, Wireless Communications, 2nd edition, section 4.9.
    """

    def __init__(self, scene: Scene):
        super().__init__(scene)
        if scene.task.shape or scene.task.dtype.is_complex:
            own = f"labels of task {scene.task.name!r}"
            raise ValueError(f"model 'path_loss' predicts one real number a link, not {own}; take mean or knn")
        self.register_buffer("levels", torch.full((len(scene.receivers),), torch.nan))  # T [dBm]
        self.register_buffer("exponents", torch.full((len(scene.receivers),), torch.nan))  # gamma

    def fit(self, links: Links) -> None:
        """Fits level and exponent of each receiver."""
        for receiver, index in enumerate(known_links(links)):
            labels = links.labels[index].double()
            decades = self._decades(links.query.transmitters[index].double(), links.query.receivers[index])
            centred = decades - decades.mean()
            exponent = torch.tensor(2.0)
            # Below a ratio of 1.01 one unit of the exponent changes the labels by less than 0.05 dB.
            if 10 ** (decades.max() - decades.min()) >= 1.01:
                exponent = -(centred @ labels) / (10 * centred.square().sum())
            self.exponents[receiver] = exponent
            self.levels[receiver] = labels.mean() + 10 * exponent * decades.mean()

    def forward(self, batch: Batch) -> Prediction:
        receivers = batch.query.receivers
        decades = self._decades(batch.query.transmitters, receivers)
        return Prediction(self.levels[receivers] - 10 * self.exponents[receivers] * decades, {})

    def _decades(self, transmitters: Float[Tensor, "b 3"], receivers: Int[Tensor, " b"]) -> Float[Tensor, " b"]:
        """log10 of the distances in [m]."""
        return (transmitters - self.scene.positions(transmitters)[receivers]).norm(dim=-1).clamp_min(0.1).log10()
