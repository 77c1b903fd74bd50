"""Field that arrives along each ray: orthographic splatting on a sphere, composited with complex
transmittances.
"""

import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor

from gaigs.core.geometry import Pose, polar, quaternions_to_rotations
from gaigs.splatting.projection import NEAR
from gaigs.splatting.rasterizer import ALPHA_MAX
from gaigs_gsrf.gaussians import ComplexGaussians

CHUNK = 2**21
"""Pairs of a Gaussian and a ray worked on at a time where no gradient is asked for: 8 MiB an array
of float32.
"""

NARROWEST = 1e-3
"""Smallest standard deviation of a footprint over the sphere's radius: a twentieth of a degree,
which no label resolves, and four digits above what float32 tells of directions."""


def render(
    gaussians: ComplexGaussians,
    radiance: Complex[Tensor, "b n s"],
    receiver: Pose,
    vectors: Float[Tensor, "rays 3"],
    radius: float,
) -> Complex[Tensor, "b s rays"]:
    """Fields S(u) = sum_i psi_i alpha_i T_i along rays u from a receiver.

    T_i is the transmittance of the Gaussians in front of i, see ``weights``.

    Args:
        gaussians: Centres, covariances, opacities and phases.
        radiance: psi of each Gaussian towards each transmitter.
        receiver: Pose of the receiver, which is in the middle of the sphere.
        vectors: Unit vectors of the rays in the array's frame.
        radius: Radius of the sphere [m].

    Source: GSRF (NeurIPS 2025), "Orthographic splatting" and "Complex-valued ray tracing".
    """
    receiver = receiver.to(gaussians.means)
    offsets = gaussians.means - receiver.position
    distances = offsets.norm(dim=-1)
    order = distances.argsort(stable=True)
    # A Gaussian on the receiver has no direction; NaN stays, so that it shows.
    order = order[~(distances[order] < NEAR)]
    centres = offsets[order] / distances[order, None]  # (k, 3)
    sent = radiance[:, order].mT  # (b, s, k)
    rays = vectors @ receiver.rotation.mT
    size = len(rays) if torch.is_grad_enabled() else max(1, CHUNK // max(1, len(order)))
    fields = []
    for part in rays.split(size):
        fields.append(sent @ weights(gaussians, order, centres, part, radius))
    return torch.cat(fields, 2)


def weights(
    gaussians: ComplexGaussians,
    order: Int[Tensor, " k"],
    centres: Float[Tensor, "k 3"],
    rays: Float[Tensor, "rays 3"],
    radius: float,
) -> Complex[Tensor, "k rays"]:
    """Weights alpha_i T_i of the Gaussians on each ray.

        w_i = exp(-d' Sigma_i^-1 d / 2)      d = radius (u - u_i), from projection to ray
        alpha_i = min(0.99, o_i w_i)         T_i = prod_{j<i} (1 - alpha_j) exp(j phi_j w_j)

    Sigma is the Gaussian's covariance in space: its distance does not change its footprint.

    Args:
        gaussians: Covariances, opacities and phases.
        order: Numbers of k Gaussians, front to back.
        centres: Unit vectors towards them, world frame.
        rays: Unit vectors, world frame.
        radius: Radius of the sphere [m].
    """
    # Sigma = R S² R', so that d' Sigma^-1 d = |S^-1 R' d|².
    least = (NARROWEST * gaussians.log_scales.new_tensor(radius)).log()
    shrinking = radius * (-gaussians.log_scales[order].clamp(min=least)).exp()  # (k, 3)
    whitening = quaternions_to_rotations(gaussians.quats[order]).mT * shrinking[..., None]
    apart = whitening @ rays.T - whitening @ centres[..., None]  # (k, 3, rays)
    footprints = (-0.5 * apart.square().sum(1)).exp()  # (k, rays)
    alphas = (gaussians.opacities[order, None] * footprints).clamp(max=ALPHA_MAX)
    # The product over the Gaussians in front is a sum of logarithms and phases.
    losses = torch.log1p(-alphas)
    turns = gaussians.phases[order, None] * footprints
    amplitudes = alphas * (losses.cumsum(0) - losses).exp()
    return polar(amplitudes, turns.cumsum(0) - turns)
