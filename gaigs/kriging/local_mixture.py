"""Processes whose length and noise differ from place to place: averages over candidates."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.kriging.kernel import matern
from gaigs.kriging.likelihood import Choice, separations
from gaigs.kriging.neighbours import Nearest, Readings


@dataclass(frozen=True)
class MixtureOptions:
    """Candidates of ``LocalMixture``, and their prior.

    Attributes:
        neighbours: Readings around a place that weight its candidates. Fewer say little on a
            length, more are no longer near.
        lengths: Logarithms of the candidates' lengths over the mean length of the receivers.
        ratios: Logarithms of their ratios of noise to signal over the receiver's ratio, with a
            prior deviation of 1.
        scatter: Prior deviation of the logarithm of the length about the receiver's length.
        degrees: Readings that the receiver's own variance counts as, beside those around.
        errors: Least gain of the held-out log likelihood over one process everywhere
            [standard errors].
        size: Places whose matrices are held in memory at a time.
    """

    neighbours: int = 48
    lengths: tuple[float, ...] = (-2.4, -1.2, 0.0, 1.2, 2.4)
    ratios: tuple[float, ...] = (-1.5, 0.0, 1.5)
    scatter: float = 1.5
    degrees: float = 2.0
    errors: float = 1.0
    size: int = 2048


class LocalMixture(NamedTuple):
    """Readings at m places as a mixture of g Student's t, one for each length and noise.

    Beside a mast, in a street and in a field shadows differ in length and size, and readings in
    their noise. So z and noise around a place have a length, a ratio of noise to signal and a
    variance of their own. The variance has an inverse gamma prior and is integrated out; length
    and ratio are averaged over candidates, weighted by the likelihood of the readings around.

    Source: Hoeting et al., Bayesian model averaging: a tutorial, 1999; Shah, Wilson and
    Ghahramani, Student-t processes as alternatives to Gaussian processes, 2014.
    """

    logarithms: Float[Tensor, "m g"]  # of the weights, whose sum is 1
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
        # More than two degrees of freedom have a variance.
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
    """What mixtures at places are made from."""

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
        """Mixtures at places, without the readings of their ``own`` fold."""
        readings = self.readings._replace(count=self.options.neighbours)
        nearest = readings.nearest(places, receivers, own, folds)
        keys = torch.cat([*self._keys(places, nearest)])  # (m,)
        order = keys.argsort()
        parts = []
        for part in order.split(self.options.size):
            near = Nearest(nearest.rows[part], nearest.exists[part])
            parts.append(self._mixture(places[part], receivers[part], near, keys[part]))
        back = order.argsort()
        return LocalMixture(*(torch.cat(field)[back] for field in zip(*parts, strict=True)))

    def _keys(self, places: Tensor, nearest: Nearest) -> Iterator[Float[Tensor, " j"]]:
        """A number of each place with the places around, the same for receivers that hear the same
        places: random weights make different places differ.
        """
        generator = torch.Generator().manual_seed(0)
        shape = nearest.rows.shape[1] + 1, places.shape[1]
        weights = torch.rand(shape, generator=generator, dtype=torch.float64)
        for part in torch.arange(len(places)).split(self.options.size):
            around = self.readings.places[nearest.rows[part]] * nearest.exists[part, :, None]
            points = torch.cat((around, places[part, None]), 1)  # (j, i, d)
            yield (points * weights).sum((1, 2)) + nearest.exists[part].sum(1) / math.pi

    def _mixture(
        self,
        places: Float[Tensor, "m d"],
        receivers: Int[Tensor, " m"],
        nearest: Nearest,
        keys: Float[Tensor, " m"],
    ) -> LocalMixture:
        options = self.options
        # Receivers that hear the same places share matrices, as candidates' lengths are the same.
        _, which = keys.unique_consecutive(return_inverse=True)
        first = torch.searchsorted(which, which.unique())
        near = Nearest(nearest.rows[first], nearest.exists[first])
        around = self.readings.around(places[first], receivers[first], near)
        apart = separations(around, self.choice)  # (u, i, i)
        values = self.values[nearest.rows].where(nearest.exists, 0)  # (m, j)
        counts = nearest.exists.sum(1)
        lengths, signals, noises = self.logarithms[receivers].unbind(1)
        total = (2 * signals).exp() + (2 * noises).exp()
        middle = self.logarithms[:, 0].mean()
        logarithms, means, squares = [], [], []
        for step in options.lengths:
            correlations = matern(apart, (middle + step).exp(), self.choice.smoothness)
            # With eigenvalues e and vectors U of the correlations, U diag(e + ratio) U' are the
            # covariances of all ratios.
            sizes, vectors = torch.linalg.eigh(correlations[:, :-1, :-1])
            towards = (vectors.mT @ correlations[:, :-1, -1:])[which, :, 0]  # (m, j)
            rotated = (vectors.mT[which] @ values[..., None])[..., 0]  # (m, j)
            prior = ((middle + step - lengths) / options.scatter).square() / 2
            for change in options.ratios:
                ratios = (2 * (noises - signals) + change).exp()
                covariances = sizes.clamp_min(0)[which] + ratios[:, None]
                # The receiver's variance of readings divides into signal and noise.
                own = options.degrees * total / (1 + ratios)
                energy = own + (rotated.square() / covariances).sum(1)
                # Readings that do not exist are 0 and correlate with none.
                lacking = (values.shape[1] - counts) * ratios.log1p()
                determinant = covariances.log().sum(1) - lacking
                likelihood = options.degrees * own.log() - determinant
                likelihood = likelihood - (options.degrees + counts) * energy.log()
                logarithms.append(likelihood / 2 - prior - change**2 / 2)
                means.append((towards * rotated / covariances).sum(1))
                left = 1 + ratios - (towards.square() / covariances).sum(1)
                squares.append(left * energy / (options.degrees + counts))
        weights = torch.stack(logarithms, 1).log_softmax(1)
        degrees = (options.degrees + counts)[:, None]
        return LocalMixture(weights, torch.stack(means, 1), torch.stack(squares, 1), degrees)
