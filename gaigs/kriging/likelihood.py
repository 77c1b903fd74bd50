"""Densities of readings given those around them: normal, or with Student's t as noise."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.kriging.kernel import matern
from gaigs.kriging.neighbours import Around


class Choice(NamedTuple):
    """Smoothness of the kernel, degrees of freedom of the noise (infinite: normal), scale of
    carriers [m] or NaN.
    """

    smoothness: float = 0.5
    degrees: float = math.inf
    scale: float | Tensor = math.nan


class Conditional(NamedTuple):
    """Means and variances of the process at places (m,), given the readings around."""

    means: Float[Tensor, " m"]
    variances: Float[Tensor, " m"]


def covariances(
    around: Around, hyperparameters: Float[Tensor, "r 3"], choice: Choice
) -> Float[Tensor, "m i i"]:
    """Covariances of z at the readings around each place, and at the place itself.

    ``hyperparameters`` are length, deviation of the signal and of the noise at each receiver.
    """
    of_places = hyperparameters[around.receivers][..., None, None]  # (m, 3, 1, 1)
    length, signal, _ = of_places.unbind(1)
    apart = around.apart
    if around.bands is not None:  # below 1e-12 m the root has no finite gradient
        apart = (apart.square() + choice.scale**2 * around.bands).clamp_min(1e-24).sqrt()
    return signal.square() * matern(apart, length, choice.smoothness)


def conditional(
    between: Float[Tensor, "m i i"], values: Float[Tensor, "m j"], variances: Float[Tensor, "m j"]
) -> Conditional:
    """Means and variances of z at places, from ``covariances``, the readings around, and the
    variances of their noise.

    Mean w'y and variance k - 2 w'c + w'(C + N) w have weights w that minimise the variance. So
    gradients, of the mean too, need no derivative of weights or factor.
    """
    noisy = between + torch.diag_embed(torch.nn.functional.pad(variances, (0, 1)))
    with torch.no_grad():
        factor = torch.linalg.cholesky(noisy[:, :-1, :-1])
        right = torch.stack((-noisy[:, :-1, -1], values), 2)  # (m, j, 2)
        solved = torch.cholesky_solve(right, factor)
        both = torch.nn.functional.pad(solved, (0, 0, 0, 1))  # (m, j + 1, 2)
        both[:, -1, 0] = 1
    products = (both[:, None, :, 0] @ noisy @ both)[:, 0]  # (m, 2)
    means = products[:, 1] - (solved[..., 0] * values).sum(1)
    return Conditional(means, products[:, 0])


def expected_factors(
    between: Float[Tensor, "m j j"],
    values: Float[Tensor, "m j"],
    noises: Float[Tensor, " m"],
    degrees: float,
    rounds: int = 3,
) -> Float[Tensor, "m j"]:
    """Variances of the noise of the readings around each place over ``noises``, from these readings
    alone: a held-out reading must have no part in them.

    Source: Lange, Little and Taylor, Robust statistical modeling using the t distribution, 1989.
    """
    factors = torch.ones_like(values)
    noises = noises[:, None]
    for _ in range(rounds):
        variances = noises * factors
        inverse = torch.linalg.inv(between + torch.diag_embed(variances))
        solved = (inverse @ values[..., None])[..., 0]  # (m, j)
        # Expected square of the noise: of its mean, and its variance given the readings.
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
    """log p of errors that are the sum of a normal variable and of noise with ``noises`` as squared
    scale.

    Student's t is a mixture of normal distributions, whose precision times ``noises`` is a gamma
    variable: the trapezoidal rule over its logarithm is exact to 1e-3 up to a hundred standard
    deviations.
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
