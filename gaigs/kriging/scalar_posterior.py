"""Kriged residuals of scalar labels."""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from gaigs.core import stages
from gaigs.core.query import Batch
from gaigs.core.scene import Scene
from gaigs.data import Links
from gaigs.kriging.gross_errors import without_gross_errors
from gaigs.kriging.kernel import Process
from gaigs.kriging.links import coordinates, folds_of
from gaigs.kriging.posterior import Posterior
from gaigs.kriging.scalar import ScalarProcess


class ScalarPosterior(Posterior):
    """Kriged residuals of scalar labels, with a ``ScalarProcess``.

    The weight of the trend is the mean of the candidate weights. Each candidate counts by its
    likelihood on the validation links, or equally without such links. All readings of a place count
    as one.
    """

    def __init__(self, scene: Scene):
        super().__init__()
        self.scene = scene
        self.process = ScalarProcess(scene)

    def cleaned(self, links: Links) -> Links:
        return without_gross_errors(links)

    def fit(self, links: Links, candidates: Mapping[float, Tensor]) -> float:
        # 1. Kernel, noise and lengths are fitted to the residuals of the last candidate.
        # 2. With these as the start, lengths and noise are fitted again for each candidate.
        # 3. The mean of the candidates, weighted by their likelihoods, is fitted once more.
        index = links.split.known
        known = self._coordinates(links.query[index])
        folds = folds_of(links, index)
        weights = torch.tensor([*candidates], dtype=torch.float64)
        residuals = [values.flatten().double() for values in candidates.values()]  # (k,) each
        # Residuals of training links are too small, since the trend was trained on them, so
        # validation links decide.
        count = len(links.split.train)
        held = torch.arange(count, len(index)) if len(links.split.validation) else None
        process = self.process.cpu()
        # Numbers of maximisations, for the progress bar. A refit has two, or one without validation
        # links; there is one refit for each candidate, and one for their mean.
        refits = 1 if held is None else 2 * (len(weights) + (len(weights) > 1))
        fits = process.fit_count(1) if self.start is None else 0
        with stages.stage("kriging", fits + refits):
            if self.start is None:
                process.fit(*known, residuals[-1:], folds)
                logarithms, choice = process.logarithms, process.choice
            else:
                logarithms, choice = self.start
            groups = process.hold_out(*known, folds, held)
            rows = [process.asked, *(group.rows for group in groups)]
            self.seen = index[torch.cat(rows).unique()]

            def refit(values: Tensor) -> float:
                """Fits again from step 1; returns the negative log likelihood."""
                process.logarithms, process.choice = logarithms, choice
                return process.refit(values, groups)

            shares = torch.full((len(weights),), 1 / len(weights), dtype=torch.float64)
            if held is not None and len(weights) > 1:
                # Errors of readings at one place are similar, so they count as one reading.
                places = links.query[index[held]].place_keys.unique()
                readings_per_place = len(held) / len(places)
                costs = torch.tensor([refit(values) for values in residuals], dtype=torch.float64)
                # A cost is -inf if a trend explains all labels.
                log_likelihoods = -costs.clamp_min(-1e300) / readings_per_place
                shares = torch.softmax(log_likelihoods, 0)
            refit(shares @ torch.stack(residuals))
        return (shares @ weights).item()

    def start_from(self, other: Any) -> None:
        self.start = other.process.logarithms, other.process.choice

    def solve(self, links: Links, residuals: Callable[[Int[Tensor, " j"]], Tensor]) -> None:
        index = links.split.known
        values = residuals(torch.arange(len(index))).double()
        is_lazy = self.is_lazy and len(values) > self.process.options.large
        self.process.cpu().solve(*self._coordinates(links.query[index]), values, is_lazy)

    def mean(self, batch: Batch, like: Tensor) -> Tensor:
        return self.process(*self._coordinates(batch.query)).to(like)

    def knows(self, receivers: Int[Tensor, " b"]) -> Bool[Tensor, " b"]:
        return torch.isin(self.scene.radio_of(receivers), self.process.receivers)

    def deviations(self, batch: Batch) -> Tensor:
        return self.process.deviations(*self._coordinates(batch.query))

    def process_at(self, receiver: int) -> Process:
        return self.process.at(receiver)

    def facts(self) -> Mapping[str, float]:
        return {**self.process.facts(), "links": len(self.process.places)}

    def take_hyperparameters(self, other: Any) -> None:
        self.process.take(other.process)

    def _coordinates(self, query: Any) -> tuple[Float[Tensor, "b d"], Int[Tensor, " b"]]:
        return coordinates(self.scene, query, 1.0), self.scene.radio_of(query.receivers)
