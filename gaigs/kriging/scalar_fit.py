"""Fit of the hyperparameters of scalar processes to held-out readings, by their likelihood."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import minimize
from torch import Tensor

from gaigs.core import stages
from gaigs.core.scene import Scene
from gaigs.kriging.likelihood import (
    Choice,
    conditional,
    covariances,
    expected_factors,
    log_density,
    slopes,
)
from gaigs.kriging.links import scale_bounds
from gaigs.kriging.neighbours import HeldOutReadings
from gaigs.processes import torch_threads


@dataclass(frozen=True)
class ScalarOptions:
    """Options of a process of scalar labels.

    Attributes:
        neighbours: Number of readings around a held-out one during a fit.
        around: Number of nearest readings for a variance, if a receiver has more than ``many``; and
            for the noise of a reading with Student's t, if more than ``large`` are known. Farther
            readings lower a deviation by only a hundredth.
        local: Number of nearest readings for the mean at a place while a process is not solved.
        few: Number of known readings for each predicted place above which an unsolved process
            answers by ``local`` readings; otherwise it is solved first.
        large: Number of known readings above which models of single folds keep the hyperparameters
            of all readings. It is ten times the number that a fit holds out.
        many: Largest number of a receiver's readings that all enter a variance. With more, only the
            nearest ``around`` enter, to save time.
        together: Largest number of a receiver's readings in one covariance matrix; ``Tiles`` divide
            more.
        scatter: Prior scatter between receivers of the logarithms of length, signal and noise.
        degrees: Degrees of freedom of Student's t, for this scatter and for noise that is not
            normal.
        rounds: Repetitions of expectation and maximisation for the variances of single readings.
        iterations: Largest number of iterations of a maximisation.
        tolerance: Relative change of the negative log likelihood that ends a maximisation, much
            smaller than differences between hyperparameters.
        size: Number of places whose covariances are in memory at a time.
        edges: Longest correlation length [longest edges of the box of places]. With longer ones the
            kernel is linear in the box.
        widest: Largest deviation of the signal over the residuals' root mean square. Readings
            millimetres apart determine only the ratio of the deviation to a power of the length,
            and an unbounded deviation would predict impossible levels.
        largest: Largest deviation of the noise over the residuals' root mean square. Its inverse is
            the smallest deviation of signal and noise. The noise keeps matrices regular if a place
            is measured twice.
    """

    neighbours: int = 32
    around: int = 12
    local: int = 64
    few: int = 16
    large: int = 6000
    many: int = 300
    together: int = 1500
    scatter: tuple[float, float, float] = (0.25, 0.15, 0.15)
    degrees: float = 4.0
    rounds: int = 3
    iterations: int = 50
    tolerance: float = 1e-6
    size: int = 2048
    edges: float = 8.0
    widest: float = 2.0
    largest: float = 50.0


class ScalarFit(NamedTuple):
    """Result of a fit: the hyperparameters with the lowest cost.

    Attributes:
        cost: Negative log likelihood of the held-out readings, with the prior.
        logarithms: Logarithms of length, signal and noise at each receiver (r, 3).
        choice: Kernel, noise and scale of carriers.
    """

    cost: float
    logarithms: Float[Tensor, "r 3"]
    choice: Choice


class HeldOutCost:
    """Negative log posterior of hyperparameters, given held-out readings.

    A point of the search is a vector. It has the logarithms of length, signal and noise, common to
    all receivers; the logarithm of the scale of carriers if there are several; and, with
    ``has_deviations``, each receiver's differences from the first three, in units of their scatter.

    Args:
        scene: Receivers and carriers.
        values: Known readings, residuals of a trend (k,).
        held: Held-out readings, and readings around them.
        choice: Kernel and noise, which are fixed.
        has_deviations: True if each receiver has its own hyperparameters.
        prior: Logarithms about which the receivers' logarithms scatter; None: no prior.
        options: Options of the process.
    """

    def __init__(
        self,
        scene: Scene,
        values: Float[Tensor, " k"],
        held: HeldOutReadings,
        choice: Choice,
        has_deviations: bool,
        prior: Float[Tensor, " 3"] | None,
        options: ScalarOptions,
    ):
        self.options, self.choice, self.prior = options, choice, prior
        self.has_deviations = has_deviations
        self.count = scene.radios
        self.around = held.around
        self.asked = values[held.rows]
        self.readings = values[held.around.rows].where(held.around.exists, 0)
        self.factors = torch.ones_like(self.readings)
        self.spread = torch.tensor(options.scatter, dtype=torch.float64)
        self.size = values.square().mean().sqrt().item()
        self.bounds = self._bounds(scene)

    def _bounds(self, scene: Scene) -> np.ndarray:
        options, size = self.options, self.size or 1.0
        edge = (scene.upper - scene.lower).max().item()
        lengths = scene.spacing, options.edges * edge
        signals = size * np.array([1 / options.largest, options.widest])
        noises = size * np.array([1 / options.largest, options.largest])
        scales = [scale_bounds(scene)] if scene.has_band else []
        bounds = np.log([lengths, signals, noises, *scales])
        self.shared = len(bounds)
        if self.has_deviations:
            bounds = np.concatenate((bounds, np.tile([-20.0, 20.0], (3 * self.count, 1))))
        return bounds

    def unpacked(self, point: Tensor) -> tuple[Float[Tensor, "r 3"], Choice]:
        """Logarithms of each receiver's hyperparameters, and the choice, from a point."""
        logarithms = point[:3].expand(self.count, 3)
        if self.has_deviations:
            deviations = point[self.shared :].reshape(self.count, 3)
            logarithms = logarithms + self.spread * deviations
        has_scale = self.shared > 3
        choice = self.choice._replace(scale=point[3].exp()) if has_scale else self.choice
        return logarithms, choice

    def __call__(self, point: np.ndarray) -> tuple[float, np.ndarray]:
        """The cost at a point, and its gradient."""
        degrees = self.options.degrees
        likelihood, by_logarithms, by_scale = self._likelihood(point)
        with torch.enable_grad():
            leaf = torch.tensor(point, requires_grad=True)
            logarithms, _ = self.unpacked(leaf)
            # Student's t: one receiver may be far noisier than the others.
            squares = leaf[self.shared :].square() / degrees
            prior = ((degrees + 1) / 2 * squares.log1p()).sum()
            if self.prior is not None:
                steps = (leaf[:3] - self.prior) / self.spread
                prior = prior + steps.square().sum() / 2
            total = prior + (by_logarithms * logarithms).sum()
            if self.shared > 3:
                total = total + by_scale * leaf[3]
            (gradient,) = torch.autograd.grad(total, leaf)
        return likelihood + prior.item(), gradient.numpy()

    def _likelihood(self, point: np.ndarray) -> tuple[float, Float[Tensor, "r 3"], float]:
        """Negative log likelihood with its gradients.

        The gradients are with respect to the logarithms of all receivers' hyperparameters, and to
        the scale of carriers.
        The gradient of the matrices is written out; autograd would take several times as long.
        """
        logarithms, choice = self.unpacked(torch.from_numpy(point))
        receivers, hyperparameters = self.around.receivers, logarithms.exp()
        noises = hyperparameters[receivers, 2].square()  # (m,)
        between = covariances(self.around, hyperparameters, choice)
        noise_power = noises[:, None] * self.factors  # (m, j)
        given = conditional(between, self.readings, noise_power)
        with torch.enable_grad():
            leaves = [given.means, given.variances, noises]
            leaves = [leaf.detach().requires_grad_() for leaf in leaves]
            means, variances, noise = leaves
            total = -log_density(self.asked - means, variances, noise, choice.degrees).sum()
            of_mean, of_variance, of_noise = torch.autograd.grad(total, leaves)
        # By the logarithms of length, signal and noise of the readings around, and of the scale.
        of_place = slopes(  # (m, 4)
            self.around, hyperparameters, choice, between, noise_power, given, of_mean, of_variance
        )
        # The held-out reading's own noise: d variance / d log deviation = 2 variance.
        of_place[:, 2] += 2 * of_noise * noises
        gradient = torch.zeros_like(logarithms).index_add(0, receivers, of_place[:, :3])
        return total.item(), gradient, of_place[:, 3].sum().item()

    def start(self, logarithms: Float[Tensor, "r 3"] | None) -> np.ndarray:
        """The initial point: from earlier hyperparameters, or the best of a coarse grid."""
        if logarithms is not None:
            scale = np.log([self.choice.scale][: self.shared - 3])
            point = np.concatenate((logarithms.mean(0).numpy(), scale))
        else:
            middle = self.bounds[3 : self.shared].mean(1)
            points = []
            for length in self.bounds[0] @ [[5, 3, 1], [1, 3, 5]] / 6:
                for share in (0.5, 0.8):  # of the signal in the residuals
                    signal = np.log(self.size * share)
                    noise = np.log(self.size * (1 - share * share) ** 0.5)
                    points.append([length, signal, noise, *middle])
            point = np.array(min(points, key=lambda one: self(np.array(one))[0]))
        return np.concatenate((point, np.zeros(len(self.bounds) - self.shared)))

    def expect(self, point: np.ndarray) -> None:
        """Sets ``factors`` of the noise variances to their expected values at a point.

        A reading that disagrees with those around it then has little weight.
        """
        logarithms, choice = self.unpacked(torch.from_numpy(point))
        between = covariances(self.around, logarithms.exp(), choice)[:, :-1, :-1]
        noises = (2 * logarithms[self.around.receivers, 2]).exp()
        self.factors = expected_factors(
            between, self.readings, noises, choice.degrees, self.options.rounds
        )

    def fit_at(self, cost: float, point: np.ndarray) -> ScalarFit:
        """The hyperparameters of a point, with their cost."""
        logarithms, choice = self.unpacked(torch.from_numpy(point))
        return ScalarFit(cost, logarithms, choice._replace(scale=float(choice.scale)))


@torch_threads(1)  # more take longer for many small matrices
def maximise(cost: HeldOutCost, start: Float[Tensor, "r 3"] | None = None) -> ScalarFit:
    """The hyperparameters with the lowest cost, from ``start`` or a coarse grid.

    Noise with Student's t needs a second maximisation, with expected variances of single readings.
    """
    if not cost.size:  # the trend explains all: any hyperparameters do
        return cost.fit_at(-math.inf, cost.bounds.mean(1))
    point = cost.start(start)
    least = math.inf
    for repeat in range(1 if math.isinf(cost.choice.degrees) else 2):
        if repeat:
            cost.expect(point)
        if stages.is_up():  # the start has to do
            least = cost(point)[0]
            continue
        result = minimize(
            cost,
            point,
            jac=True,
            method="L-BFGS-B",
            bounds=cost.bounds,
            options={"maxiter": cost.options.iterations, "ftol": cost.options.tolerance},
            callback=stages.end_in_time,
        )
        point, least = result.x, float(result.fun)
    stages.advance()
    return cost.fit_at(least, point)
