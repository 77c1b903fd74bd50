"""What sets of receivers are worth at places, and the greedy choice of a set."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.core.stages import track


class Objective:
    """A quality of places that depends on a product over receivers, whose readings are independent
    normal variables.

    Args:
        values: Expected readings of receivers at places (r, g) [dBm].
        deviations: Standard deviations of the readings (r, g) [dB].
    """

    higher_is_better = True

    def __init__(self, values: Float[Tensor, "r g"], deviations: Float[Tensor, "r g"]):
        self.values = values
        self.deviations = deviations

    def factors(self, index: Int[Tensor, " k"]) -> Float[Tensor, "k g t"]:
        """Factors of receivers."""
        raise NotImplementedError

    def quality(self, products: Float[Tensor, "*sets g t"]) -> Float[Tensor, "*sets g"]:
        """The quality of each place, by the products of sets of receivers."""
        raise NotImplementedError


class MeanLevel(Objective):
    """Reading of the best receiver [dBm]: its least level, and the integral of the chance that it
    is above a level; see ``Coverage``.
    """

    def __init__(
        self, values: Float[Tensor, "r g"], deviations: Float[Tensor, "r g"], steps: int = 64
    ):
        super().__init__(values, deviations)
        low = (values - 4 * deviations).min().item()  # 3e-5 of a normal variable is lower
        high = (values + 4 * deviations).max().item()
        self.thresholds = torch.linspace(low, high, steps, dtype=values.dtype)  # (t,)

    def factors(self, index: Int[Tensor, " k"]) -> Float[Tensor, "k g t"]:
        above = self.thresholds - self.values[index, :, None]  # (k, g, t)
        return torch.special.ndtr(above / self.deviations[index, :, None])

    def quality(self, products: Float[Tensor, "*sets g t"]) -> Float[Tensor, "*sets g"]:
        return self.thresholds[0] + torch.trapezoid(1 - products, self.thresholds, dim=-1)


class Coverage(MeanLevel):
    """Chance that the best receiver's reading is above a threshold [%].

    All are below it with the product of their chances to be below.
    """

    def __init__(
        self, values: Float[Tensor, "r g"], deviations: Float[Tensor, "r g"], threshold: float
    ):
        super().__init__(values, deviations)
        self.thresholds = values.new_tensor([threshold])

    def quality(self, products: Float[Tensor, "*sets g 1"]) -> Float[Tensor, "*sets g"]:
        return 100 * (1 - products[..., 0])


class LocationError(Objective):
    """Root mean square error of a location by the readings of all receivers [m].

    Readings at a place y give a place y' an expected likelihood: a normal density of the difference
    of the means, a product over receivers (Jebara, Kondor and Howard, Probability product kernels,
    2004). Half the mean square distance by these weights is the variance of the location. It is
    the Cramér-Rao bound where readings are linear in the place, and counts distant places that look
    alike, which the bound does not know.

    Args:
        places: Possible places, all alike (g, 3) [m].
    """

    higher_is_better = False

    def __init__(
        self,
        values: Float[Tensor, "r g"],
        deviations: Float[Tensor, "r g"],
        places: Float[Tensor, "g 3"],
    ):
        super().__init__(values, deviations)
        self.squares = torch.cdist(places, places).square().to(values)  # (g, g)

    def factors(self, index: Int[Tensor, " k"]) -> Float[Tensor, "k g g"]:
        means, variances = self.values[index], self.deviations[index].square()
        variances = variances[:, :, None] + variances[:, None]  # (k, g, g)
        apart = means[:, :, None] - means[:, None]
        # A constant of each receiver has no effect; with this one no factor is above 1.
        scale = variances.amin((1, 2), keepdim=True)
        return (scale / variances).sqrt() * torch.exp(-apart.square() / (2 * variances))

    def quality(self, products: Float[Tensor, "*sets g g"]) -> Float[Tensor, "*sets g"]:
        return ((products * self.squares).sum(-1) / products.sum(-1) / 2).sqrt()


class Choice(NamedTuple):
    """Chosen receivers (n,), and the quality of each place before and after each (n + 1, g)."""

    chosen: Int[Tensor, " n"]
    qualities: Float[Tensor, "n1 g"]


def choose(objective: Objective, standing: int, count: int, most: int = 4_000_000) -> Choice:
    """Receivers beside the first ones, which stand; each the best in the mean over the places.

    Coverage and mean level are monotone and submodular, so they gain at least 1 - 1/e of what the
    best set gains (Nemhauser, Wolsey and Fisher, An analysis of approximations for maximizing
    submodular set functions, 1978).

    Args:
        objective: The quality of places, by readings of all receivers.
        standing: Number of receivers that stand.
        count: Number of receivers to choose.
        most: Largest number of numbers in a part of all factors.
    """
    rows = torch.arange(len(objective.values))
    product = torch.ones_like(objective.factors(rows[:1])[0])  # (g, t)
    parts = rows.split(max(1, most // product.numel()))
    for receiver in rows[:standing, None]:
        product = product * objective.factors(receiver)[0]
    qualities = [objective.quality(product)]
    is_free = rows >= standing
    chosen = []
    for _ in track(range(count), "receivers to place"):
        means = [objective.quality(product * objective.factors(k)).mean(-1) for k in parts]
        gains = torch.cat(means) * (1 if objective.higher_is_better else -1)
        chosen.append(gains.masked_fill(~is_free, -torch.inf).argmax())
        is_free[chosen[-1]] = False
        product = product * objective.factors(chosen[-1][None])[0]
        qualities.append(objective.quality(product))
    return Choice(torch.stack(chosen), torch.stack(qualities))
