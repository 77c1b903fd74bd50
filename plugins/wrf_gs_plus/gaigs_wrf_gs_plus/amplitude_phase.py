"""WRF-GS+'s deformation network: shape, and a wave's amplitude and phase."""

import torch
from torch import Tensor, nn
from torch.nn.functional import relu

from gaigs.core.query import Query
from gaigs.splatting.deformation import Deformation, Residuals
from gaigs.splatting.deformation.two_branch import TokenLinear
from gaigs.splatting.gaussians import Placed, Tokens


class AmplitudePhase(Deformation):
    """Changes of every Gaussian's rotation, scale and signal for a transmitter.

    The network's input u = [E(P_x), E(P_TX), CLS] goes through layers of one width with ReLU, and
    joins the middle one again. Linear heads give rotation and scale, 0 at the start, and amplitude
    a and phase phi of each wave, whose residual is a exp(j phi). A wave is a pair of channels, real
    and imaginary part. An odd number of channels are real ones: they get the real parts.

    Published is |a exp(j phi)|, in which the phase cancels.

    Args:
        channels: Number of signal channels of a Gaussian: all real parts, then all imaginary ones.
        tokenizer_widths: Widths of (scene, gaussians, transmitters) in the tokens.
        width: Width of the layers.
        layers: Number of layers.

    Raises:
        ValueError: A size is out of range.

    Source: WRF-GS+ (IEEE TWC 2025).
    """

    def __init__(
        self, channels: int, tokenizer_widths: tuple[int, int, int], width: int, layers: int
    ):
        super().__init__()
        for option, count, least in (("width", width, 1), ("layers", layers, 2)):
            if count < least:
                raise ValueError(f"deformation.{option} must be at least {least}, got {count}")
        self.is_complex = channels % 2 == 0
        waves = channels // 2 if self.is_complex else channels
        self.first = TokenLinear(tokenizer_widths, width)
        self.before = nn.ModuleList(nn.Linear(width, width) for _ in range(layers // 2 - 1))
        self.again = TokenLinear(tokenizer_widths, width, hidden=width)
        self.behind = nn.ModuleList(
            nn.Linear(width, width) for _ in range(layers - layers // 2 - 1)
        )
        self.rotation = nn.Linear(width, 4)
        self.scale = nn.Linear(width, 3)
        self.amplitude = nn.Linear(width, waves)
        self.phase = nn.Linear(width, waves)
        for head in (self.rotation, self.scale):
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)

    def forward(self, tokens: Tokens, placed: Placed, query: Query) -> Residuals:
        """Quaternions (b, n, 4), scales (b, n, 3) [m], signal (b, n, channels, 1)."""
        hidden = relu(self.first(tokens))
        for layer in self.before:
            hidden = relu(layer(hidden))
        hidden = relu(self.again(tokens, hidden))
        for layer in self.behind:
            hidden = relu(layer(hidden))
        return Residuals(self.rotation(hidden), self.scale(hidden), self.signal(hidden)[..., None])

    def signal(self, hidden: Tensor) -> Tensor:
        """The waves' residuals (b, n, channels)."""
        amplitudes = self.amplitude(hidden)
        phases = self.phase(hidden)
        real = amplitudes * phases.cos()
        if not self.is_complex:
            return real
        return torch.cat((real, amplitudes * phases.sin()), -1)
