"""The likelihood of fingerprints at places, and its choice by held-out fingerprints."""

import itertools
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gaigs.commands.locate.fingerprints import Fingerprints, LocatedFold
from gaigs.core.query import ROUNDING, evenly


def independent(errors: Float[Tensor, "n m"], most: int = 4000) -> Float[Tensor, "m k"]:
    """Axes (in columns) along which the errors of a label's m values are independent.

    Squared errors of a label along these axes sum to 1 on average. At most ``most`` labels are
    used, at even steps.

    Source: Ledoit and Wolf, A well-conditioned estimator for large-dimensional covariance matrices,
    2004.
    """
    errors = errors[evenly(torch.arange(len(errors)), most)].double()
    if not errors.any():
        return torch.eye(errors.shape[1])
    sizes, vectors = torch.linalg.eigh(errors.mT @ errors / len(errors))
    # Shrink the covariance towards a multiple of the identity, by its own scatter (section 3).
    scatter = (errors.square().sum(1).square().mean() - sizes.square().sum()) / len(errors)
    spread = (sizes - sizes.mean()).square().sum()
    share = (scatter / spread).nan_to_num(1.0).clamp(0, 1)  # 0 / 0 if all are equal
    sizes = (1 - share) * sizes.clamp_min(0) + share * sizes.mean()
    # Numbers that never err get no infinite weight.
    axes = vectors / sizes.clamp_min(1e-6 * sizes.max()).sqrt()
    return (axes / (errors @ axes).square().sum(1).mean().sqrt()).float()


class Mismatch(NamedTuple):
    """Errors of n received fingerprints against the predictions at g candidates."""

    squares: Float[Tensor, "n g"]  # sum of squared errors over squared deviations
    log_deviations: Float[Tensor, "n g"]  # sum of the logarithms of the deviations
    counts: Float[Tensor, " n"]  # number of receivers that give evidence of the place
    # Logarithm of the probability that these receivers receive the value and no other does; 0 for
    # unknown power.
    reception: Float[Tensor, "n g"]


def mismatch(
    prints: Fingerprints, received: Float[Tensor, "n r k"], unknown_power: bool = False
) -> Mismatch:
    """Errors of received fingerprints against predicted ones, and the probability of reception.

    Args:
        prints: Predictions of k numbers for r receivers at g candidates.
        received: Fingerprints of n transmissions along ``prints.axes``; NaN where a receiver has
            received nothing.
        unknown_power: True if the power of each transmission is unknown. The error is then the
            minimum over a common offset of the levels, or a common factor of predicted spectra or
            channels. Reception is then not used.
    """
    is_received = ~received[..., 0].isnan()  # (n, r)
    if prints.task.shape:
        squares = _array_squares(prints, received, is_received, unknown_power)
        log_deviations = torch.zeros_like(squares)
    else:
        squares, log_deviations = _level_squares(prints, received, is_received, unknown_power)
    counts = is_received.float().sum(1)
    reception = torch.zeros_like(squares)
    if not unknown_power:
        likely = is_received.float() @ prints.reception_probabilities.log().mT
        unlikely = (~is_received).float() @ (-prints.reception_probabilities).log1p().mT
        # In a track, a transmission that no receiver has received may not have been sent.
        reception = (likely + unlikely) * (counts > 0)[:, None]
    elif not prints.task.shape:
        counts = counts - 1  # the fitted offset takes one degree of freedom
    return Mismatch(squares.clamp_min(0), log_deviations, counts, reception)


def _level_squares(
    prints: Fingerprints,
    received: Float[Tensor, "n r 1"],
    is_received: Bool[Tensor, "n r"],
    unknown_power: bool,
) -> tuple[Float[Tensor, "n g"], Float[Tensor, "n g"]]:
    """``Mismatch.squares`` and ``Mismatch.log_deviations`` for scalar labels."""
    total = torch.zeros(len(received), len(prints.values))
    log_deviations = torch.zeros_like(total)
    errors_sum = torch.zeros_like(total)
    weights_sum = torch.zeros_like(total)
    for receiver in range(received.shape[1]):
        rows = is_received[:, receiver]
        values = prints.values[:, receiver]
        smallest = ROUNDING * values.abs().max()  # for labels without any error
        deviations = prints.deviations[:, receiver].clamp_min(smallest)
        errors = (received[rows, receiver] - values[:, 0]) / deviations  # (k, g)
        total[rows] += errors.square()
        errors_sum[rows] += errors / deviations
        weights_sum[rows] += deviations.square().reciprocal()
        log_deviations[rows] += deviations.log()
    if unknown_power:
        # min over c of sum ((e - c) / s)² = sum (e / s)² - (sum e / s²)² / sum 1 / s²
        tiny = torch.finfo(torch.float32).tiny
        total = total - errors_sum.square() / weights_sum.clamp_min(tiny)
    return total, log_deviations


