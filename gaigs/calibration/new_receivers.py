"""Bounds of errors at receivers without links, where all errors of one receiver are dependent."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import minimize
from scipy.special import stdtrit
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from gaigs.core.geometry import FAINTEST
from gaigs.core.query import evenly


class NewReceivers(NamedTuple):
    """Receivers of n links, each predicted as if its receiver were new.

    Source: Hahn and Meeker, Statistical Intervals, 1991, for the prediction of a normal number.
    """

    receivers: Int[Tensor, " n"]
    are_taught: Bool[Tensor, " n"]  # True for links of receivers from which the room was learnt

    def quantiles(
        self,
        errors: Float[Tensor, "n m"],
        inside: Bool[Tensor, "n m"],
        levels: Float[Tensor, " q"],
        parts: int = 200,
        draws: int = 50,
    ) -> Float[Tensor, " q"]:
        """Bounds of the errors at one more receiver, for each level p.

        Each receiver has a quantile of its errors at level p. Its logarithm is taken as normal over
        receivers. With k receivers it has the mean c and the standard deviation s. The logarithm at
        one more receiver is

            c + s (1 + 1/k)^½ t

        with Student's t of k - 1 degrees of freedom. The bound b holds errors with probability p:

            p = mean over t of F(log b - c - s (1 + 1/k)^½ t)

        F is the distribution of log errors relative to their receiver's quantile. Errors are
        smaller at receivers from which the room was learnt. If errors at the other receivers are
        larger, c and k are those of the other receivers alone. s is relative to the mean of each of
        these two kinds of receivers.

        Args:
            errors: Errors of all label values.
            inside: True for the label values that are used.
            levels: Levels p of the intervals.
            parts, draws: Numbers of points at which F and the distribution of t are taken.
        """
        middles = (torch.arange(parts, dtype=torch.float64) + 0.5) / parts
        # Log errors of each receiver: points of their distribution, and quantiles of the levels.
        points, receiver_quantiles, kinds = [], [], []
        for receiver in self.receivers.unique():
            rows = self.receivers == receiver
            logs = errors[rows][inside[rows]].double().clamp_min(FAINTEST).log().sort().values
            if len(logs):
                points.append(quantile(logs, middles))
                receiver_quantiles.append(quantile(logs, levels))
                kinds.append(self.are_taught[rows][0])
        quantiles, taught = torch.stack(receiver_quantiles), torch.stack(kinds)  # (k, q), (k,)
        relative = torch.stack(points)[:, None] - quantiles[..., None]  # (k, q, parts)
        distributions = relative.movedim(0, 1).flatten(1).sort().values  # F (q, k parts)
        chances = (torch.arange(draws, dtype=torch.float64) + 0.5) / draws
        freedom = max(len(taught) - len(taught.unique()), 1)  # a mean of each kind is fitted
        t = torch.from_numpy(stdtrit(freedom, chances.numpy()))  # (draws,)
        bounds = []
        for level, at_level, logs in zip(levels, quantiles.T, distributions, strict=True):
            centre, scale = _predictive(at_level, taught, freedom)
            # Log errors at a new receiver: all sums of its quantile and a relative error.
            sums = (centre + scale * t)[:, None] + quantile(logs, middles)  # (draws, parts)
            rank = (level * sums.numel() - 1e-9).ceil().clamp(1, sums.numel())
            bounds.append(sums.flatten().kthvalue(int(rank)).values)  # faster than a sort
        # A higher level may have a lower bound if receivers differ less there; bounds must rise.
        logarithms = torch.stack(bounds).cummax(0).values
        return logarithms.clamp_max(-math.log(FAINTEST)).exp()


def _predictive(
    values: Float[Tensor, " k"], are_taught: Bool[Tensor, " k"], freedom: int
) -> tuple[Tensor, Tensor]:
    """Centre and scale of Student's t distribution of a quantity at one more receiver.

    ``values`` has the quantity at k receivers.
    """
    kinds = [values[are_taught == kind] for kind in are_taught.unique()]
    squares = torch.stack([(kind - kind.mean()).square().sum() for kind in kinds])
    # A room fits best the receivers from which it was learnt. If the others have smaller errors,
    # that is by chance, and all receivers count.
    others = values[~are_taught]
    used = others if len(others) and others.mean() > values.mean() else values
    variance = squares.sum() / freedom * (1 + 1 / len(used))  # of a new value about the mean
    return used.mean(), variance.sqrt()


def quantile(numbers: Float[Tensor, " n"], levels: Float[Tensor, "*q"]) -> Float[Tensor, "*q"]:
    """The smallest of n sorted numbers at or below which a share ``levels`` of them lies."""
    ranks = (levels * len(numbers) - 1e-9).ceil().long()
    return numbers[(ranks - 1).clamp(0, len(numbers) - 1)]


def fit_law(
    errors: Sequence[Float[Tensor, " _"]], places: Sequence[Float[Tensor, "_ 3"]], most: int = 100
) -> Float[Tensor, "4"]:
    """Maximum-likelihood parameters of the error covariance of ``gaigs.model.adapted`` (4,).

    Links farther apart than the field's length hardly determine the noise. So the logarithm of the
    noise has a normal prior about 0.3 mean squares, with a standard deviation of 1.

    Args:
        errors: Errors of the links of each receiver (k,), predicted as if it were new.
        places: Transmitters of these links (k, 3) [m].
        most: Largest number of links that are used at a receiver.
    """
    used_errors, used_places = [], []
    for receiver_errors, receiver_places in zip(errors, places, strict=True):
        rows = evenly(torch.arange(len(receiver_errors)), most)
        used_errors.append(receiver_errors[rows].double())
        used_places.append(receiver_places[rows].double())
    mean_square = torch.cat(used_errors).square().mean().clamp_min(1e-9)
    # Receivers with fewer links are padded with errors of 0 that correlate with nothing.
    ones = [torch.ones(len(part)) for part in used_errors]
    exists = pad_sequence(ones, batch_first=True)  # (r, k)
    padded = pad_sequence(used_errors, batch_first=True)[..., None]  # (r, k, 1)
    positions = pad_sequence(used_places, batch_first=True)  # (r, k, 3)
    apart = torch.cdist(positions, positions)  # (r, k, k)
    pairs = exists[:, :, None] * exists[:, None]  # (r, k, k)
    size = (pairs * apart).amax((1, 2)).median().clamp_min(1e-6)  # of the site [m]
    units = torch.stack((mean_square, mean_square, mean_square, size))
    start = np.log([0.25, 0.3, 0.3, 0.05])  # level, noise, field, length over ``units``

    def cost(logarithms: np.ndarray) -> float:
        """Mean negative log posterior of parameters over ``units``, without constant terms."""
        prior = (logarithms[1] - start[1]) ** 2 / 2
        level, noise, field, length = torch.from_numpy(logarithms).exp() * units
        covariances = pairs * (level + field * (-apart / length).exp())
        variances = torch.where(exists > 0, noise, 1.0)
        # -log p(e) = |L^-1 e|² / 2 + log det L, with the covariance matrix L L'.
        factor = torch.linalg.cholesky(covariances + variances.diag_embed())  # L (r, k, k)
        white = torch.linalg.solve_triangular(factor, padded, upper=False)  # (r, k, 1)
        log_det = factor.diagonal(dim1=1, dim2=2).log().sum()  # padding adds 0
        return ((white.square().sum() / 2 + log_det + prior) / exists.sum()).item()

    # Variances from 1e-4 to 20 mean squares, lengths from 0.1 % to 3 sizes of the site.
    bounds = [(-9.0, 3.0)] * 3 + [(-7.0, 1.0)]
    result = minimize(cost, start, method="L-BFGS-B", bounds=bounds)
    return torch.from_numpy(np.exp(result.x)) * units
