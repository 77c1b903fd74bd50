"""Processes whose length and noise differ from place to place: averages over candidates."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.kriging.kernel import matern
from gaigs.kriging.likelihood import Choice
from gaigs.kriging.links import distances, scaled
from gaigs.kriging.neighbours import Nearest, Readings
from gaigs.processes import in_threads


@dataclass(frozen=True)
class MixtureOptions:
    """Candidates of ``LocalMixture``, and their prior.

    Attributes:
        neighbours: Number of readings around a place that weight its candidates. Fewer hardly
            determine a length, and more are no longer near.
        lengths: Logarithms of the candidates' lengths over the mean length of the receivers.
        ratios: Logarithms of their ratios of noise to signal over the mean ratio of the receivers.
            The prior deviation about the receiver's ratio is 1.
        scatter: Prior deviation of the logarithm of the length about the receiver's length.
        degrees: Weight of the receiver's variance in the prior [readings].
        errors: Least gain of the held-out log likelihood over one process everywhere
            [standard errors].
        size: Number of places whose matrices are held in memory at a time.
    """

    neighbours: int = 48
    lengths: tuple[float, ...] = (-2.4, -1.2, 0.0, 1.2, 2.4)
    ratios: tuple[float, ...] = (-1.5, 0.0, 1.5)
    scatter: float = 1.5
    degrees: float = 2.0
    errors: float = 1.0
    size: int = 256


class LocalMixture(NamedTuple):
    """Distribution of a reading at each of m places: a mixture of g Student's t distributions.

    Shadows beside a mast, in a street and in a field differ in length and depth, and readings
    differ in noise. So the length, the ratio of noise to signal, and the variance change from place
    to place. The variance has an inverse gamma prior and is integrated out. Lengths and ratios are
    g candidates, weighted by the likelihood of the readings around the place.

    Source: Hoeting et al., Bayesian model averaging: a tutorial, 1999; Shah, Wilson and
    Ghahramani, Student-t processes as alternatives to Gaussian processes, 2014.
    """

    logarithms: Float[Tensor, "m g"]  # logarithms of the candidates' weights, whose sum is 1
    means: Float[Tensor, "m g"]
    squares: Float[Tensor, "m g"]  # squared scales
    degrees: Float[Tensor, "m 1"]  # degrees of freedom

    @property
    def mean(self) -> Float[Tensor, " m"]:
        """Means of the readings, and of z."""
        return (self.logarithms.exp() * self.means).sum(1)

    @property
    def variance(self) -> Float[Tensor, " m"]:
        """Variances of the readings."""
        spread = (self.means - self.mean[:, None]).square()
        # A variance exists only with more than two degrees of freedom.
        within = self.squares * self.degrees / (self.degrees - 2).clamp_min(0.5)
        return (self.logarithms.exp() * (within + spread)).sum(1)

    def log_density(self, values: Float[Tensor, " m"]) -> Float[Tensor, " m"]:
        """Logarithms of the densities of readings."""
        steps = (values[:, None] - self.means).square() / (self.squares * self.degrees)
        half = (self.degrees + 1) / 2
        size = torch.lgamma(half) - torch.lgamma(self.degrees / 2)
        size = size - (math.pi * self.degrees * self.squares).log() / 2
        return torch.logsumexp(self.logarithms + size - half * steps.log1p(), 1)


class LocalMixtures(NamedTuple):
    """Known readings and hyperparameters, from which mixtures at places are computed."""

    readings: Readings
    values: Float[Tensor, " k"]  # known readings, residuals of a trend
    logarithms: Float[Tensor, "r 3"]  # of length, signal and noise at each receiver
    choice: Choice
    options: MixtureOptions = MixtureOptions()

    def at(
        self,
        places: Float[Tensor, "m d"],
        receivers: Int[Tensor, " m"],
        own: Int[Tensor, " m"] | None = None,
        folds: Int[Tensor, " k"] | None = None,
    ) -> LocalMixture:
        """Mixtures at places; readings in a place's ``own`` fold are not used for it."""
        readings = self.readings._replace(count=self.options.neighbours)
        nearest, sets = self._in_order(readings.nearest(places, receivers, own, folds))
        order = sets.argsort()

        def mixture(part: Int[Tensor, " n"]) -> LocalMixture:
            near = Nearest(nearest.rows[part], nearest.exists[part])
            return self._mixture(places[part], receivers[part], near, sets[part])

        parts = in_threads(mixture, order.split(self.options.size))
        back = order.argsort()
        return LocalMixture(*(torch.cat(field)[back] for field in zip(*parts, strict=True)))

    def _in_order(self, nearest: Nearest) -> tuple[Nearest, Int[Tensor, " m"]]:
        """Readings around each place in an order of their own, and a hash of their places.

        Sets of readings at the same places have the same order and hash, for any receiver, and so
        can share matrices.
        """
        bits = self.readings.places.contiguous().view(torch.int64)  # (k, d)
        # A hash of each reading's place; past 64 bits it wraps. That of the origin is not 0 either.
        codes = torch.ones_like(bits[:, 0])
        for column in bits.unbind(1):
            codes = (codes ^ column ^ (column >> 29)) * 0x5851F42D4C957F2D
        rows, exists = nearest
        of_rows = codes[rows].masked_fill(~exists, torch.iinfo(torch.int64).max)  # (m, j)
        order = of_rows.argsort(1)
        ordered = Nearest(rows.gather(1, order), exists.gather(1, order))
        return ordered, (codes[rows] * exists).sum(1)

    def _mixture(
        self,
        places: Float[Tensor, "m d"],
        receivers: Int[Tensor, " m"],
        nearest: Nearest,
        sets: Int[Tensor, " m"],
    ) -> LocalMixture:
        """Mixtures at m places from the readings y around each, sorted by their ``sets``.

        A candidate has the matrix K = correlations + ratio I of readings and the correlations c
        with the place. With the Cholesky factor K = L L', the mean is (L^-1 c)' (L^-1 y), and the
        variance is 1 + ratio - |L^-1 c|², times a scale that y and the prior determine.
        """
        options, scale = self.options, self.choice.scale
        points = scaled(self.readings.places, scale)[nearest.rows]  # (m, j, d)
        near = (points - scaled(places, scale)[:, None]).norm(dim=2)  # (m, j)
        # Missing readings correlate with nothing, not even with themselves.
        near = near.where(nearest.exists, 1e15)
        # Places with the same readings around share the factors L; candidates are the same at all
        # receivers.
        _, which = sets.unique_consecutive(return_inverse=True)
        first = torch.searchsorted(which, which.unique())
        pairs = nearest.exists[first, :, None] & nearest.exists[first, None]
        apart = distances(points[first], points[first]).where(pairs, 1e15)  # (u, j, j)
        values = self.values[nearest.rows].where(nearest.exists, 0)  # (m, j)
        counts = nearest.exists.sum(1)
        lengths, signals, noises = self.logarithms[receivers].unbind(1)
        total = (2 * signals).exp() + (2 * noises).exp()
        middle = self.logarithms[:, 0].mean()
        receiver_ratios = 2 * (noises - signals)  # (m,) logarithms
        middle_ratio = 2 * (self.logarithms[:, 2] - self.logarithms[:, 1]).mean()
        logarithms, means, squares = [], [], []
        for step in options.lengths:
            correlations = matern(apart, (middle + step).exp(), self.choice.smoothness)
            at_place = matern(near, (middle + step).exp(), self.choice.smoothness)
            both = torch.stack((at_place, values), 2)  # (m, j, 2)
            prior = ((middle + step - lengths) / options.scatter).square() / 2
            for change in options.ratios:
                logarithm = middle_ratio + change
                ratio = logarithm.exp()
                noise = ratio * torch.eye(values.shape[1]).to(values)
                factor = torch.linalg.cholesky(correlations + noise)  # (u, j, j)
                white = torch.linalg.solve_triangular(factor[which], both, upper=False)
                towards, rotated = white.unbind(2)  # (m, j), L^-1 c and L^-1 y
                # The receiver's variance of readings is the prior mean of signal plus noise.
                prior_energy = options.degrees * total / (1 + ratio)
                energy = prior_energy + rotated.square().sum(1)
                determinant = 2 * factor.diagonal(dim1=1, dim2=2).log().sum(1)[which]
                # Missing readings add the noise alone to the determinant.
                determinant = determinant - (values.shape[1] - counts) * logarithm
                likelihood = options.degrees * prior_energy.log() - determinant
                likelihood = likelihood - (options.degrees + counts) * energy.log()
                ratio_prior = (logarithm - receiver_ratios).square() / 2
                logarithms.append(likelihood / 2 - prior - ratio_prior)
                means.append((towards * rotated).sum(1))
                variance = 1 + ratio - towards.square().sum(1)  # over the signal's
                squares.append(variance * energy / (options.degrees + counts))
        weights = torch.stack(logarithms, 1).log_softmax(1)
        degrees = (options.degrees + counts)[:, None]
        return LocalMixture(weights, torch.stack(means, 1), torch.stack(squares, 1), degrees)
