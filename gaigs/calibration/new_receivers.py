"""Bounds of errors at receivers without links, each of which errs as a whole."""

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
    """Receivers of links that models predicted as if their receivers were new.

    Source: Hahn and Meeker, Statistical Intervals, 1991, for the prediction of a normal number.
    """

    receivers: Int[Tensor, " n"]
    are_taught: Bool[Tensor, " n"]  # True for links of receivers from which the room has learnt

    def quantiles(
        self,
        errors: Float[Tensor, "n m"],
        inside: Bool[Tensor, "n m"],
        levels: Float[Tensor, " q"],
        parts: int = 200,
        draws: int = 50,
    ) -> Float[Tensor, " q"]:
        """Quantiles of the links' errors that are the bounds of errors at one more receiver.

        Receivers differ in their quantile of a level p, whose logarithm is taken as normal. Of k
        receivers these logarithms have the mean c and the deviation s. That of one more is

            c + s (1 + 1/k)^½ t

        with Student's t of k - 1 degrees of freedom. The bound b holds errors with the chance p

            p = mean over t of F(log b - c - s (1 + 1/k)^½ t)

        with F the distribution of log errors about their receiver's quantile. Receivers from which
        the room has learnt err less. If others err more, c is the others' mean, and k their number;
        s is about a mean for each kind.

        Args:
            errors: Errors of all numbers.
            inside: True for numbers that count.
            levels: Levels p of the intervals.
            parts, draws: Points at which F and the distribution of t are taken.
        """
        middles = (torch.arange(parts, dtype=torch.float64) + 0.5) / parts
        rows, own_bounds, kinds = [], [], []
        for receiver in self.receivers.unique():
            own = self.receivers == receiver
            numbers = errors[own][inside[own]].double().clamp_min(FAINTEST).log().sort().values
            if len(numbers):
                rows.append(quantile(numbers, middles))
                own_bounds.append(quantile(numbers, levels))
                kinds.append(self.are_taught[own][0])
        offsets, taught = torch.stack(own_bounds), torch.stack(kinds)  # (k, q), (k,)
        apart = torch.stack(rows)[:, None] - offsets[..., None]  # (k, q, parts)
        within = apart.movedim(0, 1).flatten(1).sort().values  # (q, k parts)
        chances = (torch.arange(draws, dtype=torch.float64) + 0.5) / draws
        freedom = max(len(taught) - len(taught.unique()), 1)
        t = torch.from_numpy(stdtrit(freedom, chances.numpy()))  # (draws,)
        bounds = []
        for level, offset, logs in zip(levels, offsets.T, within, strict=True):
            centre, scale = _predictive(offset, taught, freedom)
            sums = (centre + scale * t)[:, None] + quantile(logs, middles)  # (draws, parts)
            rank = (level * sums.numel() - 1e-9).ceil().clamp(1, sums.numel())
            bounds.append(sums.flatten().kthvalue(int(rank)).values)  # quicker than to sort them
        # Where receivers differ less at a higher level, its bound may be less.
        logarithms = torch.stack(bounds).cummax(0).values
        return logarithms.clamp_max(-math.log(FAINTEST)).exp()


def _predictive(
    numbers: Float[Tensor, " k"], are_taught: Bool[Tensor, " k"], freedom: int
) -> tuple[Tensor, Tensor]:
    """Centre and scale of Student's t distribution of one more receiver's number."""
    kinds = [numbers[are_taught == kind] for kind in are_taught.unique()]
    squares = torch.stack([(own - own.mean()).square().sum() for own in kinds])
    # The room fits receivers from which it has learnt: that others err less is chance.
    others = numbers[~are_taught]
    shown = others if len(others) and others.mean() > numbers.mean() else numbers
    return shown.mean(), (squares.sum() / freedom * (1 + 1 / len(shown))).sqrt()


def quantile(numbers: Float[Tensor, " n"], levels: Float[Tensor, "*q"]) -> Float[Tensor, "*q"]:
    """The smallest of n sorted numbers at or below which a share ``levels`` of them lies."""
    ranks = (levels * len(numbers) - 1e-9).ceil().long()
    return numbers[(ranks - 1).clamp(0, len(numbers) - 1)]


def fit_law(
    errors: Sequence[Float[Tensor, " _"]], places: Sequence[Float[Tensor, "_ 3"]], most: int = 100
) -> Float[Tensor, "4"]:
    """The most likely law of ``gaigs.model.adapted`` for receivers, each predicted as a new one.

    Links farther apart than the field's length tell little of the noise. So its logarithm has a
    prior: a normal distribution with a deviation of 1 about 0.3 mean squares.

    Args:
        errors: Errors of each receiver's links, (k,) of k links.
        places: Their transmitters (k, 3) [m].
        most: Largest number of links of a receiver.
    """
    rows = [evenly(torch.arange(len(part)), most) for part in errors]
    parts = [part[row].double() for part, row in zip(errors, rows, strict=True)]
    spots = [part[row].double() for part, row in zip(places, rows, strict=True)]
    mean = torch.cat(parts).square().mean().clamp_min(1e-9)
    # Receivers with fewer links are filled up with errors of 0 that correlate with nothing.
    exists = pad_sequence([torch.ones(len(part)) for part in parts], batch_first=True)  # (r, k)
    padded = pad_sequence(parts, batch_first=True)[..., None]  # (r, k, 1)
    there = pad_sequence(spots, batch_first=True)  # (r, k, 3)
    apart = torch.cdist(there, there)  # (r, k, k)
    pairs = exists[:, :, None] * exists[:, None]
    size = (pairs * apart).amax((1, 2)).median().clamp_min(1e-6)
    units = torch.stack((mean, mean, mean, size))

    def cost(logarithms: np.ndarray) -> float:
        """Mean negative log likelihood with the prior, but for a constant."""
        prior = (logarithms[1] - start[1]) ** 2 / 2
        level, noise, field, length = torch.from_numpy(logarithms).exp() * units
        covariances = pairs * (level + field * (-apart / length).exp())
        variances = torch.where(exists > 0, noise, 1.0)
        factor = torch.linalg.cholesky(covariances + variances.diag_embed())  # (r, k, k)
        white = torch.linalg.solve_triangular(factor, padded, upper=False)  # (r, k, 1)
        spread = factor.diagonal(dim1=1, dim2=2).log().sum()  # of the filled ones 0
        return ((white.square().sum() / 2 + spread + prior) / exists.sum()).item()

    # Variances from 1e-4 to 20 mean squares, lengths from 0.1 % to 3 sizes of the site.
    bounds = [(-9.0, 3.0)] * 3 + [(-7.0, 1.0)]
    start = np.log([0.25, 0.3, 0.3, 0.05])
    found = minimize(cost, start, method="L-BFGS-B", bounds=bounds)
    return torch.from_numpy(np.exp(found.x)) * units
