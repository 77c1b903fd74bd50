"""Estimation of unknown gateway places from the levels that the gateways receive."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.core.query import evenly


@dataclass(frozen=True)
class Prior:
    """Prior of a gateway's place, and options of the search."""

    readings: int = 100  # most readings that count, evenly spread
    rounds: int = 3  # number of grids, each finer than the last
    across: int = 18  # candidates along x and along y
    slope: float = -30.0  # mean slope of levels [dB per decade]
    slope_deviation: float = 10.0  # its standard deviation [dB per decade]
    shadowing: float = 6.0  # standard deviation of shadowing [dB]
    # Correlation lengths [m] to average over, each with the share of the variance that is
    # correlated; the rest is noise. They grow with a site that is larger than ``site``: houses in
    # place of furniture.
    correlations: tuple[tuple[float, float], ...] = (
        (2.0, 0.5),
        (6.0, 0.5),
        (6.0, 0.9),
        (20.0, 0.9),
    )
    site: float = 100.0  # extent of the readings [m]
    above: float = 2.0  # greatest height above the highest place [m]
    nearest: float = 0.5  # least distance; shorter ones count as this [m]
    noise: float = 0.5  # least standard deviation of the noise [dB]


class Laws(NamedTuple):
    """Path-loss laws, level = constant + slope log10(distance).

    There is one for each of c correlations of shadowing and g candidate places of the gateway.
    """

    evidence: Float[Tensor, "c g"]  # log likelihood, up to a constant
    slopes: Float[Tensor, "c g"]  # [dB per decade]
    constants: Float[Tensor, "c g"]  # [dBm]


def estimate_place(
    places: Float[Tensor, "n 3"], levels: Float[Tensor, " n"], prior: Prior | None = None
) -> tuple[Float[Tensor, "3"], float]:
    """Place of a gateway [m] from the levels [dBm] that it receives, and the expected error [m].

    Levels follow constant + slope log10(distance) with correlated shadowing, so many readings at
    one spot count as few. The prior is uniform in the box of the readings, widened by half its
    extent. The result is the mean of the posterior. Readings beyond three deviations from the law
    at the best place are clipped to three deviations.

    Args:
        places: Transmitters whose signal was received [m].
        levels: Level of each transmitter at the gateway [dBm].

    Source: Gudmundson, Correlation model for shadow fading in mobile radio systems, 1991; marginal
    likelihood by Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section
    2.7.
    """
    prior = prior or Prior()
    index = evenly(torch.arange(len(places)), prior.readings)
    places = places[index].double()
    levels = levels[index].double()
    low, high = places.amin(0), places.amax(0)
    extent = (high - low).max().item()
    margin = max(5.0, extent / 2)  # [m]
    low = low - low.new_tensor([margin, margin, 0])
    high = high + low.new_tensor([margin, margin, prior.above])
    # On a large site correlation lengths grow with the extent, so distances shrink.
    distances = torch.cdist(places, places) / max(1.0, extent / prior.site)  # (n, n)
    # Gudmundson: a share of shadowing is correlated by exp(-distance / length), the rest is noise.
    correlated = [share * (-distances / length).exp() for length, share in prior.correlations]
    shadowing = torch.stack(correlated)  # (c, n, n)
    shadowing.diagonal(dim1=1, dim2=2).fill_(1)  # the variance of shadowing and noise together
    factors = torch.linalg.cholesky(shadowing)
    lower, upper = low, high
    for _ in range(prior.rounds):
        counts = (prior.across, prior.across, 3)
        axes = map(torch.linspace, lower.tolist(), upper.tolist(), counts)
        candidates = torch.cartesian_prod(*axes).double()  # (g, 3)
        decades = torch.cdist(places, candidates).clamp_min(prior.nearest).log10()  # (n, g)
        laws = _fit_laws(factors, decades, levels, prior)
        probabilities = laws.evidence.flatten().softmax(0).reshape(laws.evidence.shape)  # (c, g)
        best = int(probabilities.argmax()) % len(candidates)
        # Posterior of the place, over all correlations.
        shares = probabilities.sum(0)  # (g,)
        place = shares @ candidates
        deviations = (shares @ (candidates - place).square()).sqrt()
        # Readings far from the best law are pulled in to three deviations.
        c = int(probabilities[:, best].argmax())  # most probable correlation
        law = laws.constants[c, best] + laws.slopes[c, best] * decades[:, best]
        errors = levels - law
        bound = 3 * max(1.0, 1.4826 * errors.abs().median().item())
        levels = law + errors.clamp(-bound, bound)
        # The next grid is finer, around the mean; half its width is at least one step of this one.
        half = torch.maximum(3 * deviations, (upper - lower) / (prior.across - 1))
        lower = torch.maximum(low, place - half)
        upper = torch.minimum(high, place + half)
    return place.float(), deviations.norm().item()


def _fit_laws(
    factors: Float[Tensor, "c n n"],
    decades: Float[Tensor, "n g"],
    levels: Float[Tensor, " n"],
    prior: Prior,
) -> Laws:
    """Laws of each candidate for each correlation, with their log likelihood.

    The likelihood is integrated over all laws and variances. The prior of the slope enters as one
    more observation. With whitened columns 1 (of the constant), x (logarithms) and y (levels),
    least squares give slope = S_xy / S_xx, where S_xy = x'y - (1'x) (1'y) / (1'1).

    Args:
        factors: Cholesky factors of c correlations of the shadowing at n places.
        decades: Decimal logarithms of the distances between these places and g candidates.
        levels: Readings at the places [dBm].
    """
    columns = torch.cat((torch.ones_like(levels)[:, None], levels[:, None], decades), 1)
    columns = columns.expand(len(factors), -1, -1)  # (c, n, 2 + g)
    # Whitened by the Cholesky factors, generalised least squares become ordinary ones.
    white = torch.linalg.solve_triangular(factors, columns, upper=False)
    one, y, x = white.tensor_split([1, 2], dim=2)  # (c, n, 1), (c, n, 1), (c, n, g)
    # The prior of the slope is an observation of this weight; the constant has no prior.
    weight = (prior.shadowing / prior.slope_deviation) ** 2
    one_one = one.square().sum(1)  # (c, 1)
    one_x = (one * x).sum(1)  # (c, g)
    one_y = (one * y).sum(1)  # (c, 1)
    s_xx = x.square().sum(1) + weight - one_x.square() / one_one  # (c, g)
    s_xy = (x * y).sum(1) + weight * prior.slope - one_x * one_y / one_one  # (c, g)
    unexplained = (
        y.square().sum(1)
        + weight * prior.slope**2
        - one_y.square() / one_one
        - s_xy.square() / s_xx
    )
    slopes = s_xy / s_xx
    # Without constant, slope and variance, the density is |K|^-1/2 (1'1 S_xx)^-1/2 R^-n/2, with the
    # correlation K of the shadowing, n readings and the unexplained sum of squares R.
    log_determinants = factors.diagonal(dim1=1, dim2=2).log().sum(1, keepdim=True)  # (c, 1)
    log_norm = log_determinants + (one_one.log() + s_xx.log()) / 2
    least = prior.noise**2 * len(levels)
    evidence = -log_norm - len(levels) / 2 * unexplained.clamp_min(least).log()
    return Laws(evidence, slopes, (one_y - slopes * one_x) / one_one)
