"""The nearest known fingerprints: the baseline of ``locate``."""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.core.query import evenly
from gaigs.model.knn import COUNTS


def without_power(values: Float[Tensor, "n r m"]) -> Float[Tensor, "n r m"]:
    """Fingerprints minus their mean level, or divided by their norm, over all receivers."""
    if values.shape[2] == 1:
        return values - values.nanmean(1, keepdim=True)
    norms = values.nan_to_num(0).flatten(1).norm(dim=1)
    return values / norms[:, None, None]


def neighbours(
    values: Float[Tensor, "n r m"],
    known: Float[Tensor, "k r m"],
    places: Float[Tensor, "k 3"],
    groups: Int[Tensor, " k"],
    most: int = 500,
) -> Float[Tensor, "n 3"]:
    """Places of fingerprints by their nearest known fingerprints.

    A place is the mean of known places, weighted by 1 / distance between fingerprints. The number
    of neighbours is the one in ``COUNTS`` with the lowest mean error of known transmissions, each
    located without its own group.

    Args:
        values: Fingerprints to locate. The lowest known level replaces missing levels; 0 replaces
            missing labels of several numbers.
        known: Fingerprints at the known ``places`` [m].
        groups: Group of each known fingerprint, such as its place.
        most: Largest number of known transmissions that choose the number of neighbours.
    """
    least = known[~known.isnan()].min() if known.shape[2] == 1 else 0.0
    filled = known.where(~known.isnan(), least).flatten(1)  # (k, r m)
    chosen = evenly(torch.arange(len(known)), most)
    apart = torch.cdist(filled[chosen], filled)
    apart = apart.masked_fill(groups[chosen][:, None] == groups, torch.inf)

    def error(count: int) -> float:
        return (weighted_mean(apart, places, count) - places[chosen]).norm(dim=1).mean().item()

    count = min(COUNTS, key=error)
    complete = values.where(~values.isnan(), least).flatten(1)  # (n, r m)
    return weighted_mean(torch.cdist(complete, filled), places, count)


def weighted_mean(
    apart: Float[Tensor, "n k"], places: Float[Tensor, "k 3"], count: int
) -> Float[Tensor, "n 3"]:
    """Means of the ``count`` nearest places, weighted by 1 / distance.

    Args:
        apart: Distances of n fingerprints from the fingerprints at k places.
    """
    nearest = apart.topk(min(count, apart.shape[1]), largest=False)
    weights = 1 / nearest.values.clamp_min(1e-6)
    shares = weights / weights.sum(1, keepdim=True)
    return (places[nearest.indices] * shares[..., None]).sum(1)
