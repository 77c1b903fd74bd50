"""Least squares of the strengths of known waves in channels: free (complex) or real."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Complex, Float, Inexact
from torch import Tensor


class FreeFit(NamedTuple):
    """Strengths of waves in channels, and the residual."""

    residual: Complex[Tensor, "b k"]
    strengths: Complex[Tensor, "b n"]


def ridged(gram: Inexact[Tensor, "b n n"], ridge: float) -> Inexact[Tensor, "b n n"]:
    """Gram matrices plus ``ridge`` times their mean diagonal.

    The ridge lets waves that the channel does not resolve share their power.
    """
    power = gram.diagonal(dim1=1, dim2=2).real.mean(1)  # (b,)
    power = torch.where(power > 0, power, 1)  # without waves strengths are 0
    return gram + ridge * power[:, None, None] * torch.eye(gram.shape[-1], dtype=gram.real.dtype)


def fit_free(
    waves: Complex[Tensor, "b n k"], channels: Complex[Tensor, "b k"], ridge: float
) -> FreeFit:
    """Complex strengths of waves that explain the channels best, at each place."""
    gram = ridged(waves.conj() @ waves.mT, ridge)
    right = waves.conj() @ channels[..., None]  # (b, n, 1)
    strengths = torch.linalg.solve(gram, right)[..., 0]
    return FreeFit(channels - (strengths[:, None] @ waves)[:, 0], strengths)


def real_residual(
    waves: Complex[Tensor, "b n k"],
    channels: Complex[Tensor, "b k"],
    signed: Bool[Tensor, " n"],
    ridge: float,
) -> Complex[Tensor, "b k"]:
    """Residual of channels after the best real strengths, negative only where ``signed``."""
    gram = ridged((waves.conj() @ waves.mT).real, ridge)
    strengths = real_strengths(gram, (waves.conj() @ channels[..., None]).real, signed)
    return channels - (strengths.mT.to(waves) @ waves)[:, 0]


def real_strengths(
    gram: Float[Tensor, "b n n"],
    right: Float[Tensor, "b n 1"],
    signed: Bool[Tensor, " n"] | bool = False,
) -> Float[Tensor, "b n 1"]:
    """Solutions of linear systems in which only ``signed`` values may be negative.

    Negative values of the plain solution are set to 0, and the others are solved again: one step of
    an active-set method.
    """
    is_active = torch.linalg.solve(gram, right) >= 0
    active = (is_active | torch.as_tensor(signed)[..., None]).to(gram)  # (b, n, 1)
    reduced = gram * active * active.mT + torch.diag_embed(1 - active[..., 0])
    return torch.linalg.solve(reduced, right * active)


def log_share(
    residual: Complex[Tensor, "b k"], channels: Complex[Tensor, "b k"], floor: float = 1e-3
) -> Float[Tensor, " b"]:
    """log(|residual|² / |channel|² + ``floor``) of each of b channels."""
    power = channels.abs().square().sum(-1)
    return (residual.abs().square().sum(-1) / torch.where(power > 0, power, 1) + floor).log()


def align_phases(
    channels: Complex[Tensor, "b k"], known: Complex[Tensor, "b k"]
) -> Complex[Tensor, "b k"]:
    """Channels, each rotated to the phase of its ``known`` part; unchanged if this part is 0."""
    turns = (known * channels.conj()).sum(1, keepdim=True).sgn()
    return torch.where(turns == 0, channels, channels * turns)
