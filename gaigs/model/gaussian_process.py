"""Kriging: a Gaussian process of what a trend leaves over, the strongest simple predictor from places."""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import minimize
from torch import Tensor

from gaigs.data import Links
from gaigs.model import Model, Prediction
from gaigs.model._known import at_directions, coordinates, distances, evenly, known_links, scale_bounds
from gaigs.query import Batch, Query
from gaigs.registry import register, registry
from gaigs.scene import Scene

LIMIT = 6000
"""Most known links of a receiver that are all looked at; the matrix of more outgrows a computer's memory."""

NEIGHBOURS = 300
"""Known links looked at in each prediction where there are more than ``LIMIT``: with this kernel, those near a place
hide those behind them."""

PART = 256
"""Labels held in memory at a time: a spectrum takes 130 KB."""

ASKED, AROUND, NUMBERS = 300, 64, 1024
"""By how many held-out links the hyperparameters are chosen, evenly spread; by how many training links around each; and
by how many of a label's numbers, which are far closer than what an array resolves. It takes seconds at most."""

FEWEST = 10
"""Fewer validation links than these do not choose: hyperparameters would follow their chance."""

NOISE = (1e-4, 1e2)
"""Bounds of the noise's variance over the signal's. The lower is well above float64's rounding errors, so that places
measured twice do not make matrices singular."""

EDGES = 8
"""Longest correlation length, in longest edges of the box of places: beyond it the kernel is a straight line in the
box, and only the ratio of its slope to the noise tells."""


