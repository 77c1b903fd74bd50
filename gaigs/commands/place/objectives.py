"""Objectives of sets of receivers at places, and the greedy choice of a set.

Readings of different receivers are independent normal variables. Each objective is therefore a
function of a product over receivers, whose factors are computed once.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.core.stages import track


class Coverage:
    """Probability that the best receiver's reading is above a threshold [%].

    The probability that all independent readings are below it is the product over receivers.

    Args:
        values: Expected readings of r receivers at g places [dBm].
        deviations: Standard deviations of the readings [dB].
        threshold: The threshold [dBm].
    """

    sign = 1  # higher is better

    def __init__(
        self, values: Float[Tensor, "r g"], deviations: Float[Tensor, "r g"], threshold: float
    ):
        self.values = values
        self.deviations = deviations
        self.thresholds = values.new_tensor([threshold])  # (t,)

    def factors(self, index: Int[Tensor, " k"]) -> Float[Tensor, "k g t"]:
        """Probability that each reading of k receivers is below each threshold.

        The product over a set of receivers is the probability that all are below.
        """
        margins = self.thresholds - self.values[index, :, None]  # (k, g, t)
        return torch.special.ndtr(margins / self.deviations[index, :, None])

    def quality(self, products: Float[Tensor, "*sets g t"]) -> Float[Tensor, "*sets g"]:
        """Quality of each place from the product of the factors of a set [%]."""
        return 100 * (1 - products[..., 0])


class MeanLevel(Coverage):
    """Expected reading of the best receiver [dBm]; arguments are as for ``Coverage``.

    With a level a below all readings it is a + the integral of P(best reading > t) over t >= a,
    computed at ``steps`` levels.
    """

    def __init__(
        self, values: Float[Tensor, "r g"], deviations: Float[Tensor, "r g"], steps: int = 64
    ):
        low = (values - 4 * deviations).min().item()  # 3e-5 of a normal variable is lower
        high = (values + 4 * deviations).max().item()
        super().__init__(values, deviations, low)
        self.thresholds = torch.linspace(low, high, steps, dtype=values.dtype)

    def quality(self, products: Float[Tensor, "*sets g t"]) -> Float[Tensor, "*sets g"]:
        return self.thresholds[0] + torch.trapezoid(1 - products, self.thresholds, dim=-1)


class LocationError:
    """Root mean square error of a location by the readings of all receivers [m].

    Readings at place y give place y' an expected likelihood. It is the product over receivers of
    N(m - m'; 0, s² + s'²), with means m, m' and standard deviations s, s' of a reading at the two
    places (Jebara, Kondor and Howard, Probability product kernels, 2004). With these likelihoods as
    weights of the places y', half the mean square distance from y is the variance of the location.
    If readings are linear in the place, this is the Cramér-Rao bound. Distant places with the same
    readings also count, unlike in the bound.

    Args:
        values, deviations: As for ``Coverage``.
        places: The possible places (g, 3) [m], equally likely.
    """

    sign = -1  # lower is better

    def __init__(
        self,
        values: Float[Tensor, "r g"],
        deviations: Float[Tensor, "r g"],
        places: Float[Tensor, "g 3"],
    ):
        self.values = values
        self.deviations = deviations
        self.squares = torch.cdist(places, places).square().to(values)  # (g, g)

    def factors(self, index: Int[Tensor, " k"]) -> Float[Tensor, "k g g"]:
        """Expected likelihood of each place (last axis) for readings at each place, by receiver."""
        means = self.values[index]  # (k, g)
        variances = self.deviations[index].square()
        sums = variances[:, :, None] + variances[:, None]  # s² + s'², (k, g, g)
        differences = means[:, :, None] - means[:, None]  # m - m'
        # A constant factor of a receiver has no effect; with this one no factor is above 1.
        scale = sums.amin((1, 2), keepdim=True)
        return (scale / sums).sqrt() * torch.exp(-differences.square() / (2 * sums))

    def quality(self, products: Float[Tensor, "*sets g g"]) -> Float[Tensor, "*sets g"]:
        """Error of the location at each place [m], from products of factors over a set."""
        mean_squares = (products * self.squares).sum(-1) / products.sum(-1)  # (*sets, g)
        return (mean_squares / 2).sqrt()


def choose(
    rule: Coverage | LocationError, standing: int, count: int
) -> tuple[Int[Tensor, " n"], Float[Tensor, "n1 g"]]:
    """Chooses ``count`` receivers in addition to the first ``standing`` ones of a rule.

    The greedy choice adds the best receiver, ``count`` times. Then single receivers are exchanged
    while the score improves. Coverage and mean level are monotone and submodular, so they gain at
    least 1 - 1/e of the gain of the best set. Source of both steps: Nemhauser, Wolsey and Fisher,
    An analysis of approximations for maximizing submodular set functions, 1978.

    Args:
        rule: The objective, with existing receivers first and possible ones after them.

    Returns:
        Numbers of the chosen receivers, the best first, and the quality of each place before and
        after each choice.
    """
    numbers = torch.arange(len(rule.values))
    existing, candidates = numbers[:standing], numbers[standing:]
    members, score = extend(rule, existing, candidates, count)  # existing ones first
    unchanged = 0  # receivers that stayed since the last exchange
    while unchanged < count:
        # The earliest chosen receiver leaves, and the best candidate, perhaps the same, is added.
        others = torch.cat((existing, members[standing + 1 :]))
        members, new_score = extend(rule, others, candidates, 1)
        unchanged = 0 if new_score > score + 1e-9 else unchanged + 1
        score = max(score, new_score)
    # The same set, in the greedy order.
    members, _ = extend(rule, existing, members[standing:], count)
    products = [product_of(rule, members[:end]) for end in range(standing, len(members) + 1)]
    return members[standing:], torch.stack([rule.quality(product) for product in products])


def extend(
    rule: Coverage | LocationError,
    members: Int[Tensor, " k"],
    candidates: Int[Tensor, " c"],
    count: int,
    most: int = 4_000_000,
) -> tuple[Int[Tensor, " n"], float]:
    """Adds ``count`` candidates to a set of receivers, each time the one with the best score.

    Args:
        members: Numbers of the receivers in the set.
        candidates: Numbers of the receivers that may be added.
        most: Largest number of values of ``rule.factors`` in memory at a time.

    Returns:
        The larger set and its score: the mean quality over places, negative if lower is better.
    """
    score = -torch.inf
    for _ in track(range(count), "receivers to place"):
        free = candidates[~torch.isin(candidates, members)]
        product = product_of(rule, members)
        block_size = max(1, most // product.numel())
        means = []
        for block in free.split(block_size):
            qualities = rule.quality(product * rule.factors(block))  # (block, g)
            means.append(rule.sign * qualities.mean(-1))
        scores = torch.cat(means)  # of the set with each free candidate
        members = torch.cat((members, free[scores.argmax()][None]))
        score = scores.max().item()
    return members, score


def product_of(rule: Coverage | LocationError, members: Int[Tensor, " k"]) -> Float[Tensor, "g t"]:
    """The product of the factors of a set's receivers; ones for an empty set."""
    shape_source = rule.factors(torch.zeros(1, dtype=torch.int64))[0]  # of any receiver
    product = torch.ones_like(shape_source)
    for receiver in members[:, None]:
        product = product * rule.factors(receiver)[0]
    return product
