"""2-D Gaussians in the plane of azimuth and elevation, and their plain sum."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.core.geometry import Directions, Grid


class PlaneGaussians(NamedTuple):
    """Gaussians in the plane, as each of b links sees them.

    Attributes:
        means: Azimuth and elevation (b, n, 2) [rad].
        factors: p, q and r of the covariance's lower triangular factor [[p, 0], [q, r]] (b, n, 3)
            [rad].
        amplitudes: Amplitudes (b, n).
    """

    means: Float[Tensor, "b n 2"]
    factors: Float[Tensor, "b n 3"]
    amplitudes: Float[Tensor, "b n"]


def add_up(
    gaussians: PlaneGaussians, directions: Directions, pixel_variance: float
) -> Float[Tensor, " b *shape"]:
    """Spectra sum_i a_i exp(-x' C_i^-1 x / 2), with the direction x relative to the mean.

    Differences of azimuths are the shorter way around the circle.

    Args:
        gaussians: Gaussians of each link.
        directions: A grid, or a list of rays.
        pixel_variance: Added to both variances, so that none is 0 [rad²].
    """
    azimuths = directions.azimuths[None]  # (1, columns)
    elevations = directions.elevations[None]
    if isinstance(directions, Grid):
        elevations = elevations.mT  # (rows, 1)
    u, v = (mean[..., None, None] for mean in gaussians.means.unbind(-1))  # (b, n, 1, 1) each
    du = torch.remainder(azimuths - u + math.pi, 2 * math.pi) - math.pi
    dv = elevations - v
    pp, qq, rr = (factor[..., None, None].square() for factor in gaussians.factors.unbind(-1))
    pq = gaussians.factors[..., :2].prod(-1)[..., None, None]
    # C = [[pp + s, pq], [pq, qq + rr + s]] with the pixel's variance s. Its determinant is computed
    # as a sum of squares, which loses no digits to cancellation.
    halved = 0.5 / (pp * rr + pixel_variance * (pp + qq + rr) + pixel_variance**2)
    across = -(qq + rr + pixel_variance) * halved * du.square()
    upwards = -(pp + pixel_variance) * halved * dv.square()
    footprints = torch.addcmul(across + upwards, 2 * pq * halved * dv, du).exp()
    values = gaussians.amplitudes[:, None] @ footprints.flatten(2)
    return values.view(len(values), *directions.shape)
