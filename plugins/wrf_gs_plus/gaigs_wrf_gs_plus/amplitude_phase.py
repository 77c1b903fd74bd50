"""WRF-GS+'s deformation network: shape, and a wave's amplitude and phase."""

import torch
from torch import Tensor, nn
from torch.nn.functional import relu

from gaigs.core.query import Query
from gaigs.splatting.deformation import Deformation, Residuals
from gaigs.splatting.deformation.two_branch import TokenLinear
from gaigs.splatting.gaussians import Placed, Tokens


class AmplitudePhase(Deformation):
    """Change by a transmitter of every Gaussian's rotation, scale and signal.

    Network: u = [E(P_x), E(P_TX), CLS] -> layers of one width with ReLU, u is fed into the middle
    one again. Linear heads from its end: rotation and scale, 0 at the start; amplitude a and phase
    phi of each wave. A wave is a pair of channels, real and imaginary part, and its residual a
    exp(j phi); of a map with an odd number of channels, which are real, the real part of each wave
    counts.

    Published is |a exp(j phi)|, in which the phase cancels.

    Args:
        channels: Signal channels of a Gaussian: all real parts before all imaginary ones.
        tokenizer_widths: Widths of (scene, gaussians, transmitters) in the tokens.
        width: Of the layers.
        layers: Their number.

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
        self.rotation, self.scale = nn.Linear(width, 4), nn.Linear(width, 3)
        self.amplitude, self.phase = nn.Linear(width, waves), nn.Linear(width, waves)
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
        amplitudes, phases = self.amplitude(hidden), self.phase(hidden)
        real = amplitudes * phases.cos()
        return torch.cat((real, amplitudes * phases.sin()), -1) if self.is_complex else real
