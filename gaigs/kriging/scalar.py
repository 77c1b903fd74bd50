"""Gaussian processes of labels of one real number: one for each receiver, with heavy tails where
data have them.
"""

import math
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize
from torch import Tensor, nn

from gaigs.core import stages
from gaigs.core.query import evenly
from gaigs.core.scene import Scene
from gaigs.kriging.fit import EDGES
from gaigs.kriging.kernel import Process, resize
from gaigs.kriging.links import distances, scale_bounds, scaled

NEAREST = 32
"""Readings around a held-out one while a process is fitted, and around a place whose variance is
asked of many.
"""

MANY = 300
"""Readings of a receiver that all enter a variance; of more the nearest, which then take less time.
"""

DEVIATIONS = (0.25, 0.15, 0.15)
"""Scatter between receivers of the logarithms of length, signal and noise: the prior of each
receiver's.
"""

DEGREES = 4.0
"""Degrees of freedom of Student's t: of the scatter, and of the noise where it is not normal."""

ROUNDS = 3
"""Repetitions of expectation and maximisation for the variances of single readings."""

ITERATIONS = 50
"""Most iterations of a maximisation."""

PART = 2048
"""Places whose neighbours are held in memory at a time."""

WIDEST = 2.0
"""Largest deviation of the signal over the residuals' root mean square. Readings millimetres apart
show its ratio to a power of the length alone: beside them a larger one would give levels that no
receiver hears."""

LARGEST = 50.0
"""Largest deviation of the noise over the residuals' root mean square, and the inverse of the least
one of both: the noise keeps matrices regular where a place is measured twice."""


def matern(apart: Tensor, length: Tensor, smoothness: float) -> Tensor:
    """Matern correlation of places at some distances [m], of smoothness 1/2 or 3/2.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, equations 4.16
    and 4.17.
    """
    steps = apart * (-math.sqrt(2 * smoothness) / length)  # a division has a slower gradient
    return steps.exp() if smoothness == 0.5 else (1 - steps) * steps.exp()


class Around(NamedTuple):
    """The nearest readings of the same receiver around each of m asked places; the place itself
    comes last.

    Attributes:
        rows: Of the readings (m, j).
        found: False for rows beyond a receiver's readings (m, j).
        receivers: Of the asked places (m,).
        apart: Distances of places [m] (m, j + 1, j + 1), 1e15 for rows that are not found: nothing
            correlates.
        bands: Of carriers, see ``coordinates`` of scale 1 (m, j + 1, j + 1); None without a band.
    """

    rows: Int[Tensor, "m j"]
    found: Bool[Tensor, "m j"]
    receivers: Int[Tensor, " m"]
    apart: Float[Tensor, "m i i"]
    bands: Float[Tensor, "m i i"] | None


class Choice(NamedTuple):
    """Smoothness of the kernel, degrees of freedom of the noise (infinite: normal), scale of
    carriers [m] or NaN.
    """

    smoothness: float = 0.5
    degrees: float = math.inf
    scale: float | Tensor = math.nan


