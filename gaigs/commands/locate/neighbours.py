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
    is_scalar = known.shape[2] == 1
    replacement = known[~known.isnan()].min() if is_scalar else 0.0
    complete_known = known.where(~known.isnan(), replacement).flatten(1)  # (k, r m)
    chosen = evenly(torch.arange(len(known)), most)
    distances = torch.cdist(complete_known[chosen], complete_known)  # (chosen, k)
    is_same_group = groups[chosen][:, None] == groups
    distances = distances.masked_fill(is_same_group, torch.inf)

    def mean_error(count: int) -> float:
        """Mean error [m] of the chosen known transmissions, located by ``count`` neighbours."""
        located = weighted_mean(distances, places, count)
        return (located - places[chosen]).norm(dim=1).mean().item()

    count = min(COUNTS, key=mean_error)
    complete_values = values.where(~values.isnan(), replacement).flatten(1)  # (n, r m)
    return weighted_mean(torch.cdist(complete_values, complete_known), places, count)


def weighted_mean(
    distances: Float[Tensor, "n k"], places: Float[Tensor, "k 3"], count: int
) -> Float[Tensor, "n 3"]:
    """Mean places of the ``count`` most similar fingerprints, weighted by 1 / distance.

    Args:
        distances: Distances of n fingerprints from the fingerprints at k places.
    """
    nearest = distances.topk(min(count, distances.shape[1]), largest=False)
    weights = 1 / nearest.values.clamp_min(1e-6)  # (n, count)
    shares = weights / weights.sum(1, keepdim=True)
    return (places[nearest.indices] * shares[..., None]).sum(1)
