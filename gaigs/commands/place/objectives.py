"""What sets of receivers are worth at places, and the greedy choice of a set.

Readings of receivers are independent normal variables, so a set is worth what a product over its
receivers tells.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.core.stages import track


class Coverage:
    """Chance that the best receiver's reading is above a threshold [%].

    All readings are below it with the product of their chances to be below.

    Args:
        values: Expected readings of receivers at places (r, g) [dBm].
        deviations: Standard deviations of the readings (r, g) [dB].
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
        """Factors of some receivers."""
        above = self.thresholds - self.values[index, :, None]  # (k, g, t)
        return torch.special.ndtr(above / self.deviations[index, :, None])

    def quality(self, products: Float[Tensor, "*sets g t"]) -> Float[Tensor, "*sets g"]:
        """Quality of each place, by products of factors."""
        return 100 * (1 - products[..., 0])


class MeanLevel(Coverage):
    """Expected reading of the best receiver [dBm].

    It is a level below all readings, and the integral above it of the chance to be covered.
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

    Readings at a place y give a place y' an expected likelihood: a normal density of the difference
    of the means, a product over receivers (Jebara, Kondor and Howard, Probability product kernels,
    2004). Half the mean square distance by these weights is the variance of the location. It is
    the Cramér-Rao bound where readings are linear in the place, and counts distant places that look
    alike, which the bound does not know.

    Args:
        values, deviations: As of ``Coverage``.
        places: Possible places, all alike (g, 3) [m].
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
        """Factors of some receivers."""
        means, variances = self.values[index], self.deviations[index].square()
        variances = variances[:, :, None] + variances[:, None]  # (k, g, g)
        apart = means[:, :, None] - means[:, None]
        # A constant of each receiver has no effect; with this one no factor is above 1.
        scale = variances.amin((1, 2), keepdim=True)
        return (scale / variances).sqrt() * torch.exp(-apart.square() / (2 * variances))

    def quality(self, products: Float[Tensor, "*sets g g"]) -> Float[Tensor, "*sets g"]:
        """Quality of each place, by products of factors."""
        return ((products * self.squares).sum(-1) / products.sum(-1) / 2).sqrt()


def choose(
    rule: Coverage | LocationError, standing: int, count: int
) -> tuple[Int[Tensor, " n"], Float[Tensor, "n1 g"]]:
    """Receivers that together are best beside the first ones, which stand; and the quality of each
    place before and after each of them.

    Each is the best beside those before it; then single ones are exchanged as long as that helps.
    Coverage and mean level are monotone and submodular, so they gain at least 1 - 1/e of what the
    best set gains (Nemhauser, Wolsey and Fisher, An analysis of approximations for maximizing
    submodular set functions, 1978, which has both steps).
    """
    rows = torch.arange(len(rule.values))
    start = torch.ones_like(rule.factors(rows[:1])[0])  # (g, t)
    start = product_of(rule, start, rows[:standing])
    candidates = rows[standing:]
    chosen = greedy(rule, start, candidates, count)
    score = means(rule, product_of(rule, start, chosen[:-1]), chosen[-1:])[0]
    kept = 0  # receivers tried since the last exchange
    while 1 < count and kept < count:
        others = chosen[1:]
        gains = means(rule, product_of(rule, start, others), candidates)
        gains[(candidates[:, None] == others).any(1)] = -torch.inf
        is_better = gains.max() > score + 1e-9
        kept = 1 if is_better else kept + 1
        score = torch.maximum(score, gains.max())
        last = candidates[gains.argmax()] if is_better else chosen[0]
        chosen = torch.cat((others, last[None]))
    chosen = greedy(rule, start, chosen, count)
    products = [product_of(rule, start, chosen[:number]) for number in range(count + 1)]
    return chosen, torch.stack([rule.quality(product) for product in products])


def product_of(
    rule: Coverage | LocationError, product: Float[Tensor, "g t"], index: Int[Tensor, " k"]
) -> Float[Tensor, "g t"]:
    """A product with the factors of further receivers."""
    for receiver in index[:, None]:
        product = product * rule.factors(receiver)[0]
    return product


def means(
    rule: Coverage | LocationError,
    product: Float[Tensor, "g t"],
    index: Int[Tensor, " k"],
    most: int = 4_000_000,
) -> Float[Tensor, " k"]:
    """Mean quality over the places with each one of some receivers, negative where lower is better;
    at most ``most`` factors are held.
    """
    parts = index.split(max(1, most // product.numel()))
    return torch.cat(
        [rule.sign * rule.quality(product * rule.factors(part)).mean(-1) for part in parts]
    )


def greedy(
    rule: Coverage | LocationError,
    product: Float[Tensor, "g t"],
    index: Int[Tensor, " k"],
    count: int,
) -> Int[Tensor, " n"]:
    """Some of the receivers, each the best beside those before it."""
    chosen = index[:0]
    for _ in track(range(count), "receivers to place"):
        best = index[means(rule, product, index).argmax()]
        chosen = torch.cat((chosen, best[None]))
        index = index[index != best]
        product = product_of(rule, product, best[None])
    return chosen
