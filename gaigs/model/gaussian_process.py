"""Gaussian process over a trend (kriging): the strongest simple predictor from positions."""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.core.antenna import Receiver
from gaigs.core.query import Batch, Query, evenly, thin_labels
from gaigs.core.scene import Scene
from gaigs.core.stages import stage
from gaigs.data import Links
from gaigs.kriging.fit import Hyperparameters, damping, fit_hyperparameters, local_deviations
from gaigs.kriging.gross_errors import without_gross_errors
from gaigs.kriging.kernel import LIMIT, Process, cholesky_factor, kernel, kriging_weights
from gaigs.kriging.links import (
    PART,
    at_directions,
    coordinates,
    distances,
    folds_of,
    known_links,
)
from gaigs.kriging.path_terms import report_terms
from gaigs.kriging.scalar import ScalarProcess
from gaigs.model import LookUp, Model, Prediction, build_trend
from gaigs.registry import name_of, register


class Solved(NamedTuple):
    """Stored solution of one receiver; both fields are None in local kriging."""

    solution: Tensor | None  # residuals over the covariances of their links (k, m)
    factor: Tensor | None  # Cholesky factor of the covariances (k, k)


@register("model", "gaussian_process")
class GaussianProcess(LookUp):
    """label = trend + z + noise, with a Gaussian process z over places.

    The kernel is exp(-d / l), Matern-1/2, with the distance d of transmitters. With several
    carriers d combines distance and frequency, d² = |dx|² + (s d ln f)². Pixels of a label, and
    real and imaginary part, are separate processes with one kernel.

    Length l [m], nugget (variance of the noise over the signal's) and s [m] maximise the likelihood
    of the validation links given the training links around them, see ``gaigs.kriging.fit``. All
    receivers share the three. The signal's variance is each receiver's maximum-likelihood value.

    Scalar labels use ``gaigs.kriging.scalar.ScalarProcess`` instead: folds of the known links
    choose kernel, noise and trend by the likelihood, and each receiver has its own hyperparameters.
    Many readings are solved in parts, see ``gaigs.kriging.tiles``.

    For other labels, a receiver with more than ``LIMIT`` known links is predicted from the 300
    nearest to each query (local kriging): with this kernel near links screen links behind them.
    Residuals of channels are limited, see ``gaigs.kriging.fit.damping``.

    Args:
        trend: Configuration of the model whose residuals the process describes. None: ``friis`` for
            channels, each receiver's mean for spectra; for scalar labels the better one of mean and
            ``shaped_path_loss``.

    Raises:
        ValueError: The trend is a trained model.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, sections 2.2, 2.7
    and 5.4.2.
    """

    learnt = ("chosen",)
    limit = LIMIT  # known links of a receiver beyond which kriging is local
    neighbours = 300  # known links that enter each prediction of local kriging

    def __init__(self, scene: Scene, trend: dict | None = None):
        super().__init__(scene)
        given = [{"name": name} for name in scene.task.trends] if trend is None else [trend]
        self.trends = tuple(build_trend(entry, scene) for entry in given)
        if any(built.is_trained for built in self.trends):
            raise ValueError(
                f"model.trend cannot be trained, got {given[0]['name']}; "
                "take mean, path_loss or friis"
            )
        self.chosen = 0
        self.scalar = ScalarProcess(scene) if scene.task.is_scalar else None
        self.factors: Tensor | None = None
        self.process = Hyperparameters()
        self.solved: list[Solved] = []
        self.signals: list[float] = []  # deviation of each receiver's process

    def _load_from_state_dict(self, state_dict, prefix, *args):
        for key in [*state_dict]:  # older checkpoints have the process in a list
            if key.startswith(f"{prefix}scalar.0."):
                state_dict[key.replace("scalar.0.", "scalar.", 1)] = state_dict.pop(key)
        super()._load_from_state_dict(state_dict, prefix, *args)

    def get_extra_state(self) -> dict:
        trends = [dict(trend.state_dict()) for trend in self.trends]
        return super().get_extra_state() | {"process": [*self.process], "trends": trends}

    def set_extra_state(self, state: dict) -> None:
        super().set_extra_state(state)
        self.process = Hyperparameters(*state["process"])
        for trend, stored in zip(self.trends, state["trends"], strict=True):
            trend.load_state_dict(stored)
        if self.scalar is None:
            self._solve_known(chooses=False)

    def fit(self, links: Links) -> None:
        """Fits trend and hyperparameters, and factorises the covariances."""
        self._fit(links, chooses=True)
        report_terms(self.trend)

    def refit(self, links: Links) -> None:
        """Fits to fewer known links, with kernel, noise and trend from ``fit``.

        Labels with many values also keep all hyperparameters. For scalar labels lengths and
        deviations are fitted again, unless more than ``ScalarOptions.large`` links are known.
        """
        self._fit(links, chooses=False)

    def take_hyperparameters(self, other: Model) -> None:
        if isinstance(other, GaussianProcess) and self.scalar is not None:
            self.scalar.take(other.scalar)

    @torch.no_grad()
    def _fit(self, links: Links, chooses: bool) -> None:
        """``fit``, or ``refit`` if ``chooses`` is False."""
        if self.scalar is not None:
            links = without_gross_errors(links)
        self.links, self.known = links, known_links(links, self.any_receiver)
        if chooses:
            for trend in self.trends:
                trend.fit(links)
        else:
            self.trend.refit(links)
        if self.scalar is not None:
            self._fit_scalar(self.scalar, links, chooses)
        else:
            self._solve_known(chooses)

    @torch.no_grad()
    def _solve_known(self, chooses: bool) -> None:
        """Prepares predictions from the known links, receiver by receiver.

        With ``chooses`` the hyperparameters are fitted first.
        """
        links, self.factors = self.links, None
        if self.scene.task.dtype.is_complex:
            index = torch.cat(self.known)
            residuals = torch.cat([*self._residuals(index)])
            radios = self.scene.radio_of(links.query.receivers[index])
            factors = damping(residuals, links.labels[index], radios)
            self.factors = torch.ones(len(links)).index_copy(0, index, factors)

        def thin_residuals(index: Int[Tensor, " k"]) -> Tensor:
            return torch.cat([thin_labels(part) for part in self._residuals(index)])

        if chooses:
            self.process, _ = fit_hyperparameters(self.scene, links, thin_residuals)
        self.solved, self.signals = [], []
        for index in self.known:
            factor = self._factor(index)
            self.solved.append(self._solve(index, factor))
            residuals = thin_residuals(evenly(index, self.limit) if factor is None else index)
            wide = residuals.to(torch.promote_types(residuals.dtype, torch.float64))
            if factor is None:
                # Without a factor, the mean square instead of the most likely variance.
                white = wide / (1 + self.process.nugget) ** 0.5
            else:
                white = torch.linalg.solve_triangular(factor.to(wide), wide, upper=False)
            self.signals.append(white.abs().square().mean().sqrt().item())

    def _fit_scalar(self, process: ScalarProcess, links: Links, chooses: bool) -> None:
        """Fits the process of scalar labels; with ``chooses`` also its kernel and trend."""
        index = torch.cat(known_links(links, any_receiver=True))
        query = links.query[index]
        known = coordinates(self.scene, query, 1.0), self.scene.radio_of(query.receivers)
        folds = folds_of(links, index)
        is_large = not chooses and len(index) > process.options.large

        def residuals(trend: Model) -> Float[Tensor, " k"]:
            return (links.labels[index] - trend(Batch(query)).value).double()

        with stage("gaussian_process", process.fit_count(len(self.trends)) if chooses else 1):
            if chooses:
                candidates = []
                for trend in self.trends:
                    terms = getattr(trend, "terms", None)
                    # Errors of readings that terms have seen are too small.
                    errors = residuals(trend) if terms is None else terms.unseen[index]
                    candidates.append(errors)
                self.chosen = process.fit(*known, candidates, folds)
            elif not is_large:
                process.refit(residuals(self.trend), process.hold_out(*known, folds))
        process.solve(*known, residuals(self.trend), is_lazy=is_large)

    @property
    def trend(self) -> Model:
        """The model whose residuals the process describes."""
        return self.trends[self.chosen]

    @property
    def any_frequency(self) -> bool:  # type: ignore[override]
        return self.trend.any_frequency

    def at_frequencies(self, frequencies: Float[Tensor, " s"]) -> Model:
        """Only the trend: residuals at other frequencies do not correlate with known ones."""
        return self.trend.at_frequencies(frequencies)

    @property
    def any_receiver(self) -> bool:  # type: ignore[override]
        return self.scalar is not None

    def at_receivers(
        self, receivers: Sequence[Receiver], known: Int[Tensor, " k"] | None = None
    ) -> Model:
        """The trend alone, for received levels a path-loss model, without the process.

        Residuals at one receiver do not correlate with residuals at others. The process stays if
        the receivers are places of one radio.
        """
        if self.scene.one_radio or not self.any_receiver:
            moved = super().at_receivers(receivers)  # raises without ``any_receiver``
            moved.trends = tuple(trend.at_receivers(receivers) for trend in self.trends)
            return moved
        trend = self.trends[-1].at_receivers(receivers, known)
        trend.take_calibration(self)
        return trend

    def facts(self) -> dict[str, object]:
        """``length_m``, ``nugget`` and, with several carriers, ``frequency_scale_m``.

        Scalar labels have the facts of ``ScalarProcess`` and of the trend instead.
        """
        if self.scalar is not None:
            return {**self.scalar.facts(), "trend": name_of(self.trend)} | self.trend.facts()
        return {**self.process.facts()}

    def forward(self, batch: Batch) -> Prediction:
        query = batch.query
        radios = self.scene.radio_of(query.receivers)
        trend = self.trend(Batch(query, self.scene.task.directions)).value
        if self.scalar is not None:
            # A receiver without links has the law of distance, as in ``at_receivers``.
            is_new = torch.tensor([not len(index) for index in self.known], device=trend.device)
            if is_new.any():
                law = self.trends[-1](Batch(query)).value
                trend = torch.where(is_new[radios], law, trend)
            levels = self.scalar(coordinates(self.scene, query, 1.0), radios)
            return Prediction(trend + levels.to(trend), {})
        added = torch.zeros_like(trend)
        for radio in radios.unique().tolist():
            is_asked = radios == radio
            added[is_asked] = self._kriged(query[is_asked], radio)
        return Prediction(at_directions(trend + added, batch, self.scene), {})

    def deviations(self, batch: Batch) -> Tensor:
        """Standard deviations of the labels, averaged over a label's values."""
        query = batch.query
        radios = self.scene.radio_of(query.receivers)
        if self.scalar is not None:
            places = coordinates(self.scene, query, 1.0)
            return self.scalar.deviations(places, radios)
        places = self._places(query)
        deviations = torch.zeros_like(places[:, 0])
        for radio in radios.unique().tolist():
            is_asked = radios == radio
            known = self._places(self.links.query[self.known[radio]])
            local = local_deviations(places[is_asked], known, self.process)
            deviations[is_asked] = self.signals[radio] * local
        return deviations

    def process_at(self, receiver: int) -> Process:
        """The process of one receiver."""
        if self.scalar is not None:
            return self.scalar.at(receiver)
        places = coordinates(self.scene, self.links.query[self.known[receiver]], 1.0)
        return self.process.at(places, self.signals[receiver] ** 2)

    def _places(self, query: Query) -> Tensor:
        """Coordinates of the links in place and frequency [m]."""
        return coordinates(self.scene, query, self.process.scale)

    def _factor(self, index: Int[Tensor, " k"]) -> Tensor | None:
        """Cholesky factor of a receiver's covariances; None for local kriging."""
        if len(index) > self.limit:
            return None
        return cholesky_factor(
            self._places(self.links.query[index]), self.process.length, self.process.nugget
        )

    def _solve(self, index: Int[Tensor, " k"], factor: Tensor | None) -> Solved:
        """Solution K^-1 r or Cholesky factor of a receiver, whichever needs less memory."""
        if factor is None or math.prod(self.scene.task.shape) >= len(index):
            return Solved(None, factor)
        residuals = torch.cat([*self._residuals(index)]).reshape(len(index), -1)
        wide = torch.promote_types(residuals.dtype, torch.float64)
        return Solved(torch.cholesky_solve(residuals.to(wide), factor.to(wide)), None)

    def _residuals(self, index: Int[Tensor, " k"]) -> Iterator[Tensor]:
        """Yields labels minus their trend, after alignment to it, for ``PART`` links at a time.

        Channels are damped by ``factors``.
        """
        for part in index.split(PART):
            trend = self.trend(Batch(self.links.query[part], self.scene.task.directions)).value
            residuals = self.scene.task.align(self.links.labels[part], trend) - trend
            if self.factors is not None:
                residuals = residuals * self.factors[part, None, None]
            yield residuals

    def _kriged(self, query: Query, receiver: int) -> Tensor:
        """Residuals (b, *shape) that the process predicts for links to one receiver.

        The result is k K^-1 r, with the kernel k, and covariances K and residuals r of the known
        links. K^-1 r is cached unless it is larger than K.
        """
        index = self.known[receiver]
        task = self.scene.task
        solution, factor = self.solved[receiver]
        asked = self._places(query)
        known = self._places(self.links.query[index])
        length, nugget, _ = self.process
        if solution is not None:
            values = kernel(asked, known, length).to(solution) @ solution
            return values.reshape(len(query), *task.shape).to(task.dtype)
        if factor is not None:
            weights = torch.cholesky_solve(kernel(asked, known, length).T, factor).T
        else:
            near = distances(asked, known).topk(self.neighbours, largest=False).indices
            local, _ = kriging_weights(asked, known[near], length, nugget)  # (b, neighbours)
            # A column for each known link that is near any query.
            used, column = near.unique(return_inverse=True)
            weights = local.new_zeros(len(query), len(used)).scatter(1, column, local)
            index = index[used]
        parts = zip(weights.split(PART, 1), self._residuals(index), strict=True)
        return sum(torch.tensordot(part.to(residuals), residuals, 1) for part, residuals in parts)
