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
    """Axes (columns of the result) along which the errors of a label's m values are independent.

    Squared errors of a label along these axes sum to 1 on average. At most ``most`` labels are
    used, at even steps. If all errors are 0, the axes are unit vectors.

    Source: Ledoit and Wolf, A well-conditioned estimator for large-dimensional covariance matrices,
    2004.
    """
    errors = errors[evenly(torch.arange(len(errors)), most)].double()
    if not errors.any():
        return torch.eye(errors.shape[1])
    covariance = errors.mT @ errors / len(errors)  # (m, m)
    variances, vectors = torch.linalg.eigh(covariance)
    # The covariance S shrinks to (1 - b²/d²) S + b²/d² v I with its mean variance v (section 3).
    # Only its eigenvalues change. b² = (mean |error|⁴ - |S|²) / n is the variance of S as an
    # estimate, d² = |S - v I|² its distance from v I.
    mean = variances.mean()
    fourth_powers = errors.square().sum(1).square()  # (n,)
    estimate_variance = (fourth_powers.mean() - variances.square().sum()) / len(errors)
    squared_distance = (variances - mean).square().sum()
    ratio = estimate_variance / squared_distance
    shrinkage = ratio.nan_to_num(1.0).clamp(0, 1)  # 0 / 0 if all variances are equal
    variances = (1 - shrinkage) * variances.clamp_min(0) + shrinkage * mean
    # The lower bound keeps the weight of values finite that are always predicted exactly.
    axes = vectors / variances.clamp_min(1e-6 * variances.max()).sqrt()
    mean_square = (errors @ axes).square().sum(1).mean()
    return (axes / mean_square.sqrt()).float()


class Mismatch(NamedTuple):
    """Errors of n received fingerprints against the predictions at g candidates."""

    squares: Float[Tensor, "n g"]  # sum of squared errors over squared deviations
    log_deviations: Float[Tensor, "n g"]  # sum of the logarithms of the deviations
    # Number of receivers with a value; with unknown power of scalar labels one less.
    counts: Float[Tensor, " n"]
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
        probabilities = prints.reception_probabilities  # (g, r)
        log_received = is_received.float() @ probabilities.log().mT  # (n, g)
        log_missed = (~is_received).float() @ (-probabilities).log1p().mT  # sums of log(1 - p)
        # In a track, a transmission that no receiver has received may not have been sent.
        reception = (log_received + log_missed) * (counts > 0)[:, None]
    elif not prints.task.shape:
        counts = counts - 1  # the fitted offset takes one degree of freedom
    return Mismatch(squares.clamp_min(0), log_deviations, counts, reception)


def _level_squares(
    prints: Fingerprints,
    received: Float[Tensor, "n r 1"],
    is_received: Bool[Tensor, "n r"],
    unknown_power: bool,
) -> tuple[Float[Tensor, "n g"], Float[Tensor, "n g"]]:
    """``Mismatch.squares`` and ``Mismatch.log_deviations`` for scalar labels.

    Sums over the receivers of each transmission, with error e and standard deviation s of each. An
    unknown power is an offset c of all errors: min over c of sum ((e - c) / s)² is
    sum (e / s)² - (sum e / s²)² / sum 1 / s².
    """
    squares = torch.zeros(len(received), len(prints.values))  # sums of (e / s)²
    log_deviations = torch.zeros_like(squares)  # sums of log s
    weighted_errors = torch.zeros_like(squares)  # sums of e / s²
    weights = torch.zeros_like(squares)  # sums of 1 / s²
    for receiver in range(received.shape[1]):
        rows = is_received[:, receiver]
        values = prints.values[:, receiver]  # (g, 1)
        smallest = ROUNDING * values.abs().max()  # for labels without any error
        deviations = prints.deviations[:, receiver].clamp_min(smallest)  # (g,)
        scaled_errors = (received[rows, receiver] - values[:, 0]) / deviations  # (k, g)
        squares[rows] += scaled_errors.square()
        weighted_errors[rows] += scaled_errors / deviations
        weights[rows] += deviations.square().reciprocal()
        log_deviations[rows] += deviations.log()
    if unknown_power:
        tiny = torch.finfo(torch.float32).tiny  # for transmissions without a receiver
        squares = squares - weighted_errors.square() / weights.clamp_min(tiny)
    return squares, log_deviations


