"""Hyperparameters of a Gaussian process over links, by maximum likelihood of held-out labels."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Complex, Float, Int
from scipy.optimize import minimize
from torch import Tensor

from gaigs.core.query import Query, evenly
from gaigs.core.scene import Scene
from gaigs.core.stages import end_in_time
from gaigs.data import Links
from gaigs.kriging.kernel import Process, kernel, kriging_weights
from gaigs.kriging.links import (
    PART,
    coordinates,
    distances,
    known_links,
    scale_bounds,
    scaled,
    single_readings,
)


class Hyperparameters(NamedTuple):
    """Hyperparameters of a Gaussian process over links."""

    length: float = math.nan  # correlation length of the kernel [m]
    nugget: float = math.nan  # variance of the noise over the signal's
    scale: float = math.nan  # of frequencies or features, see ``coordinates`` [m]; NaN without

    def facts(self) -> dict[str, float]:
        """Entries of ``metrics.json``."""
        facts = {"length_m": self.length, "nugget": self.nugget}
        return facts if math.isnan(self.scale) else {**facts, "frequency_scale_m": self.scale}

    def at(self, places: Float[Tensor, "k d"], signal: float) -> Process:
        """The process with the variance ``signal`` and known ``places`` of ``scale`` 1."""
        noise = self.nugget * signal

        def covariances(a: Float[Tensor, "m d"], b: Float[Tensor, "n d"]) -> Float[Tensor, "m n"]:
            return signal * kernel(scaled(a, self.scale), scaled(b, self.scale), self.length)

        return Process(covariances, places, places.new_full((len(places),), noise), noise)


FEWEST = 10
"""Fewest validation links that choose hyperparameters, or whether paths are kriged. Fewer links
overfit. Repeated readings count as one."""


class HeldOut(NamedTuple):
    """Held-out links of one receiver, and the links that predict them."""

    asked: Query  # held-out links
    around: Query  # links around each held-out link, one group after the other
    # Products of the residuals of each held-out link and of those around it.
    products: Float[Tensor, "b j+1 j+1"]
    features: Float[Tensor, "b j+1 c"] | None = None  # of each held-out link and of those around it


def damping(
    residuals: Complex[Tensor, " k *shape"],
    labels: Complex[Tensor, " k *shape"],
    receivers: Int[Tensor, " k"],
    most: float = 10.0,
) -> Float[Tensor, " k"]:
    """Factors, at most 1, by which the residuals of k channels are multiplied before kriging.

    They limit the norm of a residual to ``most`` times the median norm of the receiver's known
    channels. Residuals within decimetres of a receiver exceed the limit, and so do gross errors.
    Without the limit, one of them would spoil the predictions of the whole room.
    """
    residual_norms, label_norms = norms(residuals), norms(labels)
    factors = torch.ones_like(residual_norms)
    for receiver in receivers.unique():
        rows = receivers == receiver
        limit = most * label_norms[rows].quantile(0.5)
        sizes = residual_norms[rows]
        factors[rows] = torch.where(sizes > limit, limit / sizes, 1)
    return factors.float()


def norms(channels: Complex[Tensor, " k *shape"]) -> Float[Tensor, " k"]:
    """Norms of channels, in double precision."""
    parts = channels.split(PART)
    return torch.cat([part.flatten(1).to(torch.complex128).norm(dim=1) for part in parts])


def fit_hyperparameters(
    scene: Scene,
    links: Links,
    residuals: Callable[[Int[Tensor, " j"]], Float[Tensor, "j m"]],
    most: int = 300,
    nuggets: tuple[float, float] = (1e-4, 1e2),
    edges: float = 8.0,
    features: Callable[[Int[Tensor, " j"]], Float[Tensor, "j c"]] | None = None,
    length: float | None = None,
) -> tuple[Hyperparameters, float]:
    """Hyperparameters with the largest likelihood, and the ``negative_log_likelihood``.

    The likelihood is that of held-out links of all receivers. If all residuals are 0, the result is
    the middle of the bounds, and -inf.

    Args:
        scene: Receivers and task.
        links: Known links of each receiver, with the split that defines the held-out links.
        residuals: Function from indices of links to the residuals of their ``thin_labels``.
        most: Largest number of held-out links of all receivers together; 300 take a few seconds.
        nuggets: Bounds of the nugget. The lower one keeps matrices regular in float64 if places are
            measured twice.
        edges: Longest correlation length [longest edges of the box of places]. Beyond it the kernel
            is nearly linear within the box, and the length has no effect.
        features: Function from indices of links to their features, see ``coordinates``.
        length: A known correlation length. The other hyperparameters then minimise the squared
            error of the held-out labels. The likelihood would mislead, since the trend was trained
            on the training links and their residuals vary too little.
    """
    longest = (scene.upper - scene.lower).max().item()
    lengths = (scene.spacing, edges * longest) if length is None else (length, length)
    scales = [scale_bounds(scene)] if scene.has_band else []
    if features is not None:
        # From a tenth of the next place's distance, which is no effect, to the longest edge.
        spread = features(links.split.known).var(0).sum().sqrt().clamp_min(1e-9).item()
        scales = [(0.1 * scene.spacing / spread, longest / spread)]
    bounds = np.log([lengths, nuggets, *scales])
    middle = bounds.mean(1)
    scale = math.exp(middle[2]) if scene.has_band else math.nan
    if links.split.by_receivers:  # no known link is near those that validate
        links = replace(links, split=links.split.only(links.split.train))
    known = [index for index in known_links(links, any_receiver=True) if len(index)]
    most_per_receiver = max(1, most // len(known))
    held_out = []
    for index in known:
        held = hold_out(scene, links, index, scale, residuals, most_per_receiver, features=features)
        if held is not None:
            held_out.append(held)
    if not held_out:
        return Hyperparameters(*np.exp(middle).tolist()), -math.inf

    def cost(logarithms: Tensor) -> Tensor:
        by_errors = length is not None
        values = logarithms.exp()  # length, nugget and scale
        total = torch.zeros(())
        for held in held_out:
            total = total + negative_log_likelihood(scene, held, *values, by_errors=by_errors)
        return total

    def cost_and_gradient(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        with torch.enable_grad():
            leaf = torch.tensor(logarithms, requires_grad=True)
            total = cost(leaf)
            (gradient,) = torch.autograd.grad(total, leaf)
        return total.item(), gradient.numpy()

    # From the best point of a coarse grid: the likelihood may have several maxima.
    axes = [low + (high - low) * np.array([1, 3, 5]) / 6 for low, high in bounds]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, len(bounds))
    start = min(grid, key=lambda point: cost(torch.from_numpy(point)).item())
    result = minimize(
        cost_and_gradient,
        start,
        jac=True,
        method="L-BFGS-B",
        bounds=bounds,
        options={"ftol": 1e-6},
        callback=end_in_time,
    )
    return Hyperparameters(*np.exp(result.x).tolist()), float(result.fun)


def hold_out(
    scene: Scene,
    links: Links,
    known: Int[Tensor, " k"],
    scale: float,
    residuals: Callable[[Int[Tensor, " j"]], Float[Tensor, "j m"]],
    most: int,
    neighbours: int = 64,
    features: Callable[[Int[Tensor, " j"]], Float[Tensor, "j c"]] | None = None,
) -> HeldOut | None:
    """At most ``most`` held-out links of one receiver, and the known links that predict them.

    Each held-out link is a validation link, predicted by its ``neighbours`` nearest training links.
    With fewer than ``FEWEST`` validation links, training links are held out one by one, each with
    all links at its place. ``scale`` is as for ``coordinates`` [m]. The result is None if all
    residuals are 0, or if no other place is known.
    """
    split, query = links.split, links.query
    radios = scene.radio_of(query.receivers)
    radio = radios[known[0]]
    train = split.train[radios[split.train] == radio]
    train = train if len(train) else known
    validation = split.validation[radios[split.validation] == radio]
    if len(single_readings(links, split.validation)) < FEWEST:
        validation = validation[:0]
    asked = evenly(validation if len(validation) else train, most)
    apart = distances(
        coordinates(scene, query[asked], scale), coordinates(scene, query[train], scale)
    )
    if not len(validation):
        is_same_place = (query.transmitters[asked][:, None] == query.transmitters[train]).all(-1)
        apart = apart.masked_fill(is_same_place, math.inf)
    count = min(neighbours, int(apart.isfinite().sum(1).min()))
    if not count:
        return None
    around = train[apart.topk(count, largest=False).indices]  # (b, j)
    groups = torch.cat((asked[:, None], around), 1)  # (b, j + 1)
    # Residuals of each link are computed once, although it may be around several others.
    used, used_rows = groups.unique(return_inverse=True)
    values = residuals(used)  # (u, m)
    values = values.to(torch.promote_types(values.dtype, torch.float64))
    products = []
    for rows in used_rows:
        group = values[rows]  # (j + 1, m)
        products.append((group @ group.mH).real)
    mean_products = torch.stack(products) / values.shape[1]  # (b, j + 1, j + 1)
    if not mean_products.any():
        return None
    features_of_groups = None if features is None else features(used)[used_rows]
    return HeldOut(query[asked], query[around.flatten()], mean_products, features_of_groups)


def negative_log_likelihood(
    scene: Scene,
    held: HeldOut,
    length: Tensor,
    nugget: Tensor,
    scale: Tensor | float = math.nan,
    *,
    by_errors: bool = False,
) -> Float[Tensor, ""]:
    """-2 log p(held-out labels | labels around them), without constants.

    The likelihood is that of one value of a label, with errors averaged over the values. The
    signal's variance is the maximum-likelihood value at the receiver. With ``by_errors`` all
    held-out labels have one variance, so the cost is the log of their squared error.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 5.4.2.
    """
    of_asked = None if held.features is None else held.features[:, 0]
    of_around = None if held.features is None else held.features[:, 1:].flatten(0, 1)
    asked = coordinates(scene, held.asked, scale, of_asked)  # (b, d)
    around = coordinates(scene, held.around, scale, of_around)  # (b j, d)
    around = around.unflatten(0, (len(asked), -1))  # (b, j, d)
    weights, variances = kriging_weights(asked, around, length, nugget)
    squares = held.products[:, 0, 0]  # (b,)
    cross = held.products[:, 0, 1:]  # (b, j)
    others = held.products[:, 1:, 1:]  # (b, j, j)
    # |r - w' r_around|^2, a mean over the label's numbers.
    predicted = torch.einsum("bi,bij,bj->b", weights, others, weights)
    errors = squares - 2 * (weights * cross).sum(1) + predicted
    # The difference of nearly equal numbers, rounded to float64's sixteen digits, may be negative.
    errors = errors.clamp_min(1e-12 * squares.mean())
    if by_errors:
        return len(asked) * errors.mean().log()
    return len(asked) * (errors / variances).mean().log() + variances.log().sum()


def local_deviations(
    asked: Float[Tensor, "b d"],
    known: Float[Tensor, "k d"],
    process: Hyperparameters,
    neighbours: int = 64,
) -> Float[Tensor, " b"]:
    """Standard deviations of noisy labels at ``asked`` places, relative to that of the signal.

    They are conditional on the ``neighbours`` nearest known places. All places are ``coordinates``.
    """
    count = min(neighbours, len(known))
    variances = [asked.new_zeros(0)]
    for part in asked.split(1024):
        near = known[distances(part, known).topk(count, largest=False).indices]  # (b, j, d)
        variances.append(kriging_weights(part, near, process.length, process.nugget)[1])
    return torch.cat(variances).sqrt()
