"""Ensembles: models that differ by their seed alone, and so show how certain they are."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor, nn

from gaigs.core.query import Batch, evenly
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.model import Model, Prediction, Wrapper
from gaigs.registry import register, registry


@register("model", "ensemble")
class Ensemble(Wrapper):
    """The mean of trained models; a run trains them by ``ensemble=5``.

    Args:
        members: Trained models, or their configurations if a state is to be loaded.

    Attributes:
        typical: Mean square difference of the members, over all links.

    Example:
        >>> links = gaigs.links("synthetic_rssi", transmitters=50)
        >>> options = {"max_steps": 1, "count": 20, "enable_progress_bar": False}
        >>> model = gaigs.train("gaigs", links, ensemble=2, **options)
        >>> len(model.members)
        2

    Source: Lakshminarayanan, Pritzel and Blundell, Simple and scalable predictive uncertainty
    estimation using deep ensembles, 2017.
    """

    typical: Tensor

    def __init__(self, scene: Scene, members: list):
        super().__init__(scene)
        built = [
            one if isinstance(one, Model) else registry("model").build(one, scene=scene)
            for one in members
        ]
        self.members = nn.ModuleList(built)
        self.chunk, self.any_frequency = built[0].chunk, built[0].any_frequency
        self.register_buffer("typical", torch.tensor(0.0))

    @property
    def any_receiver(self) -> bool:  # type: ignore[override]
        return self.underlying.any_receiver

    @property
    def underlying(self) -> Model:
        """The first member, whose room and Gaussians stand for all."""
        return self.members[0]  # type: ignore[return-value]

    def rendering(self, batch: Batch) -> Callable[[], object] | None:
        """Renders by all members, one after the other."""
        parts = [member.rendering(batch) for member in self.members]  # type: ignore[operator]
        return None if None in parts else lambda: [part() for part in parts]

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Takes the mean square difference of the members at training links."""
        index = evenly(links.split.train, 256)
        device = self.typical.device
        parts = [self._squares(links.batch(part).to(device)) for part in index.split(32)]
        self.typical = torch.cat(parts).mean()

    def forward(self, batch: Batch) -> Prediction:
        return Prediction(self._each(batch).mean(0), {})

    def deviations(self, batch: Batch) -> Tensor:
        """Root mean square difference of the members, over the numbers of a label.

        A few members differ by chance: so the typical square counts as much as four of them.
        """
        count = len(self.members) - 1
        return ((count * self._squares(batch) + 4 * self.typical) / (count + 4)).sqrt()

    def _squares(self, batch: Batch) -> Tensor:
        """Variances of the members' labels, means over a label's numbers (b,)."""
        batch = replace(batch, directions=self.scene.task.directions)  # whichever are asked
        batch = batch.to(self.typical.device)
        return self._each(batch)[..., None].flatten(2).var(0).mean(1)

    def _each(self, batch: Batch) -> Tensor:
        """Values of all members (members, b, *shape)."""
        return torch.stack([member(batch).value for member in self.members])
