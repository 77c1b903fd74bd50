"""Densities of readings given the readings around them: normal, or with Student's t noise."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.kriging.kernel import matern, matern_slope
from gaigs.kriging.neighbours import Around


class Choice(NamedTuple):
    """Kernel and noise of a process."""

    smoothness: float = 0.5  # of the kernel, see ``matern``
    degrees: float = math.inf  # degrees of freedom of the noise; inf is normal noise
    scale: float | Tensor = math.nan  # of carriers, see ``coordinates`` [m]; NaN for one carrier
    is_local: bool = False  # True if length and noise differ from place to place


class Conditional(NamedTuple):
    """Prediction of the process at m places, given j readings around each."""

    means: Float[Tensor, " m"]
    variances: Float[Tensor, " m"]
    errors: Float[Tensor, "m i"]  # kriging weights of the readings, then -1 (m, j + 1)
    solved: Float[Tensor, "m i"]  # inverse covariance matrix times readings, then 0 (m, j + 1)


def covariances(
    around: Around, hyperparameters: Float[Tensor, "r 3"], choice: Choice
) -> Float[Tensor, "m i i"]:
    """Covariances of the process z among the readings around each place and the place itself.

    ``hyperparameters`` are correlation length, standard deviation of the signal, and standard
    deviation of the noise, at each receiver.
    """
    of_places = hyperparameters[around.receivers][..., None, None]  # (m, 3, 1, 1)
    length, signal, _ = of_places.unbind(1)
    return signal.square() * matern(separations(around, choice), length, choice.smoothness)


def separations(around: Around, choice: Choice) -> Float[Tensor, "m i i"]:
    """Distances that include the difference of carriers, as between ``coordinates``."""
    if around.bands is None:
        return around.apart
    return (around.apart.square() + choice.scale**2 * around.bands).sqrt()


def conditional(
    between: Float[Tensor, "m i i"], values: Float[Tensor, "m j"], variances: Float[Tensor, "m j"]
) -> Conditional:
    """Means and variances of z at places, given the readings y around each place.

    The mean is w'y, and the variance k - 2 w'c + w'(C + N) w. C, c and k are the covariances of z
    among the readings, between readings and place, and at the place, all from ``between``. N has
    the noise ``variances`` of the readings. The weights w = (C + N)^-1 c minimise the variance.
    """
    noisy = between[:, :-1, :-1] + torch.diag_embed(variances)
    towards = between[:, :-1, -1]  # c (m, j)
    factor = torch.linalg.cholesky(noisy)
    solved = torch.cholesky_solve(torch.stack((towards, values), 2), factor)  # (m, j, 2)
    weights, readings = solved.unbind(2)
    means = (weights * values).sum(1)
    of_place = between[:, -1, -1] - (weights * towards).sum(1)
    errors = torch.nn.functional.pad(weights, (0, 1), value=-1.0)
    return Conditional(means, of_place, errors, torch.nn.functional.pad(readings, (0, 1)))


def slopes(
    around: Around,
    hyperparameters: Float[Tensor, "r 3"],
    choice: Choice,
    between: Float[Tensor, "m i i"],
    variances: Float[Tensor, "m j"],
    solution: Conditional,
    of_mean: Float[Tensor, " m"],
    of_variance: Float[Tensor, " m"],
) -> Float[Tensor, "m 4"]:
    """Derivatives of a cost by the logarithms of length, signal, noise and scale of carriers.

    A change dC of all covariances changes the variance by e' dC e and the mean by -e' dC s, with
    ``errors`` e and ``solved`` s of ``solution``, since the weights minimise the variance.

    Args:
        around, hyperparameters, choice, between, variances: As for ``covariances`` and
            ``conditional``.
        solution: Result of ``conditional``.
        of_mean, of_variance: Derivatives of the cost by the means and variances of ``solution``.
    """
    errors, solved = solution.errors, solution.solved
    right = of_variance[:, None] * errors - of_mean[:, None] * solved  # (m, j + 1)

    def along(change: Float[Tensor, "m i i"]) -> Float[Tensor, " m"]:
        return (errors * (change @ right[..., None])[..., 0]).sum(1)

    length = hyperparameters[around.receivers, 0][:, None, None]
    apart = separations(around, choice)
    slope = matern_slope(between, apart, length, choice.smoothness)
    scale = torch.zeros_like(of_mean)
    if around.bands is not None:
        # d apart / d ln c = c^2 bands / apart, and d apart / d ln l acts as -apart.
        scale = -along(slope * choice.scale**2 * around.bands / apart.square().clamp_min(1e-24))
    noise = (errors[:, :-1] * right[:, :-1] * variances).sum(1)
    return torch.stack((along(slope), 2 * along(between), 2 * noise, scale), 1)


def expected_factors(
    between: Float[Tensor, "m j j"],
    values: Float[Tensor, "m j"],
    noises: Float[Tensor, " m"],
    degrees: float,
    rounds: int = 3,
) -> Float[Tensor, "m j"]:
    """Expected variance of each reading's noise over ``noises``, if noise has Student's t.

    Only the readings around a place are used; the held-out reading there must have no influence.

    Args:
        between: Covariances of z at the readings.
        values: The readings.
        noises: Squared scale of the noise at each place's receiver.
        degrees: Degrees of freedom of Student's t.
        rounds: Repetitions of expectation and maximisation.

    Source: Lange, Little and Taylor, Robust statistical modeling using the t distribution, 1989.
    """
    factors = torch.ones_like(values)
    noises = noises[:, None]
    for _ in range(rounds):
        variances = noises * factors
        inverse = torch.linalg.inv(between + torch.diag_embed(variances))
        solved = (inverse @ values[..., None])[..., 0]  # (m, j)
        # Expected square of the noise given the readings: square of its mean, plus its variance.
        diagonal = inverse.diagonal(dim1=1, dim2=2)
        squares = (variances * solved).square() + variances - variances.square() * diagonal
        factors = (degrees + squares / noises) / (degrees + 1)
    return factors


def log_density(
    errors: Float[Tensor, " m"],
    variances: Float[Tensor, " m"],
    noises: Float[Tensor, " m"],
    degrees: float,
) -> Float[Tensor, " m"]:
    """log p of errors that are the sum of a normal variable and of noise.

    The normal variable has the ``variances``. The noise has Student's t with ``degrees`` of freedom
    and the squared scale ``noises``; with infinite ``degrees`` it is normal. Student's t is a
    mixture of normal distributions whose precision, times ``noises``, is a gamma variable. The
    mixture is integrated by the trapezoidal rule over the logarithm of the precision. The result is
    exact to 1e-3 up to a hundred standard deviations.
    """
    if math.isinf(degrees):
        return _log_normal(errors, variances + noises)
    precisions = torch.linspace(
        math.log(1e-5), math.log(10), 28, dtype=errors.dtype, device=errors.device
    )
    weights = torch.log_softmax(degrees / 2 * (precisions - precisions.exp()), 0)
    mixed = variances[:, None] + noises[:, None] / precisions.exp()  # (m, 28)
    return torch.logsumexp(weights + _log_normal(errors[:, None], mixed), 1)


def _log_normal(errors: Tensor, variances: Tensor) -> Tensor:
    return -(errors.square() / variances + variances.log() + math.log(2 * math.pi)) / 2
