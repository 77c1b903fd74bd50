"""What a receiver has of its own: its level, and errors that places near each other share.

Errors of a model at two places of a receiver without links have the covariance

    level + field exp(-distance / length) + [same place] noise

Four numbers hold this law: level, noise, field [label's unit squared] and length [m].
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from scipy.optimize import minimize
from torch import Tensor
from torch.distributions import MultivariateNormal

from gaigs.kriging.links import distances


def fit_random_effects(
    errors: Sequence[Float[Tensor, " k"]], places: Sequence[Float[Tensor, "k 3"]], most: int = 100
) -> Float[Tensor, "4"]:
    """The most likely law of receivers, each of which a model predicted as new.

    Args:
        errors: Errors of each receiver's links.
        places: Their transmitters [m].
        most: Largest number of links of a receiver.

    Source: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 5.4.1.
    """
    parts = []
    for own, there in zip(errors, places, strict=True):
        rows = torch.linspace(0, len(own) - 1, min(len(own), most)).long()
        parts.append((own[rows].double(), distances(there[rows].double(), there[rows].double())))
    mean = torch.cat([own for own, _ in parts]).square().mean().clamp_min(1e-9)
    size = torch.stack([apart.max() for _, apart in parts]).median().clamp_min(1e-6)
    units = torch.stack((mean, mean, mean, size))

    def cost(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        """Negative log likelihood over the number of links, and its gradient."""
        values = torch.from_numpy(logarithms).requires_grad_()
        level, noise, field, length = values.exp() * units
        total = values.new_zeros(())
        for own, apart in parts:
            covariances = level + field * (-apart / length).exp() + noise * torch.eye(len(own))
            total = total - MultivariateNormal(torch.zeros_like(own), covariances).log_prob(own)
        total = total / sum(len(own) for own, _ in parts)
        (gradient,) = torch.autograd.grad(total, values)
        return total.item(), gradient.numpy()

    # Variances from 1e-4 to 20 mean squares, lengths from 0.1 % to 3 sizes of the site.
    bounds = [(-9.0, 3.0)] * 3 + [(-7.0, 1.0)]
    start = np.log([0.25, 0.3, 0.3, 0.05])
    with torch.enable_grad():
        found = minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds)
    return torch.from_numpy(np.exp(found.x)) * units
