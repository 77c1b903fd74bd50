"""Density control: prune, clone and split Gaussians.

The optimizer's state of the remaining Gaussians is kept.

Source: Kerbl et al., 3D Gaussian Splatting, 2023, section 5.2.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Bool
from torch import Tensor, nn
from torch.optim import Optimizer

from gaigs.core.geometry import quaternions_to_rotations
from gaigs.splatting.deformation import Deformation
from gaigs.splatting.gaussians import Gaussians

SelectRows = Callable[[Tensor], Tensor]


def prune(
    gaussians: Gaussians,
    optimizer: Optimizer,
    gone: Bool[Tensor, " n"],
    follower: Deformation | None = None,
) -> None:
    """Removes Gaussians.

    Args:
        gaussians: Gaussians, whose rows are removed in place.
        optimizer: Optimizer of the Gaussians.
        gone: True for each Gaussian to remove.
        follower: Deformation with a parameter row for each Gaussian; the same rows are removed.

    Source: Kerbl et al., 2023, section 5.2.
    """
    if gone.all():
        raise ValueError(f"pruning would remove all {len(gone)} Gaussians; lower the opacity bound")
    keep = ~gone

    def select(rows: Tensor) -> Tensor:
        return rows[keep]

    _rearrange(gaussians, optimizer, select, select, follower)


def clone(
    gaussians: Gaussians,
    optimizer: Optimizer,
    chosen: Bool[Tensor, " n"],
    follower: Deformation | None = None,
) -> None:
    """Duplicates the chosen Gaussians in place.

    Two Gaussians of opacity a' = 1 - sqrt(1 - a) cover as much as one of opacity a.

    Source: Kerbl et al., 2023, section 5.2. The paper copies the opacity.
    """
    copies = _append(gaussians, optimizer, chosen, follower)
    with torch.no_grad():
        # logit a' = log(a' / (1 - a')) = log(exp(softplus(logit a) / 2) - 1), since softplus(logit
        # a) = -log(1 - a). This form is accurate for opacities near 0 and 1.
        logits = gaussians.opacity_logits[copies]
        gaussians.opacity_logits[copies] = nn.functional.softplus(logits).div(2).expm1().log()


def split(
    gaussians: Gaussians,
    optimizer: Optimizer,
    chosen: Bool[Tensor, " n"],
    generator: torch.Generator,
    follower: Deformation | None = None,
) -> None:
    """Replaces each chosen Gaussian by two smaller ones, whose centres are drawn from it.

    Arguments are as for ``prune``; ``generator`` draws the centres.

    Source: Kerbl et al., 2023, section 5.2.
    """
    shrinkage = 1.6  # as Kerbl et al. shrink them
    halves = _append(gaussians, optimizer, chosen, follower)
    with torch.no_grad():
        scales = gaussians.scales[halves]  # (m, 3) [m]
        rotations = quaternions_to_rotations(gaussians.quats[halves])  # (m, 3, 3)
        # Steps of both halves from the centre, along the Gaussian's axes (m, 3) [m].
        steps = torch.randn(scales.shape, generator=generator).to(scales) * scales
        gaussians.means[halves] += (rotations @ steps[..., None]).squeeze(-1)
        gaussians.log_scales[halves] -= math.log(shrinkage)


def _append(
    gaussians: Gaussians,
    optimizer: Optimizer,
    chosen: Bool[Tensor, " n"],
    follower: Deformation | None,
) -> Bool[Tensor, " m"]:
    """Appends copies of the chosen Gaussians.

    Returns:
        True for the m Gaussians afterwards that were chosen, or are their copies.
    """

    def with_copies(rows: Tensor) -> Tensor:
        return torch.cat((rows, rows[chosen]))

    def with_zeros(rows: Tensor) -> Tensor:
        # A copy has no history: its moments in the optimizer start at zero.
        return torch.cat((rows, torch.zeros_like(rows[chosen])))

    _rearrange(gaussians, optimizer, with_copies, with_zeros, follower)
    return torch.cat((chosen, chosen[chosen]))


def _rearrange(
    gaussians: Gaussians,
    optimizer: Optimizer,
    select: SelectRows,
    select_state: SelectRows,
    follower: Deformation | None,
) -> None:
    """Replaces rows of parameters in the modules, and of their state in the optimizer.

    Args:
        gaussians, optimizer, follower: As for ``prune``.
        select: Function from the rows of a parameter to its new rows.
        select_state: The same function for the optimizer's state.
    """
    owned: list[tuple[nn.Module, str]] = [(gaussians, name) for name in gaussians.PARAMETERS]
    if follower is not None:
        owned += [(follower, name) for name in follower.follows]
    for owner, name in owned:
        old = getattr(owner, name)
        new = nn.Parameter(select(old.detach()), old.requires_grad)
        setattr(owner, name, new)
        for group in optimizer.param_groups:
            parameters = group["params"]
            group["params"] = [new if parameter is old else parameter for parameter in parameters]
        state = optimizer.state.pop(old, None)
        if not state:
            continue
        for key, value in state.items():
            # State by Gaussian is selected like the parameter; single numbers, such as the count of
            # steps, stay. Other axes may be missing, as in Adafactor's state.
            if torch.is_tensor(value) and value.shape[:1] == old.shape[:1]:
                state[key] = select_state(value)
        optimizer.state[new] = state
