"""Density control: prune, clone and split Gaussians, keeping the optimizer's memory of those that stay.

Functions over (Gaussians, optimizer, what to do with whom); the schedule is a callback's business.

Source: Kerbl et al., 3D Gaussian Splatting, 2023, section 5.2.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool
from torch import Tensor, nn
from torch.optim import Optimizer

from gaigs.gaussians import Gaussians
from gaigs.geometry import quaternions_to_rotations

SHRINK = 1.6
"""The halves of a split Gaussian have its scales divided by this (Kerbl et al.)."""


def prune(gaussians: Gaussians, optimizer: Optimizer, gone: Bool[Tensor, "n"]) -> None:
    """Removes Gaussians.

    Raises:
        ValueError: None would be left.
    """
    if gone.all():
        raise ValueError(f"pruning must leave a Gaussian, and all {len(gone)} would go; lower the opacity bound")
    keep = ~gone
    _rearrange(gaussians, optimizer, lambda values: values[keep], lambda state: state[keep])


def clone(gaussians: Gaussians, optimizer: Optimizer, chosen: Bool[Tensor, "n"]) -> None:
    """Doubles Gaussians in place, sharing the opacity so that both together cover what one did.

    1 - (1 - a')² = a gives a' = 1 - sqrt(1 - a); the signal is that of the original. Copies start without momentum.
    """
    copies = _append(gaussians, optimizer, chosen)
    with torch.no_grad():
        # The logit of a' in that of a, which loses no digits where a is near 0 or 1.
        logits = gaussians.opacity_logits[copies]
        gaussians.opacity_logits[copies] = nn.functional.softplus(logits).div(2).expm1().log()


def split(gaussians: Gaussians, optimizer: Optimizer, chosen: Bool[Tensor, "n"], generator: torch.Generator) -> None:
    """Replaces each chosen Gaussian by two smaller ones drawn from it."""
    halves = _append(gaussians, optimizer, chosen)
    with torch.no_grad():
        scales, quats = gaussians.scales[halves], gaussians.quats[halves]
        steps = torch.randn(scales.shape, generator=generator).to(scales) * scales
        gaussians.means[halves] += (quaternions_to_rotations(quats) @ steps[..., None]).squeeze(-1)
        gaussians.log_scales[halves] -= math.log(SHRINK)


def _append(gaussians: Gaussians, optimizer: Optimizer, chosen: Bool[Tensor, "n"]) -> Bool[Tensor, "m"]:
    """Puts copies of the chosen behind all others; True for both of each pair."""
    _rearrange(
        gaussians,
        optimizer,
        lambda values: torch.cat((values, values[chosen])),
        lambda state: torch.cat((state, torch.zeros_like(state[chosen]))),
    )
    return torch.cat((chosen, chosen[chosen]))


def _rearrange(
    gaussians: Gaussians,
    optimizer: Optimizer,
    pick: Callable[[Tensor], Tensor],
    pick_state: Callable[[Tensor], Tensor],
) -> None:
    """New parameters in place of the old ones, in the module and in the optimizer."""
    for name in gaussians.PARAMETERS:
        old = getattr(gaussians, name)
        new = nn.Parameter(pick(old.detach()), old.requires_grad)
        setattr(gaussians, name, new)
        for group in optimizer.param_groups:
            group["params"] = [new if parameter is old else parameter for parameter in group["params"]]
        if state := optimizer.state.pop(old, None):
            # What an optimizer remembers is of the Gaussians, though not of all their axes in Adafactor, or one number.
            optimizer.state[new] = {
                key: pick_state(value) if torch.is_tensor(value) and value.shape[:1] == old.shape[:1] else value
                for key, value in state.items()
            }
