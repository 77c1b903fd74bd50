"""Weights of a blend of models, by their errors where they have not learnt."""

from typing import NamedTuple

import torch
from jaxtyping import Float, Inexact, Int
from scipy.optimize import nnls
from torch import Tensor

from gaigs.core.query import thin_labels


class Stack(NamedTuple):
    """Weights of a blend: shares of its models, which sum to 1."""

    weights: Float[Tensor, " c"]  # multiples of 0.1
    # The weights of each link, by all folds but its own.
    crossed: Float[Tensor, "k c"]


def stack(
    labels: Inexact[Tensor, " k *shape"],
    values: list[Tensor],
    places: Int[Tensor, " k"],
    folds: Int[Tensor, " k"],
) -> Stack:
    """Shares of models by least squares of their common errors.

    Args:
        labels: Labels of some links.
        values: Predictions of each model that has not seen them (k, *shape).
        places: Number of each link's place.
        folds: Number of each link's fold.

    Source: Breiman, Stacked regressions, 1996; van der Laan, Polley and Hubbard, Super learner,
    2007.
    """
    errors = torch.stack([thin_labels(labels - one) for one in values], 1)  # (k, c, m)
    if labels.is_complex():  # a channel's error counts relative to its strength, as in its SNR
        errors = errors / thin_labels(labels).abs().square().mean(1).sqrt()[:, None, None]
    products = (errors @ errors.mH).real.double() / errors.shape[2]  # (k, c, c)
    weights = _shares(products, places)
    crossed = torch.zeros(len(labels), len(values), dtype=torch.float64)
    for fold in folds.unique():
        others = folds != fold
        crossed[~others] = _shares(products[others], places[others])
    return Stack(weights, crossed)


def _shares(products: Float[Tensor, "k c c"], places: Int[Tensor, " k"]) -> Float[Tensor, " c"]:
    """Shares w >= 0 with the least w' G w, G the mean of products over places."""
    count = products.shape[1]
    if not len(products):
        return torch.full((count,), 1 / count).double()
    _, which, links = places.unique(return_inverse=True, return_counts=True)
    sums = products.new_zeros(len(links), count, count).index_add(0, which, products)
    gram = (sums / links[:, None, None]).mean(0)  # (c, c)
    # One more place, at which all models err alike and independently: few places say little, and
    # draw the shares towards equal ones.
    size = gram.diagonal().mean().clamp_min(1e-30)
    gram = gram / size + torch.eye(count) / len(links)
    # Without the sum's condition, in units of it: w' G w + 1e4 (sum w - 1)².
    matrix = torch.cat(
        (torch.linalg.cholesky(gram + 1e-9 * torch.eye(count)).mH, torch.full((1, count), 1e2))
    )
    target = torch.zeros(count + 1, dtype=torch.float64)
    target[-1] = 1e2
    found, _ = nnls(matrix.numpy(), target.numpy())
    shares = torch.from_numpy(found / found.sum())
    tenths = (10 * shares).round() / 10
    tenths[shares.argmax()] += 1 - tenths.sum()
    return tenths
