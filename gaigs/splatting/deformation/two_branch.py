"""The paper's scene mapping network: an attenuation branch and a signal branch."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from gaigs.core.query import Query
from gaigs.registry import register
from gaigs.splatting.deformation import Deformation, Residuals
from gaigs.splatting.gaussians import Placed, Tokens

HEADS = ("rotation", "scale", "signal", "opacity", "attenuation")
"""In the order of ``Residuals``."""

INITIAL_ATTENUATION = 0.98
"""Attenuation delta at the start of training: nearly transparent."""

LEAST_ATTENUATION = 1e-6
"""Least attenuation delta, -120 dB: its logarithm, which rendering uses, stays finite."""


class TokenLinear(nn.Module):
    """A linear layer on the concatenation [hidden, E(P_x), E(P_TX), CLS] of every (transmitter,
    Gaussian) pair.

    It is the sum of a linear map of each part, computed b x n times only for ``hidden``.
    """

    def __init__(self, tokens: tuple[int, int, int], width: int, hidden: int = 0):
        super().__init__()
        scene, gaussian, transmitter = tokens
        self.bias = nn.Parameter(torch.empty(width))
        self.links, self.gaussians, self.hidden = (
            nn.Linear(part, width, bias=False) if part else None
            for part in (scene + transmitter, gaussian, hidden)
        )
        bound = max(scene + gaussian + transmitter + hidden, 1) ** -0.5
        for parameter in self.parameters():  # as for one layer over the concatenation
            nn.init.uniform_(parameter, -bound, bound)

    def forward(
        self, tokens: Tokens, hidden: Float[Tensor, "b n h"] | None = None
    ) -> Float[Tensor, "b n width"]:
        result = self.bias
        if self.links is not None:
            result = (
                result + self.links(torch.cat((tokens.scene, tokens.transmitters), -1))[:, None]
            )
        if self.gaussians is not None:
            result = result + self.gaussians(tokens.gaussians)
        if self.hidden is not None:
            result = result + self.hidden(hidden)
        return result.expand(len(tokens.scene), tokens.gaussians.shape[-2], -1)


class ResidualLayer(nn.Module):
    """h + GELU(W h), which keeps the geometry of earlier layers."""

    def __init__(self, width: int):
        super().__init__()
        self.linear = nn.Linear(width, width)

    def forward(self, hidden: Tensor) -> Tensor:
        return hidden + functional.gelu(self.linear(hidden))


@register("deformation", "two_branch")
class TwoBranch(Deformation):
    """The paper's two branches, from the tokens of b queries and n Gaussians to residuals.

    Attenuation branch: f = residual layers on [E(P_x), E(P_TX), CLS]; heads for the opacity
    residual and delta. Signal branch: h = residual layers on [f, E(P_x), E(P_TX), CLS]. Heads on
    [f, h]: rotation, scale, signal. Heads other than the signal's start at zero residual, delta at
    ``INITIAL_ATTENUATION``.

    Args:
        tokenizer_widths: Widths of (scene, gaussians, transmitters) in the tokens.
        channels: Signal channels of a Gaussian.
        width: Of both branches.
        attenuation_layers, signal_layers: Residual layers of each branch after its first layer.
        heads: Heads in use, of ``HEADS``; branches that no head needs have no parameters.

    Source: GAI-GS, "Scene Mapping Network".
    """

    def __init__(
        self,
        tokenizer_widths: tuple[int, int, int],
        channels: int,
        width: int = 64,
        attenuation_layers: int = 2,
        signal_layers: int = 1,
        heads: Sequence[str] = ("signal", "opacity"),
    ):
        super().__init__()
        if unknown := set(heads) - set(HEADS):
            raise ValueError(
                f"deformation.heads must be among {', '.join(HEADS)}, got {', '.join(sorted(unknown))}"
            )
        layers = ("attenuation_layers", attenuation_layers, 0), ("signal_layers", signal_layers, 0)
        for option, value, least in (("width", width, 1), *layers):
            if value < least:
                raise ValueError(f"deformation.{option} must be at least {least}, got {value}")
        self.heads = nn.ModuleDict()
        if not heads:
            return
        self.attenuation_first = TokenLinear(tokenizer_widths, width)
        self.attenuation_rest = nn.Sequential(
            *(ResidualLayer(width) for _ in range(attenuation_layers))
        )
        for name in ("opacity", "attenuation"):
            if name in heads:
                self.heads[name] = nn.Linear(width, 1)
        self.has_signal_branch = not set(heads).isdisjoint(("rotation", "scale", "signal"))
        if self.has_signal_branch:
            self.signal_first = TokenLinear(tokenizer_widths, width, hidden=width)
            self.signal_rest = nn.Sequential(*(ResidualLayer(width) for _ in range(signal_layers)))
        for name, size in (("rotation", 4), ("scale", 3), ("signal", channels)):
            if name in heads:
                self.heads[name] = nn.Linear(2 * width, size)
        for name, head in self.heads.items():
            if name != "signal":
                nn.init.zeros_(head.weight)
                nn.init.zeros_(head.bias)
        if "attenuation" in heads:
            nn.init.constant_(
                self.heads["attenuation"].bias,
                math.log(INITIAL_ATTENUATION / (1 - INITIAL_ATTENUATION)),
            )

    def forward(self, tokens: Tokens, placed: Placed, query: Query) -> Residuals:
        if not self.heads:
            return Residuals()
        attenuation = self.attenuation_rest(functional.gelu(self.attenuation_first(tokens)))
        features = {"opacity": attenuation, "attenuation": attenuation}
        if self.has_signal_branch:
            signal = self.signal_rest(functional.gelu(self.signal_first(tokens, attenuation)))
            features |= dict.fromkeys(
                ("rotation", "scale", "signal"), torch.cat((attenuation, signal), -1)
            )
        results = {name: head(features[name]) for name, head in self.heads.items()}
        if "signal" in results:
            results["signal"] = results["signal"][..., None]
        for name in results.keys() & {"opacity", "attenuation"}:
            results[name] = results[name].squeeze(-1)
        if "attenuation" in results:
            shares = results["attenuation"].sigmoid()
            results["attenuation"] = LEAST_ATTENUATION + (1 - LEAST_ATTENUATION) * shares
        return Residuals(*(results.get(name) for name in HEADS))
