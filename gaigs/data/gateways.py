"""Places of gateways that no file gives, estimated from the levels that they read."""

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.core.query import evenly

READINGS, ROUNDS, ACROSS = 100, 3, 18
"""Most readings of a gateway, evenly spread; rounds, each on a finer grid; candidates along x and
along y.
"""

SLOPE, SLOPES, SHADOWING = -30.0, 10.0, 6.0
"""Before any reading: the slope of levels with its standard deviation [dB per decade], and that of
shadowing [dB].
"""

CORRELATIONS = ((2.0, 0.5), (6.0, 0.5), (6.0, 0.9), (20.0, 0.9))
"""Lengths of the shadowing's correlation to average over [m], and its share of the variance; the
rest is noise.
"""

ABOVE, NEAREST, FINEST = 2.0, 0.5, 0.5
"""Greatest height above the highest place [m]; distances below the second count as it [m]; least
noise [dB].
"""


def estimate_place(
    places: Float[Tensor, "n 3"], levels: Float[Tensor, " n"]
) -> tuple[Float[Tensor, "3"], float]:
    """Place of a gateway [m] from levels [dBm] that it reads, and the root mean square error to
    expect of it [m].

    Levels follow a + b log10(distance) with shadowing, whose correlation makes many readings at one
    spot count as few. Places within half the extent of the readings around them are equally likely
    before any reading, and the result is the mean after all. Readings over three deviations from
    the law at the best place are pulled in to it. Places that do not hear the gateway do not enter.

    Source: Gudmundson, Correlation model for shadow fading in mobile radio systems, 1991; the
    marginal likelihood is that of Rasmussen and Williams, Gaussian Processes for Machine Learning,
    2006, section 2.7.
    """
    some = evenly(torch.arange(len(places)), READINGS)
    places, levels = places[some].double(), levels[some].double()
    low, high = places.amin(0), places.amax(0)
    margin = max(5.0, (high - low).max().item() / 2)
    low, high = (
        low - low.new_tensor([margin, margin, 0]),
        high + low.new_tensor([margin, margin, ABOVE]),
    )
    apart = torch.cdist(places, places)
    shadowing = torch.stack([share * (-apart / length).exp() for length, share in CORRELATIONS])
    shadowing.diagonal(dim1=1, dim2=2).fill_(1)
    factors = torch.linalg.cholesky(shadowing)
    lower, upper = low, high
    for _ in range(ROUNDS):
        counts = (ACROSS, ACROSS, 3)
        candidates = torch.cartesian_prod(
            *map(torch.linspace, lower.tolist(), upper.tolist(), counts)
        ).double()
        decades = torch.cdist(places, candidates).clamp_min(NEAREST).log10()
        evidence, slopes, constants = _evidence(factors, decades, levels)
        probabilities = evidence.flatten().softmax(0).reshape(evidence.shape)
        _, best = divmod(int(probabilities.argmax()), len(candidates))
        shares = probabilities.sum(0)
        place = shares @ candidates
        deviations = (shares @ (candidates - place).square()).sqrt()
        which = int(probabilities[:, best].argmax())
        law = constants[which, best] + slopes[which, best] * decades[:, best]
        errors = levels - law
        bound = 3 * max(1.0, 1.4826 * errors.abs().median().item())
        levels = law + errors.clamp(-bound, bound)
        half = torch.maximum(3 * deviations, (upper - lower) / (ACROSS - 1))
        lower, upper = torch.maximum(low, place - half), torch.minimum(high, place + half)
    return place.float(), deviations.norm().item()


def _evidence(
    factors: Float[Tensor, "c n n"], decades: Float[Tensor, "n g"], levels: Float[Tensor, " n"]
) -> tuple[Float[Tensor, "c g"], Float[Tensor, "c g"], Float[Tensor, "c g"]]:
    """Log likelihood of each candidate by each correlation, over all laws and variances; slopes and
    constants of laws.

    The prior of the slope is one more observation.
    """
    columns = torch.cat((torch.ones_like(levels)[:, None], levels[:, None], decades), 1)
    white = torch.linalg.solve_triangular(
        factors, columns.expand(len(factors), -1, -1), upper=False
    )
    one, own, logs = white[:, :, :1], white[:, :, 1:2], white[:, :, 2:]
    weight = (SHADOWING / SLOPES) ** 2
    ones, mixed, means = one.square().sum(1), (one * logs).sum(1), (one * own).sum(1)
    squares = logs.square().sum(1) + weight - mixed.square() / ones
    products = (logs * own).sum(1) + weight * SLOPE - mixed * means / ones
    left = (
        own.square().sum(1)
        + weight * SLOPE**2
        - means.square() / ones
        - products.square() / squares
    )
    slopes = products / squares
    size = (
        factors.diagonal(dim1=1, dim2=2).log().sum(1, keepdim=True)
        + (ones.log() + squares.log()) / 2
    )
    least = FINEST**2 * len(levels)
    return (
        -size - len(levels) / 2 * left.clamp_min(least).log(),
        slopes,
        (means - slopes * mixed) / ones,
    )
