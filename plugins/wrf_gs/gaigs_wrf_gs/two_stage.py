"""NeRF²'s two-stage network, asked at the Gaussians' centres."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn.functional import relu

from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.splatting.deformation import Deformation, Residuals
from gaigs.splatting.deformation.two_branch import (
    INITIAL_ATTENUATION,
    LEAST_ATTENUATION,
    TokenLinear,
)
from gaigs.splatting.gaussians import Placed, Tokens
from gaigs.splatting.projection import NEAR
from gaigs.splatting.tokenizer.euclidean import MAX_OCTAVE, fourier_features


class TwoStage(Deformation):
    """Attenuation and signal of every Gaussian, for a transmitter and a receiver.

    The attenuation network has layers of one width with ReLU; its input E(P_x) joins its middle
    layer again. Two linear heads follow: the attenuation delta through a sigmoid, which starts as
    ``INITIAL_ATTENUATION``, and a feature. The signal network maps [feature, E(P_TX), CLS,
    PE(view)] -> width -> half of it, with ReLU -> the signal of each channel. The view is the unit
    vector from the receiver to the Gaussian. So attenuations are the same for all links, and
    signals depend on transmitter and receiver.

    Args:
        scene: Scene with the receivers' positions.
        channels: Number of signal channels of a Gaussian.
        tokenizer_widths: Widths of (scene, gaussians, transmitters) in the tokens.
        width: Width of the attenuation network, and of the signal network's first layer.
        layers: Number of the attenuation network's layers.
        view_octaves: L of PE(view), which has the angular frequencies 2^k for k = 0..L-1.

    Raises:
        ValueError: A size is out of range.

    Source: WRF-GS (INFOCOM 2025) after NeRF² (MobiCom 2023).
    """

    sees_receivers = True

    def __init__(
        self,
        scene: Scene,
        channels: int,
        tokenizer_widths: tuple[int, int, int],
        width: int,
        layers: int,
        view_octaves: int,
    ):
        super().__init__()
        for option, count, least in (
            ("width", width, 2),
            ("layers", layers, 2),
            ("view_octaves", view_octaves, 0),
        ):
            if count < least:
                raise ValueError(f"deformation.{option} must be at least {least}, got {count}")
        if view_octaves > MAX_OCTAVE:
            raise ValueError(
                f"deformation.view_octaves must be at most {MAX_OCTAVE}, got {view_octaves}"
            )
        self.scene = scene
        links, gaussians, transmitters = tokenizer_widths
        matter = 0, gaussians, 0
        self.first = TokenLinear(matter, width)
        self.again = TokenLinear(matter, width, hidden=width)
        self.before = nn.ModuleList(nn.Linear(width, width) for _ in range(layers // 2 - 1))
        self.behind = nn.ModuleList(
            nn.Linear(width, width) for _ in range(layers - layers // 2 - 1)
        )
        self.attenuation = nn.Linear(width, 1)
        self.feature = nn.Linear(width, width)
        self.register_buffer("view_frequencies", 2.0 ** torch.arange(view_octaves))
        view = 3 * (1 + 2 * view_octaves)
        self.signal_first = TokenLinear((links, width, transmitters), width, hidden=view)
        self.signal_second = nn.Linear(width, width // 2)
        self.signal = nn.Linear(width // 2, channels)
        nn.init.zeros_(self.attenuation.weight)
        logit = math.log(INITIAL_ATTENUATION / (1 - INITIAL_ATTENUATION))
        nn.init.constant_(self.attenuation.bias, logit)

    def forward(self, tokens: Tokens, placed: Placed, query: Query) -> Residuals:
        """Signal (b, n, channels, 1) and attenuations (b, n)."""
        b = len(query)
        n = placed.means.shape[1]
        # Gaussians that stand still have one row: attenuations are then computed once for all
        # queries.
        nobody = tokens.scene.new_zeros(1 if tokens.gaussians.ndim == 2 else b, 0)
        matter = Tokens(nobody, tokens.gaussians, nobody)
        hidden = relu(self.first(matter))
        for layer in self.before:
            hidden = relu(layer(hidden))
        hidden = relu(self.again(matter, hidden))
        for layer in self.behind:
            hidden = relu(layer(hidden))
        shares = self.attenuation(hidden)[..., 0].sigmoid()
        attenuations = LEAST_ATTENUATION + (1 - LEAST_ATTENUATION) * shares
        excited = tokens._replace(gaussians=self.feature(hidden))
        signal = relu(self.signal_first(excited, self.view(placed, query)))
        signal = self.signal(relu(self.signal_second(signal)))
        return Residuals(delta_signal=signal[..., None], attenuations=attenuations.expand(b, n))

    def view(self, placed: Placed, query: Query) -> Float[Tensor, "b n features"]:
        """PE of the unit vectors from each query's receiver to the Gaussians.

        A Gaussian on the receiver has the vector 0.
        """
        offsets = placed.means - self.scene.positions(placed.means)[query.receivers][:, None]
        directions = offsets / offsets.norm(dim=-1, keepdim=True).clamp(min=NEAR)
        return fourier_features(directions, self.view_frequencies)