class HeldOut(NamedTuple):
    """Links of one receiver to be predicted, those around each, and how alike their labels are.

    Attributes:
        asked: Held out.
        around: Those to predict them from, for one after the other.
        products: Of the residuals of each link and those around it, in their order, a mean over the label's numbers.
    """

    asked: Query
    around: Query
    products: Float[Tensor, "b j+1 j+1"]


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
        built = registry("model").build({"name": "mean"} if trend is None else trend, scene=scene)
        if any(True for _ in built.parameters()):
            raise ValueError(
                f"model.trend must be a model that is fitted at once, and {trend['name']} is trained; take mean, "
                "path_loss or friis"
            )
        self.trends = (built,)  # in a tuple, so that its state is no state of this look-up
        self.links, self.known, self.solved = None, None, None
        self.length, self.noise, self.scale = math.nan, math.nan, None

    @torch.no_grad()
    def fit(self, links: Links) -> None:
        """Fits the trend, chooses length, noise and scale, and factorises the kernel's matrices.

        Raises:
            ValueError: A receiver has no links to learn from.
        """
        self.links, self.known = links, known_links(links)
        self.trends[0].fit(links)
        self._choose()
        self.solved = [self._solve(index) for index in self.known]

    def facts(self) -> dict[str, object]:
        """Length [m], the noise's variance over the signal's, and where there are several carriers their scale [m]."""
        facts = {"length_m": self.length, "noise_to_signal": self.noise}
        return facts if self.scale is None else {**facts, "frequency_scale_m": self.scale}

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
        asked, known = (coordinates(self.scene, query, self.scale) for query in (a, b))
        return distances(asked, known).div_(-self.length).exp_()

    def _solve(self, index: Int[Tensor, "k"]) -> tuple[Tensor | None, Tensor | None]:
        """What predictions from some known links take: their residuals over the covariances, or the latter's factor.

        Of the two the smaller; neither where there are too many links.
        """
        if len(index) > LIMIT:
            return None, None
        query = self.links.query[index]
        covariances = self._covariances(query, query)
        covariances.diagonal().add_(self.noise)
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
            yield slice(start, start + len(some)), self.links.labels[some] - trend

    def _krige(self, query: Query, receiver: int) -> Tensor:
        """What the process adds to the trend (b, *shape)."""
        index, (solution, factor) = self.known[receiver], self.solved[receiver]
        if solution is not None:
            values = self._covariances(query, self.links.query[index]).to(solution) @ solution
            return values.reshape(len(query), *self.scene.task.shape).to(self.scene.task.dtype)
        if factor is not None:
            weights = torch.cholesky_solve(self._covariances(query, self.links.query[index]).T, factor).T
        else:
            asked, known = (coordinates(self.scene, part, self.scale) for part in (query, self.links.query[index]))
            near = distances(asked, known).topk(NEIGHBOURS, largest=False).indices
            own, _ = weigh(asked, known[near], self.length, self.noise)
            used, column = near.unique(return_inverse=True)
            weights = own.new_zeros(len(query), len(used)).scatter(1, column, own)
            index = index[used]
        values = 0
        for part, residuals in self._residuals(index):
            values = values + torch.tensordot(weights[:, part].to(residuals), residuals, 1)
        return values

    # --- its hyperparameters ---

    def _choose(self) -> None:
        """Takes the likeliest length, noise and scale within their bounds."""
        scene = self.scene
        bounds = [(scene.spacing, EDGES * (scene.upper - scene.lower).max().item()), NOISE]
        if scene.has_band:
            bounds.append(scale_bounds(scene))
        bounds = np.log(bounds)
        middle = bounds.mean(1)
        scale = math.exp(middle[2]) if scene.has_band else None
        held_out = [self._hold_out(receiver, scale) for receiver in range(len(self.known))]
        held_out = [held for held in held_out if held is not None]

        def cost(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
            with torch.enable_grad():
                leaf = torch.tensor(logarithms, requires_grad=True)
                total = sum(self._misfit(held, *leaf.exp()) for held in held_out)
                (gradient,) = torch.autograd.grad(total, leaf)
            return total.item(), gradient.numpy()

        best = middle
        if held_out:  # else the trend leaves nothing over
            # From the best point of a coarse grid: the likelihood may have several maxima.
            axes = [low + (high - low) * np.array([1, 3, 5]) / 6 for low, high in bounds]
            grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(bounds))
            start = min(grid, key=lambda point: cost(point)[0])
            best = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds).x
        self.length, self.noise, *scale = np.exp(best).tolist()
        self.scale = scale[0] if scale else None

    def _hold_out(self, receiver: int, scale: float | None) -> HeldOut | None:
        """Links of a receiver to choose hyperparameters by; None where they say nothing."""
        split, query = self.links.split, self.links.query
        validation = split.validation if len(split.validation) >= FEWEST else split.validation[:0]
        train, held = (part[query.receivers[part] == receiver] for part in (split.train, validation))
        train = self.known[receiver] if not len(train) else train
        asked = evenly(held if len(held) else train, max(1, ASKED // len(self.known)))
        apart = distances(*(coordinates(self.scene, query[part], scale) for part in (asked, train)))
        if not len(held):
            here = (query.transmitters[asked][:, None] == query.transmitters[train]).all(-1)
            apart = apart.masked_fill(here, math.inf)
        count = min(AROUND, int(apart.isfinite().sum(1).min()))
        if not count:
            return None
        around = train[apart.topk(count, largest=False).indices]
        used, place = torch.cat((asked[:, None], around), 1).unique(return_inverse=True)
        size = math.prod(self.scene.task.shape)
        numbers = evenly(torch.arange(size), NUMBERS)
        residuals = torch.cat([part.reshape(len(part), size)[:, numbers] for _, part in self._residuals(used)])
        residuals = residuals.to(torch.promote_types(residuals.dtype, torch.float64))
        products = torch.stack([(some @ some.mH).real for some in (residuals[row] for row in place)]) / len(numbers)
        return HeldOut(query[asked], query[around.flatten()], products) if products.any() else None

    def _misfit(self, held: HeldOut, length: Tensor, noise: Tensor, scale: Tensor | None = None) -> Float[Tensor, ""]:
        """Minus twice the logarithm of the density of held-out labels, of one of their numbers on average."""
        asked, around = (coordinates(self.scene, query, scale) for query in (held.asked, held.around))
        weights, variances = weigh(asked, around.unflatten(0, (len(asked), -1)), length, noise)
        own, cross, others = held.products[:, 0, 0], held.products[:, 0, 1:], held.products[:, 1:, 1:]
        errors = own - 2 * (weights * cross).sum(1) + torch.einsum("bi,bij,bj->b", weights, others, weights)
        # The difference of what is nearly equal, rounded to float64's sixteen digits, may be negative.
        errors = errors.clamp_min(1e-12 * own.mean())
        return len(asked) * (errors / variances).mean().log() + variances.log().sum()


def weigh(
    asked: Float[Tensor, "b d"], around: Float[Tensor, "b j d"], length: float | Tensor, noise: float | Tensor
) -> tuple[Float[Tensor, "b j"], Float[Tensor, "b"]]:
    """Weights of the links around each one asked for, and the variance of its label about their sum, over the signal's.

    Args:
        asked, around: Places, see ``coordinates`` [m].
        length: Of the kernel [m].
        noise: Its variance over the signal's.
    """
    identity = torch.eye(around.shape[1], dtype=around.dtype)
    covariances = (-distances(around, around) / length).exp() + noise * identity
    towards = (-distances(around, asked[:, None]) / length).exp()
    weights = torch.cholesky_solve(towards, torch.linalg.cholesky(covariances))[..., 0]
    return weights, 1 + noise - (weights * towards[..., 0]).sum(1)
