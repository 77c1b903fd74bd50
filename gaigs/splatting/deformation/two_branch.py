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

INITIAL_ATTENUATION = 0.98
"""Attenuation delta at the start of training: nearly transparent."""

LEAST_ATTENUATION = 1e-6
"""Least attenuation delta, -120 dB: its logarithm, which rendering uses, stays finite."""


class TokenLinear(nn.Module):
    """A linear layer on [hidden, E(P_x), E(P_TX), CLS] of every pair of transmitter and Gaussian.

    The layer is a sum of four linear maps, one for each part of the input. Only the map of
    ``hidden`` is computed for all b x n pairs.

    Args:
        tokens: Widths of (scene, gaussians, transmitters); a part of width 0 has no map.
        width: Width of the result.
        hidden: Width of ``hidden``.
    """

    def __init__(self, tokens: tuple[int, int, int], width: int, hidden: int = 0):
        super().__init__()
        scene, gaussian, transmitter = tokens
        self.bias = nn.Parameter(torch.empty(width))
        self.links = _linear(scene + transmitter, width)
        self.gaussians = _linear(gaussian, width)
        self.hidden = _linear(hidden, width)
        # The bound of one layer over the concatenation.
        bound = max(scene + gaussian + transmitter + hidden, 1) ** -0.5
        for parameter in self.parameters():
            nn.init.uniform_(parameter, -bound, bound)

    def forward(
        self, tokens: Tokens, hidden: Float[Tensor, "b n h"] | None = None
    ) -> Float[Tensor, "b n width"]:
        result = self.bias
        if self.links is not None:
            links = torch.cat((tokens.scene, tokens.transmitters), -1)  # (b, d_scene + d_tx)
            result = result + self.links(links)[:, None]  # (b, 1, width)
        if self.gaussians is not None:
            result = result + self.gaussians(tokens.gaussians)  # (1 or b, n, width)
        if self.hidden is not None:
            result = result + self.hidden(hidden)
        return result.expand(len(tokens.scene), tokens.gaussians.shape[-2], -1)


def _linear(inputs: int, width: int) -> nn.Linear | None:
    """A linear layer without a bias; None without inputs."""
    return nn.Linear(inputs, width, bias=False) if inputs else None


class ResidualLayer(nn.Module):
    """h + GELU(W h), a residual layer that preserves the geometry of earlier layers.

    Source: GAI-GS, "Scene Mapping Network": "residual connections to stabilize training and
    preserve geometric information".
    """

    def __init__(self, width: int):
        super().__init__()
        self.linear = nn.Linear(width, width)

    def forward(self, hidden: Tensor) -> Tensor:
        return hidden + functional.gelu(self.linear(hidden))


@register("deformation", "two_branch")
class TwoBranch(Deformation):
    """The two branches of the paper, from the tokens of b queries and n Gaussians to residuals.

    Attenuation branch: f = residual layers on [E(P_x), E(P_TX), CLS], with heads for the opacity
    residual and delta. Signal branch: h = residual layers on [f, E(P_x), E(P_TX), CLS], with heads
    on [f, h] for rotation, scale and signal. At the start delta is ``INITIAL_ATTENUATION``, and the
    residuals of all other heads except the signal's are 0.

    Args:
        tokenizer_widths: Widths of (scene, gaussians, transmitters) in the tokens.
        channels: Signal channels of a Gaussian.
        width: Width of both branches.
        attenuation_layers, signal_layers: Residual layers of each branch after its first layer.
        heads: Used heads, of ``all_heads``. Branches without a used head have no parameters.

    Attributes:
        all_heads: Names of the heads, in the order of ``Residuals``.

    Raises:
        ValueError: An option is out of range, or a head is unknown.

    Source: GAI-GS, "Scene Mapping Network", eq. (11) and (12).
    """

    all_heads = ("rotation", "scale", "signal", "opacity", "attenuation")

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
        unknown = sorted(set(heads) - set(self.all_heads))
        if unknown:
            names = ", ".join(self.all_heads)
            raise ValueError(f"deformation.heads must be among {names}, got {', '.join(unknown)}")
        _check_at_least("width", width, 1)
        _check_at_least("attenuation_layers", attenuation_layers, 0)
        _check_at_least("signal_layers", signal_layers, 0)
        self.heads = nn.ModuleDict()
        if not heads:
            return
        self.attenuation_first = TokenLinear(tokenizer_widths, width)
        self.attenuation_rest = _residual_layers(attenuation_layers, width)
        self._add_heads(heads, {"opacity": 1, "attenuation": 1}, width)
        self.has_signal_branch = not set(heads).isdisjoint(("rotation", "scale", "signal"))
        if self.has_signal_branch:
            self.signal_first = TokenLinear(tokenizer_widths, width, hidden=width)
            self.signal_rest = _residual_layers(signal_layers, width)
        self._add_heads(heads, {"rotation": 4, "scale": 3, "signal": channels}, 2 * width)
        self._start_heads()

    def _add_heads(self, heads: Sequence[str], sizes: dict[str, int], width: int) -> None:
        """Adds the used ``heads``, with ``sizes`` outputs each, on features of ``width``."""
        for name, size in sizes.items():
            if name in heads:
                self.heads[name] = nn.Linear(width, size)

    def _start_heads(self) -> None:
        """Sets all heads except the signal's to zero residual, and delta to its initial value."""
        for name, head in self.heads.items():
            if name != "signal":
                nn.init.zeros_(head.weight)
                nn.init.zeros_(head.bias)
        if "attenuation" in self.heads:
            logit = math.log(INITIAL_ATTENUATION / (1 - INITIAL_ATTENUATION))
            nn.init.constant_(self.heads["attenuation"].bias, logit)

    def forward(self, tokens: Tokens, placed: Placed, query: Query) -> Residuals:
        if not self.heads:
            return Residuals()
        # eq. (11): delta, f = F_att(E(P_TX), E(P_x), CLS).
        first = functional.gelu(self.attenuation_first(tokens))
        attenuation = self.attenuation_rest(first)  # f, (b, n, width)
        features = {"opacity": attenuation, "attenuation": attenuation}
        if self.has_signal_branch:
            # eq. (12): xi = F_sig(f, E(P_TX), E(P_x), CLS), and heads on both features.
            first = functional.gelu(self.signal_first(tokens, attenuation))
            signal = self.signal_rest(first)
            joint = torch.cat((attenuation, signal), -1)  # (b, n, 2 width)
            features |= {"rotation": joint, "scale": joint, "signal": joint}
        results = {name: head(features[name]) for name, head in self.heads.items()}
        if "signal" in results:
            results["signal"] = results["signal"][..., None]  # (b, n, c, 1)
        if "opacity" in results:
            results["opacity"] = results["opacity"].squeeze(-1)  # (b, n)
        if "attenuation" in results:
            share = results["attenuation"].squeeze(-1).sigmoid()  # (b, n)
            results["attenuation"] = LEAST_ATTENUATION + (1 - LEAST_ATTENUATION) * share
        return Residuals(*(results.get(name) for name in self.all_heads))


def _residual_layers(count: int, width: int) -> nn.Sequential:
    return nn.Sequential(*(ResidualLayer(width) for _ in range(count)))


def _check_at_least(option: str, value: int, least: int) -> None:
    if value < least:
        raise ValueError(f"deformation.{option} must be at least {least}, got {value}")
