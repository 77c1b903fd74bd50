"""A trained model with kriging: a Gaussian process over places predicts its residuals."""

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Int
from torch import Tensor, nn

from gaigs.data import Links, Split
from gaigs.gaussians import Gaussians
from gaigs.kriging.field import Field
from gaigs.kriging.fit import Hyperparameters, damping, fit_hyperparameters, thin_labels
from gaigs.kriging.kernel import LIMIT
from gaigs.kriging.links import PART, coordinates, thinned
from gaigs.model import Model, Prediction, call_optional
from gaigs.placement.learnt_room import LearntRoom
from gaigs.query import Batch
from gaigs.registry import name_of, register, registry
from gaigs.scene import Scene

log = logging.getLogger(__name__)

WEIGHTS = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Candidates of ``trend_weight`` and ``weight``; of equally good ones the first is taken."""


@register("model", "kriging")
class Kriging(Model):
    """weight (trend_weight trend + (1 - trend_weight) fallback + z) + (1 - weight) trend, z the kriged residual.

    The trend is a trained model. The fallback is a model that is fitted at once. z is the mean of a Gaussian process
    over places, as in ``gaigs.model.gaussian_process``, and 0 far from all known links. With a trend weight of 0 and a
    weight of 1 this is that process.

    Trend weight, length and nugget maximise the likelihood of the validation links given the training links around
    them. The weight is the one with which the validation links, predicted from the training links, score best: the
    likelihood alone would trust kriging too far where cubes of space are held out.

    A run makes it by ``kriging=true``. A checkpoint holds the residuals as a few principal components. Of a receiver
    with more than ``LIMIT`` known links an even part is used.

    Args:
        trend: The trained model, or its configuration if a state is to be loaded.
        fallback: Configuration of the model that takes the rest of the trend weight; None: each receiver's mean label.

    Raises:
        ValueError: The trend has no training, or the fallback is trained or needs its data.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, sections 2.2, 2.7 and 5.4.2.
    """

    trend_weight: Tensor
    weight: Tensor
    hyperparameters: Tensor

    def __init__(self, scene: Scene, trend: dict | Model, fallback: dict | None = None):
        super().__init__(scene)
        self.trend = trend if isinstance(trend, Model) else registry("model").build(trend, scene=scene)
        if not [*self.trend.parameters()]:
            raise ValueError(f"kriging needs a trained model, got {name_of(self.trend)}; leave kriging out")
        self.fallback_options = {"name": "mean"} if fallback is None else fallback
        self.fallback = registry("model").build(self.fallback_options, scene=scene)
        if not self.fallback.state_dict() or [*self.fallback.parameters()]:
            name = self.fallback_options["name"]
            raise ValueError(f"kriging_fallback cannot be {name}; take mean, path_loss or friis")
        self.chunk = self.trend.chunk
        self.register_buffer("trend_weight", torch.tensor(1.0, dtype=torch.float64))
        self.register_buffer("weight", torch.tensor(1.0, dtype=torch.float64))
        self.register_buffer("hyperparameters", torch.full((3,), math.nan, dtype=torch.float64))
        self.fields = nn.ModuleList(Field(scene) for _ in scene.receivers)

    def fit(self, links: Links) -> None:
        """Kriges the residuals of the trend, which must be trained."""
        self.krige(links)

    @torch.no_grad()
    def krige(self, links: Links) -> "Kriging":
        """Fits, and gives the validation model: the same weights and hyperparameters on the training links alone."""
        links = thinned(links, LIMIT)
        split = links.split
        values = predicted(self.trend, links, known(links))
        self.fallback.fit(links)
        self._fit_trend_weight(links, values)
        self._solve(links, values)
        training = replace(links, split=Split(split.name, split.train, split.validation[:0], split.validation))
        validation_model = Kriging(self.scene, self.trend, self.fallback_options)
        validation_model.trend_weight.copy_(self.trend_weight)
        validation_model.hyperparameters.copy_(self.hyperparameters)
        validation_model.fallback.fit(training)
        validation_model._solve(training, values[: len(split.train)])
        validation_model.to(self.weight.device)
        if len(split.validation):
            labels, trend = links.labels[split.validation], values[len(split.train) :]
            kriged = predicted(validation_model, links, split.validation)
            task, sign = links.task, 1 if links.task.higher_is_better else -1
            score = lambda weight: task.scores(labels, trend + weight * (kriged - trend))[task.monitor].mean().item()
            best = max(WEIGHTS, key=lambda weight: sign * score(weight))
            self.weight.fill_(best)
            validation_model.weight.fill_(best)
        log.info("kriging: %s", ", ".join(f"{name} {value:.3g}" for name, value in self.facts()["kriging"].items()))
        return validation_model

    def _fit_trend_weight(self, links: Links, values: Tensor) -> None:
        """Fits the trend weight and the hyperparameters; ``values`` are the trend's predictions of known links."""
        index = known(links)
        rows = index.new_zeros(len(links)).index_copy(0, index, torch.arange(len(index)))
        over, apart = [], []  # labels and trend, less the fallback
        for part in torch.arange(len(index)).split(PART):
            fallback = predicted(self.fallback, links, index[part])
            over.append(thin_labels(links.labels[index[part]] - fallback))
            apart.append(thin_labels(values[part] - fallback))
        over, apart = torch.cat(over), torch.cat(apart)

        def fitted(trend_weight: float, **options: int) -> tuple[Hyperparameters, float]:
            left = over - trend_weight * apart
            if left.is_complex():
                left = left * damping(left, thin_labels(links.labels[index]), links.query.receivers[index])[:, None]
            return fit_hyperparameters(self.scene, links, lambda some: left[rows[some]], **options)

        found = {trend_weight: fitted(trend_weight) for trend_weight in WEIGHTS}
        best = min(WEIGHTS, key=lambda trend_weight: found[trend_weight][1])
        # Residuals of a good trend correlate weakly with position: few links would overfit.
        process, _ = fitted(best, most=1000) if best else found[best]
        self.trend_weight.fill_(best)
        self.hyperparameters.copy_(torch.tensor(process, dtype=torch.float64))

    def _solve(self, links: Links, values: Tensor) -> None:
        """Kriges the residuals of the known links."""
        index, trend_weight = known(links), self.trend_weight.item()
        receivers = links.query.receivers[index]
        for receiver, field in enumerate(self.fields):
            rows = (receivers == receiver).nonzero()[:, 0]
            residuals = torch.empty(len(rows), *self.scene.task.shape, dtype=self.scene.task.dtype)
            for part in torch.arange(len(rows)).split(PART):
                some = index[rows[part]]
                rest = (1 - trend_weight) * predicted(self.fallback, links, some)
                residuals[part] = links.labels[some] - trend_weight * values[rows[part]] - rest
            if residuals.is_complex():
                residuals = residuals * damping(residuals, links.labels[index[rows]], receivers[rows])[:, None, None]
            process = Hyperparameters(*self.hyperparameters.tolist())
            field.solve(coordinates(self.scene, links.query[index[rows]], process.scale), residuals, process)

    def forward(self, batch: Batch) -> Prediction:
        query, trend_weight, weight = batch.query, self.trend_weight.item(), self.weight.item()
        length, _, scale = self.hyperparameters
        # A part without weight is not evaluated: that would cost its time, and a NaN of it would count.
        trend = self.trend(batch).value if trend_weight > 0 or weight < 1 else None
        if weight == 0:
            return Prediction(trend, {})
        value = 0 if trend_weight == 0 else trend_weight * trend
        if trend_weight < 1:
            value = value + (1 - trend_weight) * self.fallback(batch).value
        places = coordinates(self.scene, query, scale)
        for receiver in query.receivers.unique().tolist():
            own = query.receivers == receiver
            value[own] = value[own] + self.fields[receiver](places[own], length, batch)
        return Prediction(value if weight == 1 else trend + weight * (value - trend), {})

    @property
    def primitives(self) -> Gaussians | None:  # type: ignore[override]
        return self.trend.primitives

    def facts(self) -> dict[str, Any]:
        """The trend's facts, and as ``kriging`` the weights, hyperparameters and sizes."""
        facts = {"weight": self.weight.item(), "trend_weight": self.trend_weight.item()}
        facts |= Hyperparameters(*self.hyperparameters.tolist()).facts()
        places, components = ([len(getattr(field, name)) for field in self.fields] for name in ("places", "components"))
        facts |= {"links": sum(places), "components": max(components)}
        return (call_optional(self.trend, "facts") or {}) | {"kriging": facts}

    def rendering(self, batch: Batch) -> Callable[[], object] | None:
        return call_optional(self.trend, "rendering", batch)

    def learnt_room(self, links: Links) -> LearntRoom | None:
        return call_optional(self.trend, "learnt_room", links)

    def export(self, folder: Path) -> None:
        call_optional(self.trend, "export", folder)


def known(links: Links) -> Int[Tensor, " k"]:
    """Training and validation links, in this order."""
    return torch.cat((links.split.train, links.split.validation))


def predicted(model: Model, links: Links, index: Int[Tensor, " k"]) -> Tensor:
    """Predictions of a model for some links, on the CPU."""
    return torch.cat([values.cpu() for values in model.predict_batches(links.query[index], batch_size=64)])
