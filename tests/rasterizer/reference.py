"""The contract of kind ``rasterizer`` written down densely and in float64: the truth of the rasterizers' tests."""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.projection import Plane, Splats
from gaigs.rasterizer import ALPHA_MAX, ALPHA_MIN


def rasterize(
    splats: Splats,
    signal: Float[Tensor, "b n c"],
    opacities: Float[Tensor, "b n"],
    attenuations: Float[Tensor, "b n"] | None,
    plane: Plane,
) -> tuple[Float[Tensor, "b c rows columns"], Float[Tensor, "b rows columns"]]:
    """See ``gaigs.rasterizer.Rasterizer``; float64 out, gradients by autograd, inputs of any dtype."""
    signal, opacities = signal.double(), opacities.double()
    image = signal.new_zeros(signal.shape[0], signal.shape[2], *plane.shape)
    transmittance = signal.new_ones(signal.shape[0], *plane.shape)
    for i in _front_to_back(splats):
        footprint = _footprint(splats, i, plane)
        product = opacities[:, i, None, None] * footprint
        acts = product >= ALPHA_MIN
        alpha = torch.where(acts, product.clamp(max=ALPHA_MAX), 0)
        image = image + signal[:, i, :, None, None] * (alpha * transmittance)[:, None]
        transmittance = transmittance * (1 - alpha)
        if attenuations is not None:
            attenuation = attenuations.double()[:, i, None, None] ** footprint
            transmittance = transmittance * torch.where(acts, attenuation, 1)
    return image, transmittance


@torch.no_grad()
def margin(splats: Splats, opacities: Float[Tensor, "b n"], plane: Plane) -> Float[Tensor, "b rows columns"]:
    """How far, relatively, each pixel is from the nearest jump of value or gradient, a G = ALPHA_MIN or ALPHA_MAX.

    Where this is about a rounding error, float32 and float64 may rightly stand on different sides.
    """
    nearest = opacities.new_full((opacities.shape[0], *plane.shape), torch.inf, dtype=torch.float64)
    for i in _front_to_back(splats):
        product = opacities.double()[:, i, None, None] * _footprint(splats, i, plane)
        for bound in (ALPHA_MIN, ALPHA_MAX):
            nearest = nearest.minimum((product / bound - 1).abs())
    return nearest


def _front_to_back(splats: Splats) -> list[int]:
    """Indices of visible splats by depth, ties by index."""
    depths = splats.depths.tolist()
    return sorted(splats.visible.nonzero().flatten().tolist(), key=lambda i: (depths[i], i))


def _footprint(splats: Splats, i: int, plane: Plane) -> Float[Tensor, "b rows columns"]:
    """exp(-x' C^-1 x / 2) of splat i at every pixel; b = 1 where its covariance is shared."""
    du, dv = plane.u.double() - splats.means2d[i, 0].double(), plane.v.double() - splats.means2d[i, 1].double()
    if plane.period is not None:
        du = du - plane.period * (du / plane.period).round()
    x = torch.stack(torch.broadcast_tensors(du, dv), -1)
    precision = torch.linalg.inv(replace(splats, factors=splats.factors[:, [i]].double()).covariances2d[:, 0])
    return torch.exp(-0.5 * torch.einsum("rci,bij,rcj->brc", x, precision, x))


def factors_of(covariances: Float[Tensor, "*batch 2 2"]) -> Float[Tensor, "*batch 3"]:
    """p, q and r of ``gaigs.projection.Splats``."""
    return torch.linalg.cholesky(covariances)[..., [0, 1, 1], [0, 0, 1]]
