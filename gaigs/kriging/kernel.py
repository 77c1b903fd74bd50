"""Kernels of Gaussian processes, and kriging weights with their variance.

Labels with many values and paths use ``kernel``, scalar labels ``matern``.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gaigs.kriging.links import distances


@dataclass(frozen=True)
class Process:
    """The Gaussian process of one receiver's labels over places, and its known readings."""

    # Function of two sets of places (m, d) and (n, d) to the covariances of the process, in the
    # label's unit squared.
    covariances: Callable[[Tensor, Tensor], Tensor]
    places: Float[Tensor, "k d"]  # places of the known readings, ``coordinates`` of scale 1 [m]
    noises: Float[Tensor, " k"]  # variances of the noise of the known readings
    noise: float  # variance of the noise of a new reading
    is_part: bool = False  # True if a part of the receiver's readings was left out

    def whitened(
        self, asked: Float[Tensor, "g d"], rows: Int[Tensor, " j"] | slice = slice(None)
    ) -> tuple[Float[Tensor, "j g"], Float[Tensor, "j j"]]:
        """Whitened covariances L^-1 C, and the Cholesky factor L.

        C has the covariances of readings with places; L L' is the covariance matrix of the noisy
        readings. Readings lower the variance at a place by the sum of squares of the place's column
        in L^-1 C.

        Args:
            asked: Places, ``coordinates`` of scale 1 [m].
            rows: Numbers of the known readings to use; by default all.
        """
        places = self.places[rows]
        between = self.covariances(places, places)
        between.diagonal().add_(self.noises[rows])
        factor = torch.linalg.cholesky(between)
        towards = self.covariances(places, asked)
        return torch.linalg.solve_triangular(factor, towards, upper=False), factor


def resize(module: nn.Module, state: Mapping[str, Tensor], prefix: str, *names: str) -> None:
    """Gives buffers of a module the shapes that they have in a ``state``, before it is loaded.

    ``names`` are names of the buffers, whose keys in the state begin with ``prefix``.
    """
    for name in names:
        stored = state.get(f"{prefix}{name}")
        if stored is not None:
            setattr(module, name, getattr(module, name).new_empty(stored.shape))


LIMIT = 6000
"""Largest number of a receiver's known links in one covariance matrix, to limit memory."""

SMOOTHNESSES = (0.5, 1.5)
"""Values of ``smoothness`` in ``matern`` that are tried for scalar labels."""


def matern(apart: Tensor, length: Tensor, smoothness: float) -> Tensor:
    """Matern correlation, of smoothness 1/2 or 3/2, at the distances ``apart`` [m].

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, equations 4.16
    and 4.17.
    """
    steps = apart * (-math.sqrt(2 * smoothness) / length)
    decay = steps.exp()
    return decay if smoothness == 0.5 else decay.addcmul(steps, decay, value=-1)


def matern_slope(correlation: Tensor, apart: Tensor, length: Tensor, smoothness: float) -> Tensor:
    """Derivative of ``matern`` by the logarithm of the length; ``correlation`` is its value."""
    steps = apart * (math.sqrt(2 * smoothness) / length)  # s
    if smoothness == 0.5:  # d exp(-s) / d ln l = s exp(-s)
        return steps * correlation
    # d (1 + s) exp(-s) / d ln l = s^2 exp(-s)
    return correlation * steps.square() / (1 + steps)


def kernel(
    a: Float[Tensor, "*c m d"], b: Float[Tensor, "*c n d"], length: float | Tensor
) -> Float[Tensor, "*c m n"]:
    """Correlations exp(-d / length) of places ``a`` and ``b`` at the distance d [m]."""
    return (distances(a, b) / -length).exp_()


def covariance(places: Float[Tensor, "k d"], length: float, nugget: float) -> Float[Tensor, "k k"]:
    """Covariances of noisy labels over the signal's variance; arguments as ``kriging_weights``."""
    covariances = kernel(places, places, length)
    covariances.diagonal().add_(nugget)
    return covariances


def cholesky_factor(
    places: Float[Tensor, "k d"], length: float, nugget: float
) -> Float[Tensor, "k k"]:
    """Lower Cholesky factor of ``covariance``, with the same arguments."""
    return torch.linalg.cholesky(covariance(places, length, nugget))


def kriging_weights(
    asked: Float[Tensor, "b d"],
    around: Float[Tensor, "b j d"],
    length: float | Tensor,
    nugget: float | Tensor,
) -> tuple[Float[Tensor, "b j"], Float[Tensor, " b"]]:
    """Weights w of the known links around each asked link, and the variance of the prediction w'y.

    The variance is relative to the signal's and includes the noise of the asked label.

    Args:
        asked, around: ``coordinates`` of the asked links, and of j known links around each [m].
        length: Correlation length of the kernel [m].
        nugget: Variance of the noise over the signal's.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 2.2.
    """
    identity = torch.eye(around.shape[1], dtype=around.dtype, device=around.device)
    covariances = kernel(around, around, length) + nugget * identity
    towards = kernel(around, asked[:, None], length)
    # The gradient of ``solve`` takes a third of the time of the Cholesky factor's.
    weights = torch.linalg.solve(covariances, towards)[..., 0]  # (b, j)
    return weights, 1 + nugget - (weights * towards[..., 0]).sum(1)
