"""Weights of models in a blend, from their errors at links that they have not learnt."""

import torch
from jaxtyping import Float, Inexact, Int
from scipy.optimize import nnls
from torch import Tensor

from gaigs.core.query import thin_labels


def stack(
    labels: Inexact[Tensor, " k *shape"],
    values: list[Tensor],
    places: Int[Tensor, " k"],
    folds: Int[Tensor, " k"],
) -> tuple[Float[Tensor, " c"], Float[Tensor, "c k"]]:
    """Weights of c models in the blend with the least mean square error.

    Args:
        labels: Labels of some links.
        values: Predictions (k, *shape) of each model, which has not seen these links; the simplest
            model comes first.
        places: Number of each link's place; all places have equal weight.
        folds: Number of each link's fold.

    Returns:
        The weights (c,), and for each link the weights fitted to the other folds (c, k).

    Source: Breiman, Stacked regressions, 1996; van der Laan, Polley and Hubbard, Super learner,
    2007.
    """
    errors = torch.stack([thin_labels(labels - predictions) for predictions in values], 1)
    # (k, c, m), with m numbers of each label
    if labels.is_complex():  # relative to the channel, as in an SNR
        powers = thin_labels(labels).abs().square().mean(1)  # (k,)
        amplitudes = powers.sqrt()[:, None, None]
        errors = torch.where(amplitudes > 0, errors / amplitudes, 0)  # 0 for a channel of zeros
    products = (errors @ errors.mH).real.double() / errors.shape[2]  # (k, c, c)
    fold_weights = products.new_zeros(len(values), len(labels))  # (c, k)
    for fold in folds.unique():
        is_other = folds != fold
        weights = shares_of(products[is_other], places[is_other])  # (c,)
        fold_weights[:, ~is_other] = weights[:, None]
    return shares_of(products, places), fold_weights


def shares_of(products: Float[Tensor, "k c c"], places: Int[Tensor, " k"]) -> Float[Tensor, " c"]:
    """Weights w >= 0 with sum 1, in steps of a tenth, that minimise w' G w.

    G is the mean over places of ``products``, the products of the models' errors at each link. The
    minimum is that of the least squares |R w|² with G = R' R. A further term, |w - first|² over the
    number of places, prefers the first model if places are few.
    """
    _, place_of_link, counts = places.unique(return_inverse=True, return_counts=True)
    link_weights = 1.0 / counts[place_of_link].double() / len(counts)  # (k,), equal for places
    gram = torch.tensordot(link_weights, products, 1)  # G, (c, c)
    mean_square = gram.diagonal().mean().clamp_min(1e-30)
    identity = torch.eye(len(gram), dtype=torch.float64)
    first = identity[0]  # all weight to the first model
    root = torch.linalg.cholesky(gram / mean_square + 1e-9 * identity).mH  # R
    # Rows of the least squares: R w = 0; the preference for the first model; and the sum of the
    # weights, with a factor that makes it almost exact.
    preference = max(len(counts), 1) ** -0.5
    matrix = torch.cat((root, preference * identity, torch.full_like(identity[:1], 1e3)))
    target = torch.cat((0 * first, preference * first, first.new_tensor([1e3])))
    solution, _ = nnls(matrix.numpy(), target.numpy())
    weights = torch.from_numpy(solution)
    exact = 10 * weights / weights.sum()
    tenths = exact.floor()
    # The largest remainders are rounded up, so that the sum is 10 tenths.
    missing = int(10 - tenths.sum().round())
    largest = (exact - tenths).argsort(descending=True)[:missing]
    tenths[largest] += 1
    return tenths / 10
