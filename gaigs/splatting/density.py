"""Density control: prune, clone and split Gaussians; the optimizer keeps its state of all others.

Source: Kerbl et al., 3D Gaussian Splatting, 2023, section 5.2.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool
from torch import Tensor, nn
from torch.optim import Optimizer

from gaigs.core.geometry import quaternions_to_rotations
from gaigs.splatting.gaussians import Gaussians

Pick = Callable[[Tensor], Tensor]


def prune(gaussians: Gaussians, optimizer: Optimizer, gone: Bool[Tensor, " n"]) -> None:
    """Removes Gaussians; a ``ValueError`` if none would be left."""
    if gone.all():
        raise ValueError(f"pruning would remove all {len(gone)} Gaussians; lower the opacity bound")
    keep = ~gone
    _rearrange(gaussians, optimizer, lambda values: values[keep], lambda state: state[keep])


def clone(gaussians: Gaussians, optimizer: Optimizer, chosen: Bool[Tensor, " n"]) -> None:
    """Doubles Gaussians in place, each with the opacity a' = 1 - sqrt(1 - a), so that both cover as
    much as one.
    """
    copies = _append(gaussians, optimizer, chosen)
    with torch.no_grad():
        # The logit of a' from the logit of a, accurate for opacities near 0 and 1.
        logits = gaussians.opacity_logits[copies]
        gaussians.opacity_logits[copies] = nn.functional.softplus(logits).div(2).expm1().log()


def split(
    gaussians: Gaussians,
    optimizer: Optimizer,
    chosen: Bool[Tensor, " n"],
    generator: torch.Generator,
) -> None:
    """Replaces each chosen Gaussian by two smaller ones drawn from it."""
    halves = _append(gaussians, optimizer, chosen)
    with torch.no_grad():
        scales, quats = gaussians.scales[halves], gaussians.quats[halves]
        steps = torch.randn(scales.shape, generator=generator).to(scales) * scales
        gaussians.means[halves] += (quaternions_to_rotations(quats) @ steps[..., None]).squeeze(-1)
        gaussians.log_scales[halves] -= math.log(1.6)  # as Kerbl et al. shrink them


def _append(
    gaussians: Gaussians, optimizer: Optimizer, chosen: Bool[Tensor, " n"]
) -> Bool[Tensor, " m"]:
    """Appends copies of the chosen Gaussians; gives a mask of originals and copies."""
    copy = lambda values: torch.cat((values, values[chosen]))
    _rearrange(
        gaussians,
        optimizer,
        copy,
        lambda state: torch.cat((state, torch.zeros_like(state[chosen]))),
    )
    return torch.cat((chosen, chosen[chosen]))


def _rearrange(gaussians: Gaussians, optimizer: Optimizer, pick: Pick, pick_state: Pick) -> None:
    """Replaces the parameters in the module and in the optimizer."""
    for name in gaussians.PARAMETERS:
        old = getattr(gaussians, name)
        new = nn.Parameter(pick(old.detach()), old.requires_grad)
        setattr(gaussians, name, new)
        for group in optimizer.param_groups:
            group["params"] = [
                new if parameter is old else parameter for parameter in group["params"]
            ]
        if state := optimizer.state.pop(old, None):
            # An entry has a row for each Gaussian (in Adafactor without all axes), or is one
            # number.
            optimizer.state[new] = {
                key: pick_state(value)
                if torch.is_tensor(value) and value.shape[:1] == old.shape[:1]
                else value
                for key, value in state.items()
            }
