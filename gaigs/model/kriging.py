"""A trained model with kriging: a Gaussian process over places predicts its residuals."""

import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.calibration.held_out import Unseen, validation_halves
from gaigs.core import stages
from gaigs.core.antenna import Receiver
from gaigs.core.query import Batch, drawn, evenly
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.kriging.blend import blend, is_surely_better, validation_scores
from gaigs.kriging.field import FieldPosterior
from gaigs.kriging.fit import FEWEST
from gaigs.kriging.kernel import LIMIT, Process
from gaigs.kriging.links import PART, coarse, limit_known, single_readings
from gaigs.kriging.paths import PathPosterior
from gaigs.kriging.posterior import Posterior
from gaigs.kriging.scalar_posterior import ScalarPosterior
from gaigs.model import LookUp, Model, Prediction, Wrapper
from gaigs.model.answers import count_in_time, predicted, share_at_new, weighed_residuals
from gaigs.registry import name_of, register, registry

log = logging.getLogger(__name__)


@register("model", "kriging")
class Kriging(Wrapper):
    """A trained model, the trend, whose residuals are kriged. Predictions are

        weight (trend_weight trend + (1 - trend_weight) fallback + z) + (1 - weight) trend.

    The fallback is a simple model, fitted by this class. z is the mean of a Gaussian process over
    places, as in ``gaigs.model.gaussian_process``, and 0 far from all known links.

    Trend weight, length and nugget maximise the likelihood of the validation links given the
    training links around them. The weight maximises the score of validation links predicted from
    training links. By likelihood it would be too large if cubes of space are held out.

    z comes from one of three posteriors. ``ScalarPosterior`` is for scalar labels, with
    hyperparameters for each receiver. ``FieldPosterior`` is for other labels. ``PathPosterior``
    kriges the strengths of paths, for a trend with ``margins``, the deviations of its paths. The
    first and the last have a weight of 1 or 0. Labels are kriged instead of paths if this clearly
    improves the validation score, for example at places closer than half a wavelength.

    A run makes this model with ``kriging=true``. A checkpoint stores the residuals as a few
    principal components. If a receiver has more than ``LIMIT`` known links, an evenly spread part
    of them is used; scalar labels use all.

    Args:
        trend: The trained model, or its configuration if a state is to be loaded.
        fallback: Configuration of the fallback; None: ``mean``.

    Raises:
        ValueError: The trend is not a trained model, or the fallback is trained or needs its data.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, sections 2.2, 2.7
    and 5.4.2.
    """

    trend_weight: Tensor
    weight: Tensor
    new_weight: Tensor  # share of the trend at receivers without links; the fallback has the rest
    weights = (1.0, 0.75, 0.5, 0.25, 0.0)
    """Candidates of ``trend_weight`` and ``weight``; of equally good ones the first is taken."""
    laws: tuple[Model, Tensor] | None = None  # of ``law_scores``, and its training links
    chosen_by: Tensor | None = None
    """Links that chose the hyperparameters of a model of the training links alone; None: all."""

    def __init__(self, scene: Scene, trend: dict | Model, fallback: dict | None = None):
        super().__init__(scene)
        is_built = isinstance(trend, Model)
        self.trend: Model = trend if is_built else registry("model").build(trend, scene=scene)
        if not [*self.trend.parameters()]:
            raise ValueError(
                f"kriging needs a trained model, got {name_of(self.trend)}; leave kriging out"
            )
        self.fallback_options = {"name": "mean"} if fallback is None else fallback
        self.fallback = registry("model").build(self.fallback_options, scene=scene)
        keeps_links = isinstance(self.fallback, LookUp) or not self.fallback.state_dict()
        if keeps_links or [*self.fallback.parameters()]:
            name = self.fallback_options["name"]
            raise ValueError(f"kriging_fallback cannot be {name}; take mean, path_loss or friis")
        self.chunk = self.trend.chunk
        for name in ("trend_weight", "weight", "new_weight"):
            self.register_buffer(name, torch.tensor(1.0, dtype=torch.float64))
        self._make_posterior(self.trend.has_margins)

    def _make_posterior(self, by_paths: bool) -> None:
        """Sets a new posterior, for the strengths of the trend's paths or for the labels."""
        posterior: Posterior
        if self.scene.task.is_scalar:
            posterior = ScalarPosterior(self.scene)
            posterior.start = getattr(getattr(self, "posterior", None), "start", None)
        elif by_paths:
            posterior = PathPosterior(self.scene, self.trend.margins)
        else:
            posterior = FieldPosterior(self.scene)
        self.posterior: Any = posterior.to(self.weight.device)

    def _load_from_state_dict(self, state_dict, prefix, *args):
        # In older checkpoints parts of the posterior are parts of the model.
        for key in [*state_dict]:
            name = key.removeprefix(prefix)
            if name.startswith(("process.", "fields.", "hyperparameters")):
                state_dict[f"{prefix}posterior.{name}"] = state_dict.pop(key)
        state_dict.setdefault(f"{prefix}new_weight", torch.ones_like(self.new_weight))
        if self.scene.task.is_scalar:
            state_dict.pop(f"{prefix}posterior.hyperparameters", None)
        self._make_posterior(f"{prefix}posterior.fields.0.precisions" in state_dict)
        super()._load_from_state_dict(state_dict, prefix, *args)

    def fit(self, links: Links) -> None:
        """Kriges the residuals of the trend, which must be trained."""
        self.krige(links)

    @torch.no_grad()
    def krige(
        self,
        links: Links,
        is_final: bool = True,
        by_paths: bool | None = None,
        most: int | None = None,
    ) -> "Kriging":
        """Fits this model, and returns its validation model.

        The validation model has the same hyperparameters and weights, but knows only the training
        links.

        Args:
            links: Links with a split.
            is_final: False if only the validation model is needed: this model then stores no
                residuals, and nothing is logged.
            by_paths: True to krige strengths of paths, False to krige labels. None: the validation
                links choose, if there are at least ``FEWEST``; otherwise paths.
            most: Largest number of known links of a receiver; None: ``LIMIT``, or all for scalar
                labels.
        """
        links = self.posterior.cleaned(links)
        count = len(links.split.known)
        if most is None:
            most = max(1, count) if links.task.is_scalar else LIMIT
        links = limit_known(links, count_in_time(self.trend, links, most))
        if is_final and math.isfinite(stages.left()) and len(links.split.known) < count:
            stages.leave_out(f"kriging has {len(links.split.known)} of {count} known links")
        self.fallback.fit(links)
        if links.task.is_scalar:
            return self._krige_labels(links, None, is_final)
        values = predicted(self.trend, links, links.split.known)
        if by_paths is None and self.trend.has_margins:
            is_few = len(single_readings(links, links.split.validation)) < FEWEST
            return self._krige_better(links, values, is_final, is_few)
        krige = self._krige_paths if by_paths else self._krige_labels
        return krige(links, values, is_final)

    def law_scores(self, links: Links, held: Int[Tensor, " h"]) -> Float[Tensor, " h"]:
        """Scores of validation links by a path-loss model (stored), which may replace the trend."""
        train, task = links.split.train, self.scene.task
        if self.laws is None or not torch.equal(self.laws[1], train):
            # For levels the law has more terms than the distance to a receiver.
            options = task.trends[-1] if task.is_scalar else self.fallback_options
            self.laws = registry("model").build(options, scene=self.scene), train
            self.laws[0].fit(replace(links, split=links.split.validating()))
        return validation_scores(links, predicted(self.laws[0], links, held), held)

    def _krige_better(
        self, links: Links, values: Tensor, is_final: bool, is_few: bool
    ) -> "Kriging":
        """``krige`` by paths, or by labels if these clearly improve enough validation links."""
        if is_few:
            return self._krige_paths(links, values, is_final)
        of_labels = self._krige_labels(links, values, False)
        of_paths = self._krige_paths(links, values, is_final)
        held = links.split.validation
        scores = validation_scores(links, predicted(of_labels, links, held))
        path_scores = validation_scores(links, predicted(of_paths, links, held))
        if not is_surely_better(scores, path_scores):
            return of_paths
        if is_final:
            log.warning(
                "paths do not explain the channels: %s on validation links is %.3g, of kriged "
                "labels %.3g\nthe prediction is that of kriged labels",
                links.task.monitor,
                path_scores.mean(),
                scores.mean(),
            )
        return self._krige_labels(links, values, is_final)

    def _krige_labels(self, links: Links, values: Tensor | None, is_final: bool) -> "Kriging":
        """``krige`` with labels; a path-loss model may replace the trend.

        ``values`` are the trend's predictions of the known links, validation links last. None for
        scalar labels; they are then computed if the trend may have weight.
        """
        self._make_posterior(False)
        split, is_scalar = links.split, self.scene.task.is_scalar
        held = drawn(split.validation) if is_scalar else split.validation
        is_unlearnt = False
        at_held = None
        if len(held) and any(self.weights):
            at_held = predicted(self.trend, links, held) if values is None else values[-len(held) :]
            trend_scores = validation_scores(links, at_held, held)
            law_scores = self.law_scores(links, held)
            is_unlearnt = is_surely_better(law_scores, trend_scores)
        # A law of distance that is surely better than the learnt room: levels show no room.
        weights = (0.0,) if is_unlearnt and is_scalar else self.weights
        if values is None and any(weights):
            values = predicted(self.trend, links, split.known)
        elif values is None:  # without weight it is not read
            values = torch.full((len(split.known),), math.nan)
        model = self._validation_model(links, values, weights)
        if is_unlearnt and self.posterior.chooses_weight:
            # The likelihood may still give the trend weight; it gets none if that scores higher.
            without = self._validation_model(links, values, (0.0,))
            score = validation_scores(links, predicted(model, links, held)).mean()
            if validation_scores(links, predicted(without, links, held)).mean() > score:
                model = without
            # The second fit has replaced this model's choices: take the better model's.
            self._copy_choices(model)
        if split.by_receivers and is_scalar and at_held is not None:
            self.new_weight.fill_(share_at_new(links, held, at_held, model.fallback))
            model.new_weight.copy_(self.new_weight)
        if is_final:
            self._solve(links, values)
            if is_unlearnt and self.laws is not None:
                log.warning(
                    "the room was not learnt: %s on validation links is %.3g, that of %s %.3g\n"
                    "the prediction falls back on kriging of %s, with %.0f %% of the trained model",
                    links.task.monitor,
                    trend_scores.mean().abs(),
                    name_of(self.laws[0]),
                    law_scores.mean().abs(),
                    self.fallback_options["name"],
                    # The trend's share in the blend of the class's first line.
                    100 * (1 - self.weight * (1 - self.trend_weight)),
                )
            self._log()
        return model

    def _validation_model(
        self, links: Links, values: Tensor, weights: Sequence[float]
    ) -> "Kriging":
        """Fits trend weight and hyperparameters; returns a model of only the training links."""
        split = links.split
        candidates = weighed_residuals(links, self.fallback, values, weights)
        # A trend without weight gives no features either.
        features = self._features(values) if any(weights) else ()
        self.trend_weight.fill_(self.posterior.fit(links, candidates, *features))
        training = replace(links, split=split.validating())
        model = Kriging(self.scene, self.trend, self.fallback_options)
        model._make_posterior(False)
        model._copy_choices(self)
        model.posterior.is_lazy = True
        model.chosen_by = self.posterior.seen
        model.weight.fill_(1.0)
        model.fallback.fit(training)
        model._solve(training, values[: len(split.train)])
        model.to(self.weight.device)
        if len(split.validation) and self.posterior.chooses_weight:
            # The likelihood alone would trust kriging too far where cubes of space are held out.
            kriged = predicted(model, links, split.validation)
            trend = values[len(split.train) :]
            means = []
            for weight in self.weights:
                blended = blend(links.task, kriged, trend, weight)
                means.append(validation_scores(links, blended).mean().item())
            self.weight.fill_(self.weights[means.index(max(means))])
            model.weight.copy_(self.weight)
        return model

    def _copy_choices(self, other: "Kriging") -> None:
        """Copies weights, hyperparameters and the law of another model."""
        for mine, own in zip(
            self.buffers(recurse=False), other.buffers(recurse=False), strict=True
        ):
            mine.copy_(own)
        self.laws = other.laws
        self.posterior.load_state_dict(other.posterior.state_dict())

    def _solve(self, links: Links, values: Tensor) -> None:
        """Kriges the residuals of the known links."""
        index, weight, task = links.split.known, self.trend_weight.item(), links.task

        def residuals(rows: Int[Tensor, " k"]) -> Tensor:
            shape, dtype = self.scene.task.shape, self.scene.task.dtype
            differences = torch.empty(len(rows), *shape, dtype=dtype)
            for part in torch.arange(len(rows)).split(PART):
                chunk = rows[part]
                fallback = predicted(self.fallback, links, index[chunk])
                mean = blend(task, values[chunk], fallback, weight)
                labels = links.labels[index[chunk]]
                differences[part] = (task.align(labels, mean) - mean).to(differences)
            return differences

        features = self._features(values) if self.posterior.has_features else ()
        self.posterior.solve(links, residuals, *features)
        self.posterior.to(self.weight.device)

    def _features(self, spectra: Tensor) -> tuple[Tensor, ...]:
        """``coarse`` spectra, if a trend without paths predicts its own receivers; else None."""
        scene = self.scene
        if scene.task.directions is None or scene.has_band or scene.one_radio:
            return ()
        return () if self.trend.has_margins else (coarse(spectra),)

    def _features_at(self, batch: Batch, trend: Tensor | None) -> tuple[Tensor, ...]:
        """``_features`` of a batch; ``trend`` may have predictions in the batch's directions."""
        if not self.posterior.has_features:
            return ()
        directions = self.scene.task.directions
        if trend is None or not directions.matches(batch.directions):
            trend = self.trend(replace(batch, directions=directions)).value
        return self._features(trend)

    def _krige_paths(self, links: Links, values: Tensor, is_final: bool) -> "Kriging":
        """``krige`` by paths of the trend.

        The weight of kriging is 1 if it raises the mean score of at least ``FEWEST`` validation
        links by more than 1.5 standard errors, otherwise 0.

        Args:
            links: Links with a split.
            values: The trend's predictions of the known links, training links first.
            is_final: True if this model is also used for predictions; it then knows the validation
                links.

        Returns:
            A model that knows only the training links.
        """
        self._make_posterior(True)
        split = links.split
        index = split.known
        count = len(split.train)
        query = links.query[index]
        device = self.weight.device
        aligned = links.task.align(links.labels[index], values)
        # Of each receiver's known links, from which the posterior's strengths are solved.
        equations = self.posterior.equations(query, aligned, aligned - values, device)
        self.posterior.fit_process()
        model = Kriging(self.scene, self.trend, self.fallback_options)
        model._make_posterior(True)
        model.posterior.load_state_dict(self.posterior.state_dict())
        # Equations of each receiver's training links: they come first among its known links.
        training = []
        for receiver, known in enumerate(equations):
            training.append(known[: int((query.receivers[:count] == receiver).sum())])
        model.posterior.solve_equations(training)
        # Validation links as kriging from the training links predicts them.
        kriged = values[count:].clone()
        # A link at a time: the margins of all of them may take gigabytes.
        for row in stages.track(range(count, len(index)), "kriging"):
            kriged[row - count] += model.posterior.mean_at(query[row : row + 1], device)
        helps = False
        if len(single_readings(links, split.validation)) >= FEWEST:
            plain = validation_scores(links, values[count:])
            helps = is_surely_better(validation_scores(links, kriged), plain, errors=1.5)
        for kriging in (self, model) if is_final else (model,):
            kriging.trend_weight.fill_(1)
            kriging.weight.fill_(helps)
        if is_final:
            self.posterior.solve_equations(equations)
            self._log()
        return model.to(device)

    def process_at(self, receiver: int) -> Process | None:
        return self.posterior.process_at(receiver)

    def deviations(self, batch: Batch) -> Tensor:
        """Standard deviations of the labels; for spectra means over their pixels.

        Processes of kriged paths have no noise, and assume that the elements resolve all paths.
        """
        return self.posterior.deviations(batch, *self._features_at(batch, None))

    def _log(self) -> None:
        """Logs weights, hyperparameters and sizes."""
        facts = self.facts()["kriging"].items()
        log.info("kriging: %s", ", ".join(f"{name} {value:.3g}" for name, value in facts))

    def forward(self, batch: Batch) -> Prediction:
        task, trend_weight, weight = self.scene.task, self.trend_weight.item(), self.weight.item()
        # A part without weight is not evaluated: it would cost time, and its NaN would count.
        needs_trend = trend_weight > 0 or weight < 1 or self.posterior.has_features
        trend = self.trend(batch).value if needs_trend else None
        if weight == 0:
            return Prediction(trend, {})
        fallback = self.fallback(batch).value if trend_weight < 1 else None
        value = blend(task, trend, fallback, trend_weight)
        value = value + self.posterior.mean(batch, value, *self._features_at(batch, trend))
        value = blend(task, value, trend, weight)
        is_new = ~self.posterior.knows(batch.query.receivers)
        if is_new.any():  # receivers without links, as ``at_receivers`` has them
            value[is_new] = self._at_new(replace(batch, query=batch.query[is_new])).value
        return Prediction(value, {})

    @property
    def any_frequency(self) -> bool:  # type: ignore[override]
        return self._alone.any_frequency

    def at_frequencies(self, frequencies: Float[Tensor, " s"]) -> Model:
        """``_alone`` at other frequencies, where residuals do not correlate."""
        return self._alone.at_frequencies(frequencies)

    @property
    def any_receiver(self) -> bool:  # type: ignore[override]
        return self.trend.any_receiver and self.fallback.any_receiver

    def at_receivers(
        self, receivers: Sequence[Receiver], known: Int[Tensor, " k"] | None = None
    ) -> Model:
        """Trend and fallback at other receivers, weighted by ``new_weight``.

        Nothing is kriged there, since no residuals are known. If receivers are places of one radio,
        labels are kriged over these places, too, and the process stays.
        """
        if self.scene.one_radio and not self.posterior.by_paths:
            return super().at_receivers(receivers)
        alone = self._at_new.at_receivers(receivers, known)
        alone.take_calibration(self)
        return alone

    @property
    def fold_count(self) -> int:
        return 2

    def unseen(self, links: Links, enough: int = 1000, most: int = 4000) -> Iterator[Unseen]:
        """Yields models that krige the training links, with validation links that they do not know.

        There are two models, each for one half of the validation links. The other half has chosen
        its weights and hyperparameters. Links of a single group cannot be halved and do both. If at
        least ``enough`` validation links had no part in any choice (``chosen_by``), this model
        itself comes with these links. ``most`` scalar labels suffice for quantiles.
        """
        if not len(links.split.validation):
            return
        if self.chosen_by is not None:
            held = links.split.validation
            asked = single_readings(links, held[torch.isin(held, self.chosen_by, invert=True)])
            if len(asked) >= enough:
                yield Unseen(self, evenly(asked, most), links.split.train)
                return
        for chooses, asked in validation_halves(links):
            if stages.is_up():
                return
            kriged = Kriging(links.scene, self.trend, self.fallback_options).to(self.device)
            kriged.posterior.start_from(self.posterior)
            kriged.laws = self.laws
            if links.task.is_scalar and len(chooses) >= 300:
                # Half of so many links would choose the same weight as all of them.
                kriged.weights = (self.trend_weight.item(),)
            half = replace(links, split=links.split.choosing(chooses))
            kriged = kriged.krige(half, is_final=False, by_paths=self.posterior.by_paths)
            asked = single_readings(links, asked)
            if links.task.is_scalar:
                asked = evenly(asked, most)
            yield Unseen(kriged, asked, links.split.train)

    def take_hyperparameters(self, other: Model) -> None:
        if isinstance(other, Kriging):
            self.posterior.take_hyperparameters(other.posterior)

    @property
    def _alone(self) -> Model:
        """The trend, or the fallback if the trend has no weight."""
        return self.trend if self.trend_weight > 0 else self.fallback

    @property
    def _at_new(self) -> Model:
        """The model that predicts receivers without links."""
        weight = self.new_weight.item()
        if weight in (0, 1) or self.trend_weight == 0:
            return self._alone if weight else self.fallback
        mean_of = registry("model").get("ensemble")
        return mean_of(self.scene, [self.trend, self.fallback], [weight, 1 - weight]).eval()

    @property
    def underlying(self) -> Model:
        return self.trend

    @property
    def has_room(self) -> bool:  # type: ignore[override]
        """True if the trend contributes to predictions."""
        return bool(self.trend_weight > 0 or self.weight < 1 or self.posterior.has_features)

    def facts(self) -> dict[str, Any]:
        """The trend's facts, and as ``kriging`` the weights, hyperparameters and sizes."""
        weights = {"weight": self.weight.item(), "trend_weight": self.trend_weight.item()}
        if self.trend_weight > 0 and self.new_weight < 1:
            weights["new_weight"] = self.new_weight.item()
        room = {} if self.has_room else {"room": False}
        return self.trend.facts() | {"kriging": weights | room | dict(self.posterior.facts())}