def _array_squares(
    prints: Fingerprints,
    received: Float[Tensor, "n r k"],
    is_received: Bool[Tensor, "n r"],
    unknown_power: bool,
) -> Float[Tensor, "n g"]:
    """``Mismatch.squares`` for labels of several values."""
    products = torch.zeros(len(received), len(prints.values))
    predicted_powers = torch.zeros_like(products)
    powers = torch.zeros(len(received), 1)
    for receiver in range(received.shape[1]):
        rows = is_received[:, receiver]
        values = prints.values[:, receiver]
        products[rows] += received[rows, receiver] @ values.mT
        predicted_powers[rows] += values.square().sum(1)
        powers[rows] += received[rows, receiver].square().sum(1, keepdim=True)
    if not unknown_power:
        # (x - y)² = x² - 2 x y + y²
        return predicted_powers - 2 * products + powers
    # The part of the value that no factor of the prediction gives: 1 - (x y)² / (x² y²).
    tiny = torch.finfo(torch.float32).tiny
    cosines = products.clamp_min(0).square() / (predicted_powers * powers).clamp_min(tiny)
    return predicted_powers.mean(1, keepdim=True) * (1 - cosines)


def log_likelihood(difference: Mismatch, freedom: float, temper: float) -> Float[Tensor, "n g"]:
    """Log likelihood of g candidates for n received fingerprints.

    It is the log density of Student's t over all receivers, plus the log probability of reception.

    Args:
        difference: Errors of the received fingerprints.
        freedom: Degrees of freedom. With fewer of them a large error counts less.
        temper: Exponent of Student's t. It is below 1 if the errors of receivers are correlated,
            since they are then less evidence than independent errors.
    """
    exponent = (freedom + difference.counts[:, None]) / 2
    together = exponent * torch.log1p(difference.squares / freedom) + difference.log_deviations
    return (difference.reception - temper * together).double()


class UnseenPrints(NamedTuple):
    """Held-out fingerprints, compared with the map of a model trained without them."""

    prints: Fingerprints  # the map
    differences: Sequence[Mismatch]  # with known and with unknown power
    truth: Float[Tensor, "n 3"]  # places of the fingerprints [m]

    def score(self, freedom: float, temper: float, draws: int = 128) -> float:
        """Sum over fingerprints of the energy score of their posterior [m]; lower is better.

        Args:
            freedom, temper: As for ``log_likelihood``.
            draws: Number of samples of each posterior.

        Source: Gneiting and Raftery, Strictly proper scoring rules, prediction, and estimation,
        2007, section 4.3.
        """
        places, prior, _ = self.prints.candidates
        logarithms = log_likelihood(self.differences[0], freedom, temper) + prior
        probabilities = torch.softmax(logarithms, 1)
        rng = torch.Generator().manual_seed(0)
        drawn = places[torch.multinomial(probabilities, draws, True, generator=rng)]  # (n, d, 3)
        # E |X - x| - E |X - X'| / 2
        apart = (drawn[:, ::2] - drawn[:, 1::2]).norm(dim=2).mean(1)
        errors = (drawn - self.truth[:, None]).norm(dim=2).mean(1)
        return (errors - apart / 2).sum().item()


def choose_likelihood(
    prints: Fingerprints,
    trials: Sequence[UnseenPrints],
    freedoms: Sequence[float] = (0.25, 1.0, 4.0, 30.0),
    half_octaves: Iterable[int] = range(-8, 17),
    fewest: int = 20,
) -> Fingerprints:
    """The map with the likelihood that gives held-out fingerprints the lowest energy score.

    Two numbers are chosen: the degrees of freedom of Student's t, and the exponent (``temper``) of
    its likelihood. The fingerprints in ``held`` calibrate regions, so they must not influence their
    own likelihood. The likelihood of each fold is therefore chosen by the other folds.

    Args:
        prints: The map of the model that knows all training links.
        trials: Held-out fingerprints of each fold.
        freedoms: Degrees of freedom to choose from, the heaviest tails first.
        half_octaves: Integers i; the exponents to choose from are 2^(i / 2).
        fewest: Smallest number of fingerprints that choose the degrees of freedom: fewer rarely
            contain an outlier. With fewer, scalar labels keep the likelihood of ``prints``, and
            other labels take the heaviest tails.
    """
    tempers = [2.0 ** (power / 2) for power in half_octaves]
    if sum(len(trial.truth) for trial in trials) >= fewest:
        choices = [*itertools.product(freedoms, tempers)]
    elif prints.task.shape:
        choices = [*itertools.product(freedoms[:1], tempers)]
    else:
        choices = [(prints.degrees, prints.temper)]
    rows = []
    for trial in trials:
        rows.append([trial.score(*choice) for choice in choices])
    scores = torch.tensor(rows)  # (folds, choices)
    total = scores.sum(0)
    held = []
    for trial, score in zip(trials, scores, strict=True):
        # The other folds choose; a single fold has to choose for itself.
        others = total - score if len(trials) > 1 else score
        choice = choices[int(others.argmin())]
        likelihoods = [log_likelihood(part, *choice).float() for part in trial.differences]
        held.append(LocatedFold(trial.prints.candidates, torch.stack(likelihoods), trial.truth))
    best_freedom, best_temper = choices[int(total.argmin())]
    return replace(prints, degrees=best_freedom, temper=best_temper, held=tuple(held))
