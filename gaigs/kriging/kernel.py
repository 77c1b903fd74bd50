"""The Matern-1/2 kernel exp(-d / l), and kriging weights with their variance."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from gaigs.kriging.links import distances


@dataclass(frozen=True)
class Process:
    """The Gaussian process of one receiver's labels over places, and the readings that it knows.

    Attributes:
        covariances: Of the process at two sets of places (m, d) and (n, d), in the label's unit
            squared.
        places: Of the known readings, ``coordinates`` of scale 1 (k, d) [m].
        noises: Variances of the noise of the known readings (k,).
        noise: Variance of the noise of a new reading.
    """

    covariances: Callable[[Tensor, Tensor], Tensor]
    places: Float[Tensor, "k d"]
    noises: Float[Tensor, " k"]
    noise: float

    def whitened(
        self, asked: Float[Tensor, "g d"], rows: Int[Tensor, " j"] | slice = slice(None)
    ) -> tuple[Float[Tensor, "j g"], Float[Tensor, "j j"]]:
        """Covariances of known readings, or some rows of them, with places over the readings'
        Cholesky factor; and this factor. Squares of the first, summed over the readings, are what
        they take off the variance at a place."""
        places = self.places[rows]
        own = self.covariances(places, places)
        own.diagonal().add_(self.noises[rows])
        factor = torch.linalg.cholesky(own)
        return torch.linalg.solve_triangular(
            factor, self.covariances(places, asked), upper=False
        ), factor


def resize(module: nn.Module, state: Mapping[str, Tensor], prefix: str, *names: str) -> None:
    """Gives buffers the shapes that they have in a state, which is then loaded: they depend on the
    links.
    """
    for name in names:
        if f"{prefix}{name}" in state:
            setattr(module, name, getattr(module, name).new_empty(state[f"{prefix}{name}"].shape))


LIMIT = 6000
"""Most known links of a receiver that enter one covariance matrix, for memory's sake."""


def kernel(
    a: Float[Tensor, "*c m d"], b: Float[Tensor, "*c n d"], length: float | Tensor
) -> Float[Tensor, "*c m n"]:
    """Covariances exp(-d / length) of places ``a`` and ``b`` over the signal's variance; places and
    length in [m].
    """
    return (distances(a, b) / -length).exp_()


def covariance(places: Float[Tensor, "k d"], length: float, nugget: float) -> Float[Tensor, "k k"]:
    """Covariances of noisy labels over the signal's variance; arguments as for ``kriging_weights``."""
    covariances = kernel(places, places, length)
    covariances.diagonal().add_(nugget)
    return covariances


def cholesky_factor(
    places: Float[Tensor, "k d"], length: float, nugget: float
) -> Float[Tensor, "k k"]:
    """Lower Cholesky factor of ``covariance``."""
    return torch.linalg.cholesky(covariance(places, length, nugget))


def kriging_weights(
    asked: Float[Tensor, "b d"],
    around: Float[Tensor, "b j d"],
    length: float | Tensor,
    nugget: float | Tensor,
) -> tuple[Float[Tensor, "b j"], Float[Tensor, " b"]]:
    """Weights of the known links around each asked link, and the variance of its label over the
    signal's.

    Args:
        asked, around: Places, see ``coordinates`` [m].
        length: Correlation length of the kernel [m].
        nugget: Variance of the noise over that of the signal.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 2.2.
    """
    identity = torch.eye(around.shape[1], dtype=around.dtype, device=around.device)
    covariances = kernel(around, around, length) + nugget * identity
    towards = kernel(around, asked[:, None], length)
    weights = torch.linalg.solve(covariances, towards)[
        ..., 0
    ]  # its gradient takes a third of the Cholesky factor's
    return weights, 1 + nugget - (weights * towards[..., 0]).sum(1)
