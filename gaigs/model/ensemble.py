"""Means of several models: of one model with several seeds, or of different models."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gaigs.calibration.held_out import Unseen
from gaigs.core.antenna import Receiver
from gaigs.core.query import Batch, evenly
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.kriging.kernel import Process
from gaigs.model import Model, Prediction, Wrapper
from gaigs.registry import register, registry


@register("model", "ensemble")
class Ensemble(Wrapper):
    """The mean of models; a run makes it by ``ensemble=5`` or by ``model=auto``.

    Args:
        members: Trained and fitted models, or their configurations if a state is to be loaded.
        weights: Weights of different models, with sum 1; None: equal weights of trained models that
            differ only in their seed.

    Attributes:
        typical: Variance of the members' predictions, averaged over links and values.

    Raises:
        ValueError: The weights do not match the members, or their sum is not 1.

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

    def __init__(self, scene: Scene, members: list, weights: list | None = None):
        super().__init__(scene)
        built = []
        for member in members:
            is_built = isinstance(member, Model)
            built.append(member if is_built else registry("model").build(member, scene=scene))
        self.members = nn.ModuleList(built)
        self.is_blend = weights is not None
        self.weights = [1 / len(built)] * len(built) if weights is None else weights
        are_shares = len(self.weights) == len(built) and min(self.weights) >= 0
        if not are_shares or abs(sum(self.weights) - 1) > 1e-6:
            raise ValueError(f"weights must be {len(built)} shares that sum to 1, got {weights}")
        chunks = [member.chunk for member in built if member.chunk is not None]
        self.chunk = min(chunks, default=None)
        self.register_buffer("typical", torch.tensor(0.0))

    @property
    def any_receiver(self) -> bool:  # type: ignore[override]
        return all(member.any_receiver for member in self._members)

    @property
    def any_frequency(self) -> bool:  # type: ignore[override]
        return all(member.any_frequency for member in self._members)

    @property
    def underlying(self) -> Model:
        """The first trained member; figures show its room and Gaussians."""
        return next((member for member in self._members if member.is_trained), self._members[0])

    @property
    def _members(self) -> list[Model]:
        return [*self.members]  # type: ignore[list-item]

    def rendering(self, batch: Batch) -> Callable[[], object] | None:
        """A function that renders with each member that has a rendering, in turn."""
        asked = (member.rendering(batch) for member in self._members)
        parts = [part for part in asked if part is not None]
        return (lambda: [part() for part in parts]) if parts else None

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Computes ``typical`` from training links."""
        index = evenly(links.split.train, 256)
        parts = [self._variances(links.batch(part).to(self.device)) for part in index.split(32)]
        self.typical = torch.cat(parts).mean()

    def forward(self, batch: Batch) -> Prediction:
        values = self._values_of_members(batch)  # (members, b, *shape)
        return Prediction(torch.tensordot(values.new_tensor(self.weights), values, 1), {})

    def deviations(self, batch: Batch) -> Tensor | None:
        """Standard deviations (b,) of the members' predictions, averaged over a label's values.

        Few members may agree by chance, so the ``typical`` variance counts as four more members. A
        blend of different models returns the weighted root mean square of its members' deviations,
        which may be (b, *shape); None if no member states any.
        """
        if not self.is_blend:
            freedom = len(self._members) - 1
            variances = (freedom * self._variances(batch) + 4 * self.typical) / (freedom + 4)
            return variances.sqrt()
        total: Any = 0.0
        weights = 0.0
        for weight, member in zip(self.weights, self._members, strict=True):
            stated = member.deviations(batch.to(member.device))  # (b,) or (b, *shape)
            if stated is None:
                continue
            # With the links as the last axis both shapes can be added.
            variances = stated.square().to(batch.query.transmitters.device).movedim(0, -1)
            total = total + weight * variances
            weights += weight
        return (total / weights).sqrt().movedim(-1, 0) if weights else None

    def process_at(self, receiver: int) -> Process | None:
        """The process of the first member that has one."""
        processes = (member.process_at(receiver) for member in self._members)
        return next((process for process in processes if process is not None), None)

    def facts(self) -> dict[str, Any]:
        return self.underlying.facts()

    def at_frequencies(self, frequencies: Float[Tensor, " s"]) -> Model:
        return self._of([member.at_frequencies(frequencies) for member in self._members])

    def at_receivers(
        self, receivers: Sequence[Receiver], known: Int[Tensor, " k"] | None = None
    ) -> Model:
        moved = self._of([member.at_receivers(receivers, known) for member in self._members])
        moved.take_calibration(self)
        return moved

    def unseen(self, links: Links) -> Iterator[Unseen]:
        """Yields models like this one, each with links that no member was trained on.

        If a member is trained, these are validation links, and look-ups are fitted without them.
        """
        if not self.is_blend or not self.is_trained:
            yield from super().unseen(links)
            return
        training = replace(links, split=links.split.validating())
        of_members = []  # for each member a list of ``Unseen``
        for member in self._members:
            if member.is_trained:
                of_members.append([*member.unseen(links)])
            else:
                refitted = member.refitted(training)
                of_members.append([Unseen(refitted, links.split.validation, links.split.train)])
        for combination in itertools.product(*of_members):
            asked = combination[0].asked
            for unseen in combination[1:]:
                asked = asked[torch.isin(asked, unseen.asked)]  # links that all members lack
            if len(asked):
                blend = self._of([unseen.model for unseen in combination])
                yield Unseen(blend, asked, links.split.train)

    def take_hyperparameters(self, other: Model) -> None:
        assert isinstance(other, Ensemble)
        for mine, theirs in zip(self._members, other._members, strict=True):
            mine.take_hyperparameters(theirs)

    def refitted(self, links: Links) -> Model:
        return self._of([member.refitted(links) for member in self._members])

    def _of(self, members: list) -> "Ensemble":
        """An ensemble of other members with the same weights."""
        other = Ensemble(members[0].scene, members, self.weights if self.is_blend else None)
        other.typical = self.typical
        return other.train(self.training)

    def _variances(self, batch: Batch) -> Tensor:
        """Variances of the members' predictions, averaged over a label's values (b,).

        They are those of the label's directions, even if the batch has others.
        """
        batch = replace(batch, directions=self.scene.task.directions)
        values = self._values_of_members(batch.to(self.device))  # (members, b, *shape)
        values = values[..., None].flatten(2)  # (members, b, numbers), also of scalar labels
        return values.var(0).mean(1)

    def _values_of_members(self, batch: Batch) -> Tensor:
        """Values of all members (members, b, *shape); look-ups run on the CPU."""
        device = batch.query.transmitters.device
        values = [member(batch.to(member.device)).value.to(device) for member in self._members]
        return torch.stack(values)
