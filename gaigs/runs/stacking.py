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
    errors = torch.stack([thin_labels(labels - one) for one in values], 1)  # (k, c, m)
    if labels.is_complex():  # as in an SNR, relative to the channel
        sizes = thin_labels(labels).abs().square().mean(1).sqrt()[:, None, None]  # (k, 1, 1)
        errors = torch.where(sizes > 0, errors / sizes, 0)  # a channel of zeros has no SNR
    products = (errors @ errors.mH).real.double() / errors.shape[2]  # (k, c, c)
    crossed = products.new_zeros(len(values), len(labels))
    for fold in folds.unique():
        others = folds != fold
        crossed[:, ~others] = shares_of(products[others], places[others])[:, None]
    return shares_of(products, places), crossed


def shares_of(products: Float[Tensor, "k c c"], places: Int[Tensor, " k"]) -> Float[Tensor, " c"]:
    """Weights w >= 0 with sum 1, in steps of a tenth, that minimise w' G w.

    G is the mean over places of ``products``, the products of the models' errors at each link.
    """
    _, which, links = places.unique(return_inverse=True, return_counts=True)
    gram = torch.tensordot(1.0 / links[which].double() / len(links), products, 1)  # (c, c)
    size = gram.diagonal().mean().clamp_min(1e-30)
    one = torch.eye(len(gram), dtype=torch.float64)
    first = one[0]
    root = torch.linalg.cholesky(gram / size + 1e-9 * one).mH
    # Few places tell little: as one place more, |w - first|² draws towards the simplest model. The
    # last row, large in units of the error, is the condition on the sum.
    draw = max(len(links), 1) ** -0.5
    matrix = torch.cat((root, draw * one, torch.full_like(one[:1], 1e3)))
    target = torch.cat((0 * first, draw * first, first.new_tensor([1e3])))
    found = torch.from_numpy(nnls(matrix.numpy(), target.numpy())[0])
    exact = 10 * found / found.sum()
    tenths = exact.floor()
    # The largest remainders get what rounding down has left.
    lacking = int(10 - tenths.sum().round())
    tenths[(exact - tenths).argsort(descending=True)[:lacking]] += 1
    return tenths / 10