def _array_squares(
    prints: Fingerprints,
    received: Float[Tensor, "n r k"],
    is_received: Bool[Tensor, "n r"],
    unknown_power: bool,
) -> Float[Tensor, "n g"]:
    """``Mismatch.squares`` for labels of several values.

    The received values x and the predicted values y of all receivers are two vectors. Their squared
    distance is x² - 2 x y + y². If the power is unknown, the best factor of y comes first.
    """
    products = torch.zeros(len(received), len(prints.values))  # x y
    predicted_powers = torch.zeros_like(products)  # y², of the receivers with a value
    powers = torch.zeros(len(received), 1)  # x²
    for receiver in range(received.shape[1]):
        rows = is_received[:, receiver]
        values = prints.values[:, receiver]  # (g, k)
        products[rows] += received[rows, receiver] @ values.mT
        predicted_powers[rows] += values.square().sum(1)
        powers[rows] += received[rows, receiver].square().sum(1, keepdim=True)
    if not unknown_power:
        return predicted_powers - 2 * products + powers
    # min over factors f >= 0 of (x - f y)² / x² is 1 - cos², with cos² = (x y)² / (x² y²). The mean
    # predicted power of the candidates gives it the scale of squared errors.
    tiny = torch.finfo(torch.float32).tiny
    squared_cosines = products.clamp_min(0).square() / (predicted_powers * powers).clamp_min(tiny)
    return predicted_powers.mean(1, keepdim=True) * (1 - squared_cosines)


def log_likelihood(difference: Mismatch, freedom: float, temper: float) -> Float[Tensor, "n g"]:
    """Log likelihood of g candidates for n received fingerprints.

    The log density of Student's t over all r receivers, plus the log probability of reception:
    log P - temper ((freedom + r) / 2 log(1 + squares / freedom) + log deviations).

    Args:
        difference: Errors of the received fingerprints.
        freedom: Degrees of freedom. With fewer of them a large error counts less.
        temper: Exponent of Student's t. It is below 1 if the errors of receivers are correlated,
            since they are then less evidence than independent errors.
    """
    exponent = (freedom + difference.counts[:, None]) / 2
    logarithms = exponent * torch.log1p(difference.squares / freedom)  # (n, g)
    negative_log_density = logarithms + difference.log_deviations  # of Student's t
    return (difference.reception - temper * negative_log_density).double()


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
        numbers = torch.multinomial(probabilities, draws, True, generator=rng)  # (n, draws)
        samples = places[numbers]  # (n, draws, 3)
        # E |X - x| - E |X - X'| / 2, with samples X and X' and the true place x. Consecutive
        # samples are the pairs X, X'.
        spreads = (samples[:, ::2] - samples[:, 1::2]).norm(dim=2).mean(1)  # (n,)
        errors = (samples - self.truth[:, None]).norm(dim=2).mean(1)  # (n,)
        return (errors - spreads / 2).sum().item()


def choose_likelihood(
    prints: Fingerprints,
    trials: Sequence[UnseenPrints],
    freedoms: Sequence[float] = (0.25, 1.0, 4.0, 30.0),
    half_octaves: Iterable[int] = range(-8, 17),
    fewest: int = 20,
) -> Fingerprints:
    """The map with the likelihood that gives held-out fingerprints the lowest energy score.

    Two numbers are chosen: the degrees of freedom of Student's t, and the exponent (``temper``) of
    its likelihood. The held-out fingerprints also calibrate regions (``Fingerprints.held``). For
    that, the other folds choose the likelihood of each fold, since a fingerprint must not influence
    its own likelihood.

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
    for trial, fold_scores in zip(trials, scores, strict=True):
        # The other folds choose; a single fold has to choose for itself.
        scores_of_others = total - fold_scores if len(trials) > 1 else fold_scores
        freedom, temper = choices[int(scores_of_others.argmin())]
        likelihoods = []  # with known and with unknown power
        for difference in trial.differences:
            likelihoods.append(log_likelihood(difference, freedom, temper).float())
        held.append(LocatedFold(trial.prints.candidates, torch.stack(likelihoods), trial.truth))
    best_freedom, best_temper = choices[int(total.argmin())]
    return replace(prints, degrees=best_freedom, temper=best_temper, held=tuple(held))
