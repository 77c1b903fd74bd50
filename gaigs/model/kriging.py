"""A trained model with kriging: a Gaussian process over places predicts its residuals."""

import logging
import math
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gaigs.calibration.held_out import Unseen, validation_halves
from gaigs.core import stages
from gaigs.core.query import Batch, evenly, thin_labels
from gaigs.core.scene import Scene
from gaigs.core.task import Task
from gaigs.data import Links
from gaigs.kriging.field import Field
from gaigs.kriging.fit import FEWEST, Hyperparameters, damping, fit_hyperparameters
from gaigs.kriging.kernel import LIMIT, Process
from gaigs.kriging.links import (
    PART,
    coordinates,
    folds_of,
    scaled,
    single_readings,
    thinned,
    without_gross_errors,
)
from gaigs.kriging.paths import Equations, PathField, PathProcess
from gaigs.kriging.scalar import ScalarProcess
from gaigs.model import LookUp, Model, Prediction, Wrapper
from gaigs.model.answers import predicted
from gaigs.registry import name_of, register, registry

log = logging.getLogger(__name__)

WEIGHTS = (1.0, 0.75, 0.5, 0.25, 0.0)
"""Candidates of ``trend_weight`` and ``weight``; of equally good ones the first is taken."""


@register("model", "kriging")
class Kriging(Wrapper):
    """weight (trend_weight trend + (1 - trend_weight) fallback + z) + (1 - weight) trend, z the
    kriged residual.

    The trend is a trained model. The fallback is a model that is fitted at once. z is the mean of a
    Gaussian process over places, as in ``gaigs.model.gaussian_process``, and 0 far from all known
    links. With a trend weight of 0 and a weight of 1 this is that process, but for the
    hyperparameters of labels of one real number.

    Trend weight, length and nugget maximise the likelihood of the validation links given the
    training links around them. The weight is the one with which the validation links, predicted
    from the training links, score best: the likelihood alone would trust kriging too far where
    cubes of space are held out.

    Labels of one real number have ``gaigs.kriging.scalar.ScalarProcess`` as z, with hyperparameters
    of each receiver. Their trend weight is the mean of the candidates, each as likely as it makes
    the validation links, with all readings of a place as one: without such links a half. Their
    weight is 1.

    Of a trend whose paths have ``margins``, strengths are kriged path by path, and phases stay
    those of the geometry. The process is always the same, and the weight 1 or 0. Where the
    validation links say that kriged labels are better by more than chance, as of places closer than
    half a wavelength, those are taken.

    A run makes it by ``kriging=true``. A checkpoint holds the residuals as a few principal
    components. Of a receiver with more than ``LIMIT`` known links an even part is used.

    Args:
        trend: The trained model, or its configuration if a state is to be loaded.
        fallback: Configuration of the model that takes the rest of the trend weight; None: each
            receiver's mean label.

    Raises:
        ValueError: The trend has no training, or the fallback is trained or needs its data.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, sections 2.2, 2.7
    and 5.4.2.
    """

    trend_weight: Tensor
    weight: Tensor
    hyperparameters: Tensor

    def __init__(self, scene: Scene, trend: dict | Model, fallback: dict | None = None):
        super().__init__(scene)
        self.trend = (
            trend if isinstance(trend, Model) else registry("model").build(trend, scene=scene)
        )
        if not [*self.trend.parameters()]:
            raise ValueError(
                f"kriging needs a trained model, got {name_of(self.trend)}; leave kriging out"
            )
        self.fallback_options = {"name": "mean"} if fallback is None else fallback
        self.fallback = registry("model").build(self.fallback_options, scene=scene)
        if (
            isinstance(self.fallback, LookUp)
            or not self.fallback.state_dict()
            or [*self.fallback.parameters()]
        ):
            name = self.fallback_options["name"]
            raise ValueError(f"kriging_fallback cannot be {name}; take mean, path_loss or friis")
        self.chunk = self.trend.chunk
        self.register_buffer("trend_weight", torch.tensor(1.0, dtype=torch.float64))
        self.register_buffer("weight", torch.tensor(1.0, dtype=torch.float64))
        self.register_buffer("hyperparameters", torch.full((3,), math.nan, dtype=torch.float64))
        self.is_scalar = scene.task.is_scalar
        if self.is_scalar:
            self.process = ScalarProcess(scene)
        self._make_fields(self.trend.has_margins)

    def _make_fields(self, by_paths: bool) -> None:
        self.by_paths = by_paths
        if not self.is_scalar:
            fields = (PathField() if by_paths else Field(self.scene) for _ in self.scene.receivers)
            self.fields = nn.ModuleList(fields).to(self.weight.device)

    def _load_from_state_dict(self, state_dict, prefix, *args):
        self._make_fields(f"{prefix}fields.0.precisions" in state_dict)
        super()._load_from_state_dict(state_dict, prefix, *args)

    def fit(self, links: Links) -> None:
        """Kriges the residuals of the trend, which must be trained."""
        self.krige(links)

    @torch.no_grad()
    def krige(self, links: Links, is_final: bool = True, by_paths: bool | None = None) -> "Kriging":
        """Fits, and gives the validation model: the same weights and hyperparameters on the
        training links alone.

        If not ``is_final``, only the validation model is fitted, without a word. ``by_paths`` says
        if strengths of paths are kriged, or whole labels; None: ``FEWEST`` validation links or more
        choose.
        """
        if self.is_scalar:
            links = without_gross_errors(links)
        count, links = len(links.split.known), thinned(links, self._most(links))
        if is_final and math.isfinite(stages.left()) and len(links.split.known) < count:
            stages.leave_out(f"kriging has {len(links.split.known)} of {count} known links")
        values, held = predicted(self.trend, links, links.split.known), links.split.validation
        self.fallback.fit(links)
        has_paths = self.trend.has_margins
        is_few = len(single_readings(links, held)) < FEWEST
        if by_paths or (has_paths and by_paths is None and is_few):
            return self._krige_paths(links, values, is_final)
        if has_paths and by_paths is None:
            models = (
                self._krige_labels(links, values, False),
                self._krige_paths(links, values, is_final),
            )
            scores = self._validation_scores(
                links, (predicted(model, links, held) for model in models)
            )
            if not is_surely_better(*scores):
                return models[1]
            if is_final:
                log.warning(
                    "paths do not explain the channels: %s on validation links is %.3g, of kriged labels %.3g\n"
                    "the prediction is that of kriged labels",
                    links.task.monitor,
                    *(score.mean() for score in scores[::-1]),
                )
        return self._krige_labels(links, values, is_final)

    def _most(self, links: Links) -> int:
        """Most known links of a receiver: ``LIMIT``, or those whose three predictions take a third
        of the time left.

        The trained model predicts the links once, and once more for each half of the validation
        links.
        """
        if math.isinf(stages.left()):
            return LIMIT
        some = evenly(links.split.known, 64)
        predicted(self.trend, links, some[:1])  # the first prediction compiles and loads
        began = time.monotonic()
        predicted(self.trend, links, some)
        each = max(time.monotonic() - began, 1e-9) / len(some)
        return int(min(LIMIT, max(100, stages.left() / 9 / each / len(links.receivers))))

    def _validation_scores(
        self, links: Links, values: Iterable[Tensor]
    ) -> list[Float[Tensor, " k"]]:
        """Monitored scores of predictions of the validation links, higher ones better."""
        task, labels = links.task, links.labels[links.split.validation]
        sign = 1 if task.higher_is_better else -1
        return [sign * task.scores(labels, part)[task.monitor].double() for part in values]

    def _krige_labels(self, links: Links, values: Tensor, is_final: bool) -> "Kriging":
        """``krige`` of whole labels; ``values`` are the trend's predictions of known links."""
        self._make_fields(False)
        held, trend = links.split.validation, values[len(links.split.train) :]
        model = self._validation_model(links, values)
        is_unlearnt = False
        if len(held):
            own, other = self._validation_scores(
                links, (trend, predicted(model.fallback, links, held))
            )
            is_unlearnt = is_surely_better(other, own)
        if is_unlearnt and not self.is_scalar:
            # The likelihood may still mix it in: where the score is higher without it, it is left
            # out.
            models = model, self._validation_model(links, values, (0.0,))
            scores = self._validation_scores(links, (predicted(one, links, held) for one in models))
            model = models[int(scores[1].mean() > scores[0].mean())]
            for name in ("trend_weight", "hyperparameters", "weight"):
                getattr(self, name).copy_(getattr(model, name))
        if is_final:
            self._solve(links, values)
            if is_unlearnt:
                name = self.fallback_options["name"]
                log.warning(
                    "the room was not learnt: %s on validation links is %.3g, that of %s %.3g\n"
                    "the prediction falls back on kriging of %s, with %.0f %% of the trained model",
                    *(links.task.monitor, own.mean().abs(), name, other.mean().abs(), name),
                    100 * (1 - self.weight * (1 - self.trend_weight)),
                )
            self._log()
        return model

    def _validation_model(
        self, links: Links, values: Tensor, weights: Sequence[float] = WEIGHTS
    ) -> "Kriging":
        """Fits weights and hyperparameters, the trend weight one of ``weights``; a model of the
        training links.
        """
        split = links.split
        self._fit_trend_weight(links, values, weights)
        training = replace(links, split=split.validating())
        model = Kriging(self.scene, self.trend, self.fallback_options)
        model._make_fields(False)
        model.trend_weight.copy_(self.trend_weight)
        model.hyperparameters.copy_(self.hyperparameters)
        if self.is_scalar:
            model.process.load_state_dict(self.process.state_dict())
        model.fallback.fit(training)
        model._solve(training, values[: len(split.train)])
        model.to(self.weight.device)
        if len(split.validation) and not self.is_scalar:
            kriged, trend = predicted(model, links, split.validation), values[len(split.train) :]
            blends = (blend(links.task, kriged, trend, weight) for weight in WEIGHTS)
            means = [score.mean().item() for score in self._validation_scores(links, blends)]
            self.weight.fill_(WEIGHTS[means.index(max(means))])
            model.weight.copy_(self.weight)
        return model

    def _krige_paths(self, links: Links, values: Tensor, is_final: bool) -> "Kriging":
        """``krige`` for a trend of paths.

        The weight is 1 if ``FEWEST`` validation links or more have a mean score that rises by more
        than 1.5 standard errors, else 0.
        """
        self._make_fields(True)
        split, task, index = links.split, links.task, links.split.known
        query, labels = links.query[index], links.labels[index]
        aligned = task.align(labels, values)
        residuals = aligned - values
        trend: Any = self.trend
        device = self.weight.device
        equations, own = (
            [],
            [(query.receivers == receiver).nonzero()[:, 0] for receiver in range(len(self.fields))],
        )
        for rows in own:
            margins = lambda part, rows=rows: trend.margins(query[rows[part]].to(device)).cpu()
            equations.append(
                Equations.of(query.transmitters[rows], margins, aligned[rows], residuals[rows])
            )
        validation_model = Kriging(self.scene, self.trend, self.fallback_options)
        held = torch.arange(len(split.train), len(index))
        plain, kriged, process = (
            values[held],
            values[held].clone(),
            PathProcess.usual(self.scene.spacing),
        )
        for rows, field, known_ones in zip(own, validation_model.fields, equations, strict=True):
            field.solve(known_ones[rows < len(split.train)], process)
            for row in stages.track(rows[rows >= len(split.train)].tolist(), "kriging"):
                strengths = field(query.transmitters[row : row + 1].double(), process)[0]
                margins = trend.margins(query[row : row + 1].to(device)).cpu()[0]
                kriged[row - len(split.train)] += torch.tensordot(strengths.to(kriged), margins, 1)
        enough = len(single_readings(links, split.validation)) >= FEWEST
        helps = enough and is_surely_better(
            *self._validation_scores(links, (kriged, plain)), errors=1.5
        )
        for model in (self, validation_model) if is_final else (validation_model,):
            model.trend_weight.fill_(1)
            model.weight.fill_(helps)
            model.hyperparameters.copy_(torch.tensor(process, dtype=torch.float64))
        for field, known_ones in zip(self.fields, equations, strict=True) if is_final else ():
            field.solve(known_ones, process)
        if is_final:
            self._log()
        self.fields.to(device)
        return validation_model.to(device)

    def process_at(self, receiver: int) -> Process | None:
        """The process of one receiver; None for kriged paths, whose strengths are processes."""
        if self.is_scalar:
            return self.process.at(receiver)
        if self.by_paths:
            return None
        field, process = self.fields[receiver], self._hyperparameters
        return process.at(scaled(field.places, 1 / process.scale), field.size(process).item() ** 2)

    @property
    def _hyperparameters(self) -> Any:
        """The buffer ``hyperparameters`` by name, of kriged paths or labels."""
        return (PathProcess if self.by_paths else Hyperparameters)(*self.hyperparameters.tolist())

    def _log(self) -> None:
        log.info(
            "kriging: %s",
            ", ".join(f"{name} {value:.3g}" for name, value in self.facts()["kriging"].items()),
        )

    def deviations(self, batch: Batch) -> Tensor:
        """Standard deviations of the labels; of spectra means over their pixels.

        Those of kriged paths have no noise, and treat paths as if the elements resolved them all.
        """
        query = batch.query
        if self.is_scalar:
            return self.process.deviations(coordinates(self.scene, query, 1.0), query.receivers)
        process = self._hyperparameters
        places = (
            query.transmitters if self.by_paths else coordinates(self.scene, query, process.scale)
        )
        found = places.new_zeros(len(query), *(self.scene.task.shape if self.by_paths else ()))
        trend: Any = self.trend
        for receiver in query.receivers.unique().tolist():
            own, field = query.receivers == receiver, self.fields[receiver]
            if self.by_paths:
                variances = field.variances(places[own].double(), process)
                squares = trend.margins(query[own]).abs().square()
                found[own] = (variances.to(squares)[..., None, None] * squares).sum(1).to(found)
            else:
                found[own] = field.deviations(places[own], process).square()
        return found.sqrt()

    def _fit_trend_weight(self, links: Links, values: Tensor, weights: Sequence[float]) -> None:
        """Fits the trend weight, one of ``weights``, and the hyperparameters; ``values`` as for
        ``_krige_labels``.
        """
        index = links.split.known
        rows = index.new_zeros(len(links)).index_copy(0, index, torch.arange(len(index)))
        residuals: dict[float, Any] = {trend_weight: [] for trend_weight in weights}
        for part in torch.arange(len(index)).split(PART):
            trio = (
                links.labels[index[part]],
                values[part],
                predicted(self.fallback, links, index[part]),
            )
            # Labels that are never turned count number by number, and few numbers are enough.
            labels, trend, fallback = (
                map(thin_labels, trio) if type(links.task).align is Task.align else trio
            )
            for trend_weight, parts in residuals.items():
                mean = blend(links.task, trend, fallback, trend_weight)
                parts.append(thin_labels(links.task.align(labels, mean) - mean))

        if self.is_scalar:
            query = links.query[index]
            left = [
                torch.cat(residuals[trend_weight]).flatten().double() for trend_weight in WEIGHTS
            ]
            readings, folds = (
                (coordinates(self.scene, query, 1.0), query.receivers),
                folds_of(links, index),
            )
            # Training links' own residuals are too small, as the trend was trained on them:
            # validation links decide.
            held = (
                torch.arange(len(links.split.train), len(index))
                if len(links.split.validation)
                else None
            )

            def refit(values: Tensor) -> float:
                self.process.logarithms, self.process.choice = start
                return self.process.refit(*readings, values, folds, held)

            # Maximisations of the likelihood: 5 of the fit, 2 of each refit, or 1 without
            # validation links.
            with stages.stage("kriging", 6 if held is None else 5 + 2 * (len(left) + 1)):
                self.process.cpu().fit(*readings, left[-1:], folds)
                start = self.process.logarithms, self.process.choice
                shares = torch.full((len(WEIGHTS),), 1 / len(WEIGHTS), dtype=torch.float64)
                if held is not None:
                    # Readings at one place err together: they count as one.
                    each = len(held) / len(query.transmitters[held].unique(dim=0))
                    costs = torch.tensor([refit(values) for values in left], dtype=torch.float64)
                    shares = torch.softmax(
                        -costs.clamp_min(-1e300) / each, 0
                    )  # -inf if a trend explains all
                refit(shares @ torch.stack(left))
            self.trend_weight.fill_(shares @ torch.tensor(WEIGHTS, dtype=torch.float64))
            return

        def fitted(trend_weight: float, **options: int) -> tuple[Hyperparameters, float]:
            left = torch.cat(residuals[trend_weight])
            if left.is_complex():
                left = (
                    left
                    * damping(left, thin_labels(links.labels[index]), links.query.receivers[index])[
                        :, None
                    ]
                )
            return fit_hyperparameters(self.scene, links, lambda some: left[rows[some]], **options)

        found = {
            trend_weight: fitted(trend_weight) for trend_weight in stages.track(weights, "kriging")
        }
        best = min(weights, key=lambda trend_weight: found[trend_weight][1])
        # Residuals of a good trend correlate weakly with position: few links would overfit.
        process, _ = fitted(best, most=1000) if best else found[best]
        self.trend_weight.fill_(best)
        self.hyperparameters.copy_(torch.tensor(process, dtype=torch.float64))

    def _solve(self, links: Links, values: Tensor) -> None:
        """Kriges the residuals of the known links."""
        index, trend_weight = links.split.known, self.trend_weight.item()
        query, labels = links.query[index], links.labels[index]

        def residuals(rows: Int[Tensor, " k"]) -> Tensor:
            left = torch.empty(len(rows), *self.scene.task.shape, dtype=self.scene.task.dtype)
            for part in torch.arange(len(rows)).split(PART):
                some = rows[part]
                mean = blend(
                    links.task,
                    values[some],
                    predicted(self.fallback, links, index[some]),
                    trend_weight,
                )
                left[part] = (links.task.align(labels[some], mean) - mean).to(left)
            if left.is_complex():
                left = left * damping(left, labels[rows], query.receivers[rows])[:, None, None]
            return left

        if self.is_scalar:
            left = residuals(torch.arange(len(index))).double()
            self.process.cpu().solve(coordinates(self.scene, query, 1.0), query.receivers, left)
            self.process.to(self.weight.device)
            return
        process = self._hyperparameters
        for receiver, field in enumerate(stages.track(self.fields, "kriging")):
            rows = (query.receivers == receiver).nonzero()[:, 0]
            field.solve(
                coordinates(self.scene, query[rows], process.scale), residuals(rows), process
            )

    def forward(self, batch: Batch) -> Prediction:
        query, trend_weight, weight = batch.query, self.trend_weight.item(), self.weight.item()
        # A part without weight is not evaluated: that would cost its time, and a NaN of it would
        # count.
        trend = self.trend(batch).value if trend_weight > 0 or weight < 1 else None
        if weight == 0:
            return Prediction(trend, {})
        task, fallback = self.scene.task, self.fallback(batch).value if trend_weight < 1 else None
        value = blend(task, trend, fallback, trend_weight)
        if self.is_scalar:
            levels = self.process(coordinates(self.scene, query, 1.0), query.receivers).to(value)
            return Prediction(blend(task, value + levels, trend, weight), {})
        process = self._hyperparameters
        places = (
            query.transmitters if self.by_paths else coordinates(self.scene, query, process.scale)
        )
        for receiver in query.receivers.unique().tolist():
            own = query.receivers == receiver
            if self.by_paths:
                strengths = self.fields[receiver](places[own].double(), process)
                margins = self.trend.margins(query[own])
                value[own] = value[own] + (strengths.to(value)[..., None, None] * margins).sum(1)
            else:
                value[own] = value[own] + self.fields[receiver](places[own], process.length, batch)
        return Prediction(blend(task, value, trend, weight), {})

    @property
    def any_frequency(self) -> bool:  # type: ignore[override]
        return self._alone.any_frequency

    def at_frequencies(self, frequencies: Float[Tensor, " s"]) -> Model:
        """The trend alone, or the fallback: residuals at other frequencies do not correlate with
        the known ones.
        """
        return self._alone.at_frequencies(frequencies)

    @property
    def fold_count(self) -> int:
        return 2

    def unseen(self, links: Links) -> Iterator[Unseen]:
        """Kriging of the training links with each half of the validation links, by whose other half
        its weights and hyperparameters are chosen; one group alone chooses, too.
        """
        if not len(links.split.validation):
            return
        for chooses, asked in validation_halves(links):
            if stages.is_up():
                return
            kriged = Kriging(links.scene, self.trend, self.fallback_options).to(self.device)
            half = replace(links, split=links.split.choosing(chooses))
            kriged = kriged.krige(half, is_final=False, by_paths=self.by_paths)
            yield Unseen(kriged, single_readings(links, asked), links.split.train)

    def take_hyperparameters(self, other: Model) -> None:
        if self.is_scalar and isinstance(other, Kriging):
            self.process.take(other.process)

    @property
    def _alone(self) -> Model:
        return self.trend if self.trend_weight > 0 else self.fallback

    @property
    def underlying(self) -> Model:
        return self.trend

    def facts(self) -> dict[str, Any]:
        """The trend's facts, and as ``kriging`` the weights, hyperparameters and sizes."""
        facts: dict[str, Any] = {
            "weight": self.weight.item(),
            "trend_weight": self.trend_weight.item(),
        }
        if self.is_scalar:
            facts |= {**self.process.facts(), "links": len(self.process.places)}
            return self.trend.facts() | {"kriging": facts}
        facts |= self._hyperparameters.facts()
        places = [len(field.places) for field in self.fields]
        facts["links"] = sum(places)
        if not self.by_paths:
            facts["components"] = max(len(field.components) for field in self.fields)
        return self.trend.facts() | {"kriging": facts}


def blend(task: Task, one: Tensor | None, other: Tensor | None, weight: float) -> Tensor:
    """weight one + (1 - weight) other, a tensor of its own; of channels of unknown phase, ``one``
    is aligned to ``other``. A part without weight may be None: it is not read, since a NaN of it
    would count.
    """
    if weight in (0, 1):
        return (one if weight else other).clone()
    return torch.add(weight * task.align(one, other), other, alpha=1 - weight)


def is_surely_better(
    one: Float[Tensor, " k"], other: Float[Tensor, " k"], *, errors: float = 2.0
) -> bool:
    """True if scores are higher by more than some standard errors; False of fewer than two."""
    gain = one - other
    return len(gain) > 1 and bool(gain.mean() > errors * gain.std() / math.sqrt(len(gain)))
