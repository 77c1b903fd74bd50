"""A network whose input is the transmitter only; each Gaussian weights its output features."""

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.registry import register
from gaigs.splatting.deformation import Deformation, Residuals
from gaigs.splatting.deformation.two_branch import ResidualLayer, TokenLinear
from gaigs.splatting.gaussians import Placed, Tokens


@register("deformation", "basis")
class Basis(Deformation):
    """Residuals of signal and opacity as sums of features of the transmitter.

    A network F computes features h = F(E(P_TX), CLS) from a transmitter's tokens. The residual of
    Gaussian n is w_n h, with trainable weights w_n. The network runs once for each transmitter
    instead of each pair of a transmitter and a Gaussian, which divides its cost by the number of
    Gaussians.

    Args:
        scene: The number of its training places sets the width.
        count: Number of Gaussians.
        tokenizer_widths: Widths of (scene, gaussians, transmitters) in the tokens. Tokens of
            Gaussians are not used.
        channels: Signal channels of a Gaussian.
        width: Width of the network; None: ``suitable_width`` of the training places.
        layers: Residual layers after the first layer.

    Attributes:
        weights: w_n (n, channels + 1, width), for the signal's channels, then the opacity.

    Raises:
        ValueError: An option is out of range, or the number of Gaussians is not fixed.

    Source: ours, instead of GAI-GS, "Scene Mapping Network", eq. (11) and (12). The form is
    DeepONet's (Lu et al., 2021) with free weights instead of its branch network.
    """

    follows = ("weights",)

    def __init__(
        self,
        scene: Scene,
        count: int | None,
        tokenizer_widths: tuple[int, int, int],
        channels: int,
        width: int | None = None,
        layers: int = 3,
    ):
        super().__init__()
        if count is None:
            raise ValueError(
                "deformation 'basis' has weights for each free Gaussian, and placements with "
                "Gaussians of their own change the number; set deformation=two_branch or none"
            )
        width = suitable_width(scene.places) if width is None else width
        for option, value, least in (("width", width, 1), ("layers", layers, 0)):
            if value < least:
                raise ValueError(f"deformation.{option} must be at least {least}, got {value}")
        # Wide networks diverge at the rates of narrow ones; chosen with the widths.
        self.learning_rate = 2.0 / width
        on_scene, _, on_transmitter = tokenizer_widths
        self.first = TokenLinear((on_scene, 0, on_transmitter), width)
        self.rest = nn.Sequential(*(ResidualLayer(width) for _ in range(layers)))
        self.weights = nn.Parameter(torch.empty(count, channels + 1, width))
        nn.init.uniform_(self.weights, -(width**-0.5), width**-0.5)
        # As in ``two_branch`` the opacity starts without a residual.
        nn.init.zeros_(self.weights[:, -1])

    def forward(self, tokens: Tokens, placed: Placed, query: Query) -> Residuals:
        # One empty token in place of the Gaussians' tokens: one row of features a transmitter.
        no_gaussians = tokens._replace(gaussians=tokens.transmitters.new_zeros(1, 0))
        first = functional.gelu(self.first(no_gaussians)).squeeze(1)  # (b, width)
        features = self.rest(first)  # h, (b, width)
        residuals = functional.linear(features, self.weights.flatten(0, 1))  # w_n h
        residuals = residuals.unflatten(1, self.weights.shape[:2])  # (b, n, channels + 1)
        return Residuals(delta_signal=residuals[..., :-1, None], delta_opacities=residuals[..., -1])

    def _load_from_state_dict(self, state_dict, prefix, *args):
        """Takes the checkpoint's number of Gaussians, which density control may have changed."""
        weights: Float[Tensor, "n outputs width"] | None = state_dict.get(f"{prefix}weights")
        if weights is not None and len(weights) != len(self.weights):
            new = self.weights.new_empty(len(weights), *self.weights.shape[1:])
            self.weights = nn.Parameter(new, self.weights.requires_grad)
        super()._load_from_state_dict(state_dict, prefix, *args)


def suitable_width(places: int) -> int:
    """Width of the network for this number of training places.

    The rule was chosen on validation links of sets of 42, 252 and 4,408 places (docs/results.md).
    """
    if places < 100:
        return 128
    return 256 if places < 1000 else 512