class ScalarProcess(nn.Module):
    """y = z + noise: residuals of a trend, z a Gaussian process over places at each receiver.

    Each receiver has a correlation length l [m], a standard deviation of z and one of the noise, in
    the label's unit. Their logarithms scatter about those of all receivers by ``DEVIATIONS``, as
    Student's t with ``DEGREES`` degrees of freedom: one receiver may be far noisier than the
    others. Kernel (Matern-1/2 or -3/2) and noise (normal, or Student's t with ``DEGREES`` degrees
    of freedom) are the same for all receivers. All maximise the likelihood of held-out readings,
    each given ``NEAREST`` ones around it.

    Student's t is a normal distribution whose variance is random. Expectation and maximisation give
    each reading a variance of its own, so that one that disagrees with all around it counts little.

    Attributes:
        logarithms: Of length, deviation of the signal and of the noise at each receiver (r, 3).
        choice: Smoothness, degrees of freedom, and scale of carriers (3,).
        places: Of the known readings (k, d), see ``coordinates`` of scale 1.
        receivers, values: Of the known readings (k,).
        variances: Of the noise of each known reading (k,).
        weights: Values over the covariances of their receiver's readings (k,).

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, sections 2.2 and
    5.4.2; Lange, Little and Taylor, Robust statistical modeling using the t distribution, 1989.
    """

    logarithms: Tensor
    choice: Tensor
    places: Tensor
    receivers: Tensor
    values: Tensor
    variances: Tensor
    weights: Tensor

    def __init__(self, scene: Scene):
        super().__init__()
        self.scene = scene
        empty = torch.zeros(0, dtype=torch.float64)
        self.register_buffer("logarithms", empty.new_zeros(len(scene.receivers), 3))
        self.register_buffer("choice", empty.new_tensor(Choice()))
        self.register_buffer("places", empty.new_zeros(0, 3 + scene.has_band))
        self.register_buffer("receivers", empty.long())
        for name in ("values", "variances", "weights"):
            self.register_buffer(name, empty.clone())

    # --- predictions ---

    def forward(
        self, places: Float[Tensor, "b d"], receivers: Int[Tensor, " b"]
    ) -> Float[Tensor, " b"]:
        """Mean of z at some places."""
        means = places.new_zeros(len(places))
        for receiver in receivers.unique().tolist():
            asked, own = receivers == receiver, self.receivers == receiver
            means[asked] = (
                self._covariances(places[asked], self.places[own], receiver) @ self.weights[own]
            )
        return means

    def deviations(
        self, places: Float[Tensor, "b d"], receivers: Int[Tensor, " b"]
    ) -> Float[Tensor, " b"]:
        """Standard deviations of readings at some places: of z given the readings, and of the
        noise.
        """
        choice, found = Choice(*self.choice.tolist()), places.new_zeros(len(places))
        for receiver in receivers.unique().tolist():
            rows, process = (receivers == receiver).nonzero()[:, 0], self.at(receiver)
            for part in rows.split(PART):
                if len(process.places) <= MANY:
                    left, _ = process.whitened(places[part])
                    variances = (2 * self.logarithms[receiver, 1]).exp() - left.square().sum(0)
                else:
                    around = self._around(
                        places[part], receivers[part], self._nearest(places[part], receivers[part])
                    )
                    between = covariances(around, self.logarithms.exp(), choice)
                    _, variances = conditional(
                        between, self.values[around.rows], self.variances[around.rows]
                    )
                found[part] = (variances.clamp_min(0) + process.noise).sqrt()
        return found

    def at(self, receiver: int) -> Process:
        """The process of one receiver."""
        own, degrees = self.receivers == receiver, self.choice[1].item()
        noise = math.exp(2 * self.logarithms[receiver, 2].item())
        noise *= 1.0 if math.isinf(degrees) else degrees / (degrees - 2)
        covariances = partial(self._covariances, receiver=receiver)
        return Process(covariances, self.places[own], self.variances[own], noise)

    def facts(self) -> dict[str, float]:
        """Medians over the receivers of length and nugget; smoothness; degrees of freedom, 0 if the
        noise is normal.
        """
        length, signal, noise = self.logarithms.exp().unbind(1)
        smoothness, degrees, scale = self.choice.tolist()
        facts = {
            "length_m": length.median().item(),
            "nugget": (noise / signal).square().median().item(),
        }
        facts |= {
            "smoothness": smoothness,
            "degrees_of_freedom": 0.0 if math.isinf(degrees) else degrees,
        }
        return facts if math.isnan(scale) else {**facts, "frequency_scale_m": scale}

    # --- fit ---

    def fit(
        self,
        places: Float[Tensor, "k d"],
        receivers: Int[Tensor, " k"],
        candidates: Sequence[Float[Tensor, " k"]],
        folds: Int[Tensor, " k"],
        most: int = 600,
    ) -> int:
        """Chooses the residuals, the kernel and the noise with which held-out readings are most
        likely.

        Args:
            places, receivers: Of the known readings.
            candidates: Residuals of the known readings about one trend or another.
            folds: Readings are held out with all of their fold.
            most: Held-out readings to which the hyperparameters of single receivers are fitted;
                half as many choose.

        Returns:
            Index of the chosen residuals; ``solve`` takes them.
        """
        self.places, self.receivers, every = places, receivers, torch.arange(len(places))
        few = self._held_out(every, folds, most // 2)
        tried = [
            (*self._maximise(values, *few, Choice()), index)
            for index, values in enumerate(candidates)
        ]
        best = min(tried, key=lambda found: found[0])
        values = candidates[best[-1]]
        for smoothness, degrees in ((1.5, math.inf), (0.5, DEGREES), (1.5, DEGREES)):
            choice = best[2]._replace(smoothness=smoothness, degrees=degrees)
            best = min(
                best,
                (*self._maximise(values, *few, choice, best[1]), best[-1]),
                key=lambda found: found[0],
            )
        _, logarithms, choice, index = best
        _, self.logarithms, choice = self._maximise(
            values, *self._held_out(every, folds, most), choice, logarithms, has_deviations=True
        )
        self.choice = torch.tensor(choice, dtype=torch.float64)
        return index

    def refit(
        self,
        places: Float[Tensor, "k d"],
        receivers: Int[Tensor, " k"],
        values: Float[Tensor, " k"],
        folds: Int[Tensor, " k"],
        held: Int[Tensor, " h"] | None = None,
        most: int = 300,
    ) -> float:
        """Fits the hyperparameters to other readings, from those that it has; kernel and noise
        stay.

        With ``held``, to readings of these rows given all others too. The fit before is their
        prior, with ``DEVIATIONS``, since few readings alone would overfit.

        Returns:
            Least negative log posterior of the last of these fits.
        """
        self.places, self.receivers = places, receivers
        rows, prior, cost = torch.arange(len(values)), None, 0.0
        parts = (
            [(rows, folds)]
            if held is None
            else [(rows, folds), (held, torch.isin(rows, held).long())]
        )
        for asked, apart in parts:
            choice = Choice(*self.choice.tolist())
            cost, self.logarithms, choice = self._maximise(
                values,
                *self._held_out(asked, apart, most),
                choice,
                self.logarithms,
                has_deviations=True,
                prior=prior,
            )
            self.choice, prior = torch.tensor(choice, dtype=torch.float64), self.logarithms.mean(0)
        return cost

    def solve(
        self,
        places: Float[Tensor, "k d"],
        receivers: Int[Tensor, " k"],
        values: Float[Tensor, " k"],
    ) -> None:
        """Takes known residuals, whose process ``fit`` has found."""
        self.places, self.receivers, self.values = places, receivers, values.clone()
        noises = (2 * self.logarithms[receivers, 2]).exp()
        self.variances = noises * self._factors(values)
        self.weights = torch.zeros_like(values)
        for receiver in receivers.unique().tolist():
            own = receivers == receiver
            covariances = self._covariances(places[own], places[own], receiver)
            covariances.diagonal().add_(self.variances[own])
            factor = torch.linalg.cholesky(covariances)
            self.weights[own] = torch.cholesky_solve(values[own, None], factor)[:, 0]

    def take(self, other: "ScalarProcess") -> None:
        """Takes the hyperparameters of another process for ``deviations``; means need ``solve``
        again.
        """
        noises = (2 * (other.logarithms - self.logarithms)[self.receivers, 2]).exp()
        is_alike = torch.equal(self.choice[:2], other.choice[:2])
        self.variances, self.logarithms, self.choice = (
            self.variances * noises,
            other.logarithms,
            other.choice,
        )
        if not is_alike:  # readings that disagree count less with one noise than with another
            self.variances = (2 * self.logarithms[self.receivers, 2]).exp() * self._factors(
                self.values
            )

    def _maximise(
        self,
        values: Float[Tensor, " k"],
        asked: Int[Tensor, " m"],
        around: Around,
        choice: Choice,
        start: Float[Tensor, "r 3"] | None = None,
        has_deviations: bool = False,
        prior: Float[Tensor, " 3"] | None = None,
    ) -> tuple[float, Float[Tensor, "r 3"], Choice]:
        """Least negative log likelihood of the held-out readings, and the hyperparameters that have
        it.
        """
        count, scene, size = len(self.logarithms), self.scene, values.square().mean().sqrt().item()
        lengths = scene.spacing, EDGES * (scene.upper - scene.lower).max().item()
        signals, noises = (
            (size or 1.0) * np.array([1 / LARGEST, most]) for most in (WIDEST, LARGEST)
        )
        bounds = np.log(
            [lengths, signals, noises, *([scale_bounds(scene)] if scene.has_band else [])]
        )
        shared = len(bounds)
        if has_deviations:
            bounds = np.concatenate((bounds, np.tile([-20.0, 20.0], (3 * count, 1))))
        spread, heard = (
            torch.tensor(DEVIATIONS, dtype=torch.float64),
            values[around.rows].where(around.found, 0),
        )
        factors = torch.ones_like(heard)

        def unpacked(point: Tensor) -> tuple[Float[Tensor, "r 3"], Choice]:
            own = point[:3].expand(count, 3)
            if has_deviations:
                own = own + spread * point[shared:].reshape(count, 3)
            return own, choice if shared == 3 else choice._replace(scale=point[3].exp())

        def cost(point: np.ndarray) -> tuple[float, np.ndarray]:
            with torch.enable_grad():
                leaf = torch.tensor(point, requires_grad=True)
                own, made = unpacked(leaf)
                noises, between = (
                    (2 * own[around.receivers, 2]).exp(),
                    covariances(around, own.exp(), made),
                )
                means, variances = conditional(between, heard, noises[:, None] * factors)
                total = -log_density(values[asked] - means, variances, noises, made.degrees).sum()
                total = (
                    total + ((DEGREES + 1) / 2 * (leaf[shared:].square() / DEGREES).log1p()).sum()
                )
                if prior is not None:
                    total = total + ((leaf[:3] - prior) / spread).square().sum() / 2
                (gradient,) = torch.autograd.grad(total, leaf)
            return total.item(), gradient.numpy()

        if not size:  # the trend explains all: any hyperparameters do
            own, made = unpacked(torch.from_numpy(bounds.mean(1)))
            return -math.inf, own, made._replace(scale=float(made.scale))
        if start is None:
            grid = [(a, b) for a in bounds[0] @ [[5, 3, 1], [1, 3, 5]] / 6 for b in (0.5, 0.8)]
            points = [
                [a, np.log(size * b), np.log(size * (1 - b * b) ** 0.5), *bounds[3:shared].mean(1)]
                for a, b in grid
            ]
            point = np.array(min(points, key=lambda point: cost(np.array(point))[0]))
        else:
            point = np.concatenate((start.mean(0).numpy(), np.log([choice.scale][: shared - 3])))
        point = np.concatenate((point, np.zeros(len(bounds) - shared)))
        for repeat in range(1 if math.isinf(choice.degrees) else 2):
            if repeat:
                own, made = unpacked(torch.from_numpy(point))
                between = covariances(around, own.exp(), made)[:, :-1, :-1]
                factors = expected_factors(
                    between, heard, (2 * own[around.receivers, 2]).exp(), made.degrees
                )
            if stages.is_up():  # the start has to do
                least = cost(point)[0]
                continue
            options = {"maxiter": ITERATIONS, "ftol": 1e-8}
            found = minimize(
                cost,
                point,
                jac=True,
                method="L-BFGS-B",
                bounds=bounds,
                options=options,
                callback=stages.end_in_time,
            )
            point, least = found.x, float(found.fun)
        stages.advance()
        own, made = unpacked(torch.from_numpy(point))
        return least, own, made._replace(scale=float(made.scale))

    def _held_out(
        self, held: Int[Tensor, " h"], folds: Int[Tensor, " k"], most: int
    ) -> tuple[Tensor, Around]:
        """About ``most`` of the rows that may be held out (m,), and the readings of other folds
        around each.

        Receivers have 16 each or more, unless that makes four times as many.
        """
        own = [held[self.receivers[held] == receiver] for receiver in self.receivers[held].unique()]
        each = max(1, most // len(own), min(16, 4 * most // len(own)))
        asked = torch.cat([evenly(rows, each) for rows in own])
        nearest = self._nearest(
            self.places[asked], self.receivers[asked], folds[asked], folds, reach=True
        )
        return asked, self._around(self.places[asked], self.receivers[asked], nearest)

    def _nearest(
        self,
        places: Float[Tensor, "m d"],
        receivers: Int[Tensor, " m"],
        own: Int[Tensor, " m"] | None = None,
        folds: Int[Tensor, " k"] | None = None,
        reach: bool = False,
    ) -> tuple[Int[Tensor, "m j"], Bool[Tensor, "m j"]]:
        """Rows of the nearest known readings, see ``Around``; without those of a place's ``own``
        fold, if given.

        With ``reach`` half of them lie farther and farther away: near ones alone say little on
        lengths. Source: Stein, Chi and Welty, Approximating likelihoods for large spatial data
        sets, 2004.
        """
        rows = receivers.new_zeros(len(places), NEAREST)
        found = torch.zeros_like(rows, dtype=torch.bool)
        # Among carriers the nearest readings are those of a middle scale, so that they stay the
        # same during a fit.
        scale = math.sqrt(math.prod(scale_bounds(self.scene))) if self.scene.has_band else math.nan
        for receiver in receivers.unique().tolist():
            known = (self.receivers == receiver).nonzero()[:, 0]
            there, count = scaled(self.places[known], scale), min(NEAREST, len(known))
            for asked in (receivers == receiver).nonzero()[:, 0].split(PART):
                apart = distances(scaled(places[asked], scale), there)
                if own is not None:
                    apart = apart.masked_fill(own[asked, None] == folds[known], math.inf)
                farthest = int(apart.isfinite().sum(1).min())
                if reach and farthest > NEAREST:
                    half = NEAREST // 2
                    far = torch.from_numpy(np.geomspace(half, farthest - 1, half)).round().long()
                    ranks = torch.cat((torch.arange(half), far))
                    rows[asked], found[asked] = known[apart.argsort(1)[:, ranks]], True
                    continue
                near = apart.topk(count, largest=False)
                rows[asked, :count], found[asked, :count] = (
                    known[near.indices],
                    near.values.isfinite(),
                )
        return rows, found

    def _around(
        self,
        places: Float[Tensor, "m d"],
        receivers: Int[Tensor, " m"],
        nearest: tuple[Int[Tensor, "m j"], Bool[Tensor, "m j"]],
    ) -> Around:
        rows, found = nearest
        points = torch.cat((self.places[rows], places[:, None]), 1)
        known = torch.nn.functional.pad(found, (0, 1), value=True)
        apart = distances(points[..., :3], points[..., :3]).where(
            known[:, :, None] & known[:, None], 1e15
        )
        bands = (points[..., 3:] - points[..., 3:].mT).square() if self.scene.has_band else None
        return Around(rows, found, receivers, apart, bands)

    def _factors(self, values: Float[Tensor, " k"]) -> Float[Tensor, " k"]:
        """Variances of the noise of all known readings over those of their receivers; 1 if it is
        normal.
        """
        choice, factors = Choice(*self.choice.tolist()), torch.ones_like(values)
        if math.isinf(choice.degrees):
            return factors
        places, receivers, rows = (
            self.places,
            self.receivers,
            torch.arange(len(values), device=values.device),
        )
        parts = [
            (part, self._nearest(places[part], receivers[part], part, rows))
            for part in rows.split(PART)
        ]
        noises = (2 * self.logarithms[receivers, 2]).exp()
        for _ in range(ROUNDS):
            expected = []
            for part, nearest in parts:
                around = self._around(places[part], receivers[part], nearest)
                between, own = covariances(around, self.logarithms.exp(), choice), noises * factors
                means, variances = conditional(between, values[around.rows], own[around.rows])
                own = own[part]
                shares = own / (variances + own)
                expected.append(
                    ((shares * (values[part] - means)).square() + variances * shares) / noises[part]
                )
            factors = (choice.degrees + torch.cat(expected)) / (choice.degrees + 1)
        return factors

    def _covariances(
        self, a: Float[Tensor, "m d"], b: Float[Tensor, "n d"], receiver: int
    ) -> Float[Tensor, "m n"]:
        length, signal, _ = self.logarithms[receiver].exp()
        smoothness, _, scale = self.choice.tolist()
        return signal**2 * matern(distances(scaled(a, scale), scaled(b, scale)), length, smoothness)

    def _load_from_state_dict(self, state_dict, prefix, *args):
        resize(self, state_dict, prefix, "places", "receivers", "values", "variances", "weights")
        super()._load_from_state_dict(state_dict, prefix, *args)


def covariances(
    around: Around, hyperparameters: Float[Tensor, "r 3"], choice: Choice
) -> Float[Tensor, "m i i"]:
    """Covariances of z at the readings around each place, and at the place itself."""
    length, signal, _ = (
        part[:, None, None] for part in hyperparameters[around.receivers].unbind(1)
    )
    apart = around.apart
    if around.bands is not None:  # below 1e-12 m the root has no finite gradient
        apart = (apart.square() + choice.scale**2 * around.bands).clamp_min(1e-24).sqrt()
    return signal.square() * matern(apart, length, choice.smoothness)


def conditional(
    between: Float[Tensor, "m i i"], values: Float[Tensor, "m j"], variances: Float[Tensor, "m j"]
) -> tuple[Float[Tensor, " m"], Float[Tensor, " m"]]:
    """Means and variances of z at places, from ``covariances``, the readings around, and their
    noise's variances.

    The weights minimise the variance: its gradient, and that of the mean, need no derivative of
    weights or factor.
    """
    noisy = between + torch.diag_embed(torch.nn.functional.pad(variances, (0, 1)))
    with torch.no_grad():
        factor = torch.linalg.cholesky(noisy[:, :-1, :-1])
        solved = torch.cholesky_solve(torch.stack((-noisy[:, :-1, -1], values), 2), factor)
        both = torch.nn.functional.pad(solved, (0, 0, 0, 1))
        both[:, -1, 0] = 1
    products = (both[:, None, :, 0] @ noisy @ both)[:, 0]
    return products[:, 1] - (solved[..., 0] * values).sum(1), products[:, 0]


def expected_factors(
    between: Float[Tensor, "m j j"],
    values: Float[Tensor, "m j"],
    noises: Float[Tensor, " m"],
    degrees: float,
) -> Float[Tensor, "m j"]:
    """Variances of the noise of the readings around each place over ``noises``, from these readings
    alone.

    A held-out reading must have no part in them.
    """
    factors, noises = torch.ones_like(values), noises[:, None]
    for _ in range(ROUNDS):
        own = noises * factors
        inverse = torch.linalg.inv(between + torch.diag_embed(own))
        solved = (inverse @ values[..., None])[..., 0]
        squares = (own * solved).square() + own - own.square() * inverse.diagonal(dim1=1, dim2=2)
        factors = (degrees + squares / noises) / (degrees + 1)
    return factors


def log_density(
    errors: Float[Tensor, " m"],
    variances: Float[Tensor, " m"],
    noises: Float[Tensor, " m"],
    degrees: float,
) -> Float[Tensor, " m"]:
    """log p of errors that are the sum of a normal variable and of noise with ``noises`` as squared
    scale.

    Student's t is a mixture of normal distributions, whose precision times ``noises`` is a gamma
    variable: the trapezoidal rule over its logarithm is exact to 1e-3 up to a hundred standard
    deviations.
    """
    normal = lambda e, v: -(e.square() / v + v.log() + math.log(2 * math.pi)) / 2
    if math.isinf(degrees):
        return normal(errors, variances + noises)
    precisions = torch.linspace(
        math.log(1e-5), math.log(10), 28, dtype=errors.dtype, device=errors.device
    )
    weights = torch.log_softmax(degrees / 2 * (precisions - precisions.exp()), 0)
    mixed = variances[:, None] + noises[:, None] / precisions.exp()
    return torch.logsumexp(weights + normal(errors[:, None], mixed), 1)
