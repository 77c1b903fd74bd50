"""What kriging takes: which links choose the hyperparameters of a Gaussian process, and the likeliest of these."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Complex, Float, Int
from scipy.optimize import minimize
from torch import Tensor

from gaigs.data import Links
from gaigs.kriging.links import coordinates, distances, evenly, scale_bounds
from gaigs.query import Query
from gaigs.scene import Scene

LIMIT = 6000
"""Most known links of a receiver that are all looked at; the matrix of more outgrows a computer's memory."""

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

LOUDEST = 10.0
"""What is left over of a channel counts as no larger than so many times the median channel: within some decimetres of a
receiver it is that large, and a reading that is far too loud would otherwise be heard all over the room."""

EDGES = 8
"""Longest correlation length, in longest edges of the box of places: beyond it the kernel is a straight line in the
box, and only the ratio of its slope to the noise tells."""


class Hyperparameters(NamedTuple):
    """Of a Gaussian process over places.

    Attributes:
        length: Of the kernel [m].
        noise: Its variance over the signal's.
        scale: Of ``coordinates`` [m]; None where positions are all.
    """

    length: float
    noise: float
    scale: float | None

    def facts(self) -> dict[str, float]:
        """What ``metrics.json`` says of them."""
        facts = {"length_m": self.length, "noise_to_signal": self.noise}
        return facts if self.scale is None else {**facts, "frequency_scale_m": self.scale}


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


def numbers_of(scene: Scene) -> Int[Tensor, "m"]:
    """Which of a label's numbers the hyperparameters are chosen by."""
    return evenly(torch.arange(math.prod(scene.task.shape)), NUMBERS)


def norms(channels: Complex[Tensor, "k *shape"]) -> Float[Tensor, "k"]:
    """Of each link's channel; float64."""
    return channels.flatten(1).to(torch.complex128).norm(dim=1)


def damping(
    residuals: Float[Tensor, "k"], labels: Float[Tensor, "k"], receivers: Int[Tensor, "k"]
) -> Float[Tensor, "k"]:
    """By what residuals of channels are multiplied so that those of each receiver keep to ``LOUDEST``.

    Args:
        residuals, labels: Their ``norms``.
        receivers: Of each link.
    """
    factors = torch.ones_like(residuals)
    for receiver in receivers.unique():
        own = receivers == receiver
        most = LOUDEST * labels[own].quantile(0.5)
        factors[own] = torch.where(residuals[own] > most, most / residuals[own], 1)
    return factors.float()


def likeliest(
    scene: Scene,
    links: Links,
    known: Sequence[Int[Tensor, "k"]],
    residuals: Callable[[Int[Tensor, "j"]], Float[Tensor, "j m"]],
    most: int = ASKED,
) -> tuple[Hyperparameters, float]:
    """The likeliest hyperparameters within their bounds.

    Args:
        scene: Receivers and task.
        links: Whose split says what is held out.
        known: Links of each receiver that are known.
        residuals: Gives of some links what the trend leaves over, of the numbers of ``numbers_of`` alone.
        most: Links that are held out, of all receivers together.

    Returns:
        The hyperparameters, and minus twice the logarithm of the density of the held-out labels, see ``misfit``; that
        is minus infinity where the trend leaves nothing over.
    """
    bounds = [(scene.spacing, EDGES * (scene.upper - scene.lower).max().item()), NOISE]
    if scene.has_band:
        bounds.append(scale_bounds(scene))
    bounds = np.log(bounds)
    middle = bounds.mean(1)
    scale = math.exp(middle[2]) if scene.has_band else None
    each = max(1, most // len(known))
    held_out = [hold_out(scene, links, known, receiver, scale, residuals, each) for receiver in range(len(known))]
    held_out = [held for held in held_out if held is not None]

    def cost(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        with torch.enable_grad():
            leaf = torch.tensor(logarithms, requires_grad=True)
            total = sum(misfit(scene, held, *leaf.exp()) for held in held_out)
            (gradient,) = torch.autograd.grad(total, leaf)
        return total.item(), gradient.numpy()

    best, least = middle, -math.inf
    if held_out:
        # From the best point of a coarse grid: the likelihood may have several maxima.
        axes = [low + (high - low) * np.array([1, 3, 5]) / 6 for low, high in bounds]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(bounds))
        start = min(grid, key=lambda point: cost(point)[0])
        found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds)
        best, least = found.x, float(found.fun)
    length, noise, *scale = np.exp(best).tolist()
    return Hyperparameters(length, noise, scale[0] if scale else None), least


def hold_out(
    scene: Scene,
    links: Links,
    known: Sequence[Int[Tensor, "k"]],
    receiver: int,
    scale: float | None,
    residuals: Callable[[Int[Tensor, "j"]], Float[Tensor, "j m"]],
    most: int,
) -> HeldOut | None:
    """At most so many links of a receiver to choose hyperparameters by; None where they say nothing.

    Validation links are held out from the training links; where these are fewer than ``FEWEST``, training links one by
    one, each with all that share its place.
    """
    split, query = links.split, links.query
    validation = split.validation if len(split.validation) >= FEWEST else split.validation[:0]
    train, held = (part[query.receivers[part] == receiver] for part in (split.train, validation))
    train = known[receiver] if not len(train) else train
    asked = evenly(held if len(held) else train, most)
    apart = distances(*(coordinates(scene, query[part], scale) for part in (asked, train)))
    if not len(held):
        here = (query.transmitters[asked][:, None] == query.transmitters[train]).all(-1)
        apart = apart.masked_fill(here, math.inf)
    count = min(AROUND, int(apart.isfinite().sum(1).min()))
    if not count:
        return None
    around = train[apart.topk(count, largest=False).indices]
    used, place = torch.cat((asked[:, None], around), 1).unique(return_inverse=True)
    left = residuals(used)
    left = left.to(torch.promote_types(left.dtype, torch.float64))
    products = torch.stack([(some @ some.mH).real for some in (left[row] for row in place)]) / left.shape[1]
    return HeldOut(query[asked], query[around.flatten()], products) if products.any() else None


def misfit(
    scene: Scene, held: HeldOut, length: Tensor, noise: Tensor, scale: Tensor | None = None
) -> Float[Tensor, ""]:
    """Minus twice the logarithm of the density of held-out labels, of one of their numbers on average.

    The signal's variance is the receiver's likeliest.
    """
    asked, around = (coordinates(scene, query, scale) for query in (held.asked, held.around))
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
