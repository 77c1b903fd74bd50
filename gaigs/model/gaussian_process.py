"""Kriging: a Gaussian process of what a trend leaves over, the strongest simple predictor from places."""

import math
from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.data import Links
from gaigs.kriging.fit import LIMIT, PART, Hyperparameters, damping, likeliest, norms, numbers_of, weigh
from gaigs.kriging.links import at_directions, coordinates, distances, known_links
from gaigs.model import Model, Prediction, build_trend
from gaigs.query import Batch, Query
from gaigs.registry import register
from gaigs.scene import Scene

NEIGHBOURS = 300
"""Known links looked at in each prediction where there are more than ``LIMIT``: with this kernel, those near a place
hide those behind them."""


@register("model", "gaussian_process")
class GaussianProcess(Model):
    """label = trend + z + noise, z a Gaussian process over places with the Matern-1/2 kernel exp(-d / l).

    d is the distance of transmitters; where the training links have several carriers, that in place and frequency,
    d² = |dx|² + (s d ln f)². Pixels of a label, and real and imaginary part, are processes of their own with one
    kernel.

    Length l [m], the noise's variance over the signal's, and s [m] are those with which the validation links are
    likeliest, each given the training links around it: the validation is held out as the test is, and how well a label
    is told from others depends on how far these are. With fewer than ``FEWEST`` of them, training links are held out
    one by one, each with all that share its place. The three are shared by all receivers; the signal's variance is each
    receiver's likeliest.

    A receiver with more than ``LIMIT`` known links is predicted from the ``NEIGHBOURS`` nearest to each query instead
    of from all (local kriging).

    What the trend leaves over of a channel counts as no larger than ``LOUDEST`` times the receiver's median channel.

    It is a look-up, which keeps the links, and is not stored in a checkpoint.

    Args:
        trend: Configuration of the model that is fitted first, whose residuals the process describes; None: each
            receiver's mean label.

    Raises:
        ValueError: The trend is a model that is trained.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, sections 2.2, 2.7 and 5.4.2.
    """

    def __init__(self, scene: Scene, trend: dict | None = None):
        super().__init__(scene)
        built = build_trend({"name": "mean"} if trend is None else trend, scene)
        if any(True for _ in built.parameters()):
            raise ValueError(
                f"model.trend must be a model that is fitted at once, and {trend['name']} is trained; take mean, "
                "path_loss or friis"
            )
        self.trends = (built,)  # in a tuple, so that its state is no state of this look-up
        self.links, self.known, self.solved, self.factors = None, None, None, None
        self.process = Hyperparameters(math.nan, math.nan, None)

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Fits the trend, chooses length, noise and scale, and factorises the kernel's matrices.

        Raises:
            ValueError: A receiver has no links to learn from.
        """
        self.links, self.known = links, known_links(links)
        self.trends[0].fit(links)
        self.factors = None
        if self.scene.task.dtype.is_complex:
            index = torch.cat(self.known)
            sizes = torch.cat([norms(part) for _, part in self._residuals(index)])
            usual = torch.cat([norms(links.labels[part]) for part in index.split(PART)])
            factors = damping(sizes, usual, links.query.receivers[index])
            self.factors = torch.ones(len(links)).index_copy(0, index, factors)
        numbers = numbers_of(self.scene)
        residuals = lambda index: torch.cat(
            [part.reshape(len(part), -1)[:, numbers] for _, part in self._residuals(index)]
        )
        self.process, _ = likeliest(self.scene, links, self.known, residuals)
        self.solved = [self._solve(index) for index in self.known]

    def facts(self) -> dict[str, object]:
        """Length [m], the noise's variance over the signal's, and where there are several carriers their scale [m]."""
        return self.process.facts()

    def forward(self, batch: Batch) -> Prediction:
        query = batch.query
        trend = self.trends[0](Batch(query, self.scene.task.directions)).value
        added = torch.zeros_like(trend)
        for receiver in query.receivers.unique().tolist():
            own = query.receivers == receiver
            added[own] = self._krige(query[own], receiver)
        return Prediction(at_directions(trend + added, batch, self.scene), {})

    # --- the process given its hyperparameters ---

    def _covariances(self, a: Query, b: Query) -> Float[Tensor, "a b"]:
        """Over the signal's variance."""
        asked, known = (coordinates(self.scene, query, self.process.scale) for query in (a, b))
        return distances(asked, known).div_(-self.process.length).exp_()

    def _solve(self, index: Int[Tensor, "k"]) -> tuple[Tensor | None, Tensor | None]:
        """What predictions from some known links take: their residuals over the covariances, or the latter's factor.

        Of the two the smaller; neither where there are too many links.
        """
        if len(index) > LIMIT:
            return None, None
        query = self.links.query[index]
        covariances = self._covariances(query, query)
        covariances.diagonal().add_(self.process.noise)
        factor = torch.linalg.cholesky(covariances)
        if math.prod(self.scene.task.shape) >= len(index):
            return None, factor
        residuals = torch.cat([part for _, part in self._residuals(index)]).reshape(len(index), -1)
        wide = torch.promote_types(residuals.dtype, torch.float64)
        return torch.cholesky_solve(residuals.to(wide), factor.to(wide)), None

    def _residuals(self, index: Int[Tensor, "k"]) -> Iterator[tuple[slice, Tensor]]:
        """Labels of some links less their trend, so many at a time, and which these are."""
        for start in range(0, len(index), PART):
            some = index[start : start + PART]
            trend = self.trends[0](Batch(self.links.query[some], self.scene.task.directions)).value
            residuals = self.links.labels[some] - trend
            if self.factors is not None:
                residuals = residuals * self.factors[some, None, None]
            yield slice(start, start + len(some)), residuals

    def _krige(self, query: Query, receiver: int) -> Tensor:
        """What the process adds to the trend (b, *shape)."""
        index, (solution, factor) = self.known[receiver], self.solved[receiver]
        if solution is not None:
            values = self._covariances(query, self.links.query[index]).to(solution) @ solution
            return values.reshape(len(query), *self.scene.task.shape).to(self.scene.task.dtype)
        if factor is not None:
            weights = torch.cholesky_solve(self._covariances(query, self.links.query[index]).T, factor).T
        else:
            length, noise, scale = self.process
            asked, known = (coordinates(self.scene, part, scale) for part in (query, self.links.query[index]))
            near = distances(asked, known).topk(NEIGHBOURS, largest=False).indices
            own, _ = weigh(asked, known[near], length, noise)
            used, column = near.unique(return_inverse=True)
            weights = own.new_zeros(len(query), len(used)).scatter(1, column, own)
            index = index[used]
        values = 0
        for part, residuals in self._residuals(index):
            values = values + torch.tensordot(weights[:, part].to(residuals), residuals, 1)
        return values
