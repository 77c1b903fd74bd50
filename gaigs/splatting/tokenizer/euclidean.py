"""A tokenizer of Fourier features of positions, without a scene token."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.registry import register
from gaigs.splatting.gaussians import Placed, Tokens

MAX_OCTAVE = 30
"""Bound of octaves: float32 resolves no positions in waves of a nanometre or a million km."""

BAND_FREQUENCIES = math.pi * 2.0 ** torch.arange(-1, 3)
"""Angular frequencies for the carrier's position in the band, -1 to 1.

Their periods are from twice the band to a quarter of it.
"""


@register("tokenizer", "euclidean")
class EuclideanTokenizer(nn.Module):
    """Position embeddings E(P_x) and E(P_TX), and no scene token.

    E(P_x) are Fourier features of the Gaussian's centre. E(P_TX) are Fourier features of the
    transmitter after a two-layer network. For data with several carriers the network also gets the
    carrier's position in the band.

    Args:
        scene: Positions of Gaussians and transmitters are relative to the middles of the receivers
            and of the transmitters' box.
        gaussian_octaves: Lowest and highest octave k of the Gaussians' features, 2^k cycles a
            metre.
        transmitter_octaves: Octaves of the transmitter's features; None: ``learnable_octaves``.
        hidden: Width of the transmitter network's hidden layer.
        width: Width of E(P_TX). If ``hidden`` and ``width`` are None, there is no network, and
            E(P_TX) are the features themselves.

    Raises:
        ValueError: One of ``hidden`` and ``width`` is None, or a number is out of range.

    Source: GAI-GS, "Multi-view Tokenizer", eq. (10); Tancik et al., Fourier Features, 2020.
    """

    scene_width = 0
    receivers_middle: Tensor
    transmitters_middle: Tensor
    gaussian_frequencies: Tensor
    transmitter_frequencies: Tensor

    def __init__(
        self,
        scene: Scene,
        gaussian_octaves: Sequence[int] = (-3, 2),
        transmitter_octaves: Sequence[int] | None = None,
        hidden: int | None = 256,
        width: int | None = 64,
    ):
        super().__init__()
        given = [count for count in (hidden, width) if count is not None]
        if len(given) == 1 or min(given, default=1) < 1:
            raise ValueError(
                "tokenizer options hidden and width must both be given, at least 1, or be null, "
                f"got {hidden}, {width}"
            )
        self.scene = scene
        self.register_buffer("receivers_middle", scene.positions(scene.lower).mean(0))
        self.register_buffer("transmitters_middle", (scene.lower + scene.upper) / 2)
        limits = {
            "gaussian": gaussian_octaves,
            "transmitter": transmitter_octaves or learnable_octaves(scene),
        }
        for name, pair in limits.items():
            frequencies = octaves(f"tokenizer option {name}_octaves", *pair)
            self.register_buffer(f"{name}_frequencies", frequencies)
        self.gaussian_width = 3 * (1 + 2 * len(self.gaussian_frequencies))
        features = 3 * (1 + 2 * len(self.transmitter_frequencies))
        if scene.has_band:
            features += 1 + 2 * len(BAND_FREQUENCIES)
        self.transmitter_width = features if width is None else width
        self.network: nn.Module = nn.Identity()
        if hidden is not None and width is not None:
            self.network = nn.Sequential(
                nn.Linear(features, hidden), nn.GELU(), nn.Linear(hidden, width)
            )

    def forward(self, placed: Placed, opacities: Float[Tensor, " n"], query: Query) -> Tokens:
        # Features are computed once if the Gaussians are at the same places for all queries.
        means = placed.means[0] if len(placed.means) == 1 else placed.means  # ([b,] n, 3)
        gaussians = fourier_features(means - self.receivers_middle, self.gaussian_frequencies)
        transmitters = query.transmitters - self.transmitters_middle  # (b, 3)
        features = fourier_features(transmitters, self.transmitter_frequencies)
        if self.scene.has_band:
            positions = self.scene.band_positions(query)[:, None]  # (b, 1), from -1 to 1
            band = fourier_features(positions, BAND_FREQUENCIES.to(features))
            features = torch.cat((features, band), 1)
        no_scene = features.new_zeros(len(query), 0)
        return Tokens(no_scene, gaussians, self.network(features))


def learnable_octaves(scene: Scene) -> tuple[int, int]:
    """Lowest and highest octave of the transmitter's features that suit the training transmitters.

    An octave k has 2^k cycles a metre. Periods range from twice the box's longest edge to 16
    distances between neighbouring transmitters. The output of the network has multiples of its
    input frequencies, so input frequencies must be well below the sampling limit. Periods for noisy
    labels are at least 16 m, since shorter ones would fit noise; the network's multiples can still
    form a sharp shadow.
    """
    shortest_period = 16  # in distances; chosen on validation parts of rfid-s23-200 and the room
    highest = min(round(-math.log2(shortest_period * scene.spacing)), MAX_OCTAVE)
    if scene.task.is_noisy:
        # 2^4 m: chosen by leaving out one of the robot's training runs in ble-flat.
        highest = min(highest, -4)
    edge = (scene.upper - scene.lower).max().item()  # [m]
    return min(highest, math.floor(-math.log2(2 * edge))), highest


def octaves(option: str, *limits: int) -> Float[Tensor, " octaves"]:
    """Angular frequencies 2 pi 2^k [rad/m] for k from the lowest to the highest limit.

    Args:
        option: Name of the option with the limits, for errors.
        limits: Lowest and highest k.

    Raises:
        ValueError: There are not two limits in ascending order, or they are out of range.
    """
    if len(limits) != 2 or not -MAX_OCTAVE <= limits[0] <= limits[1] <= MAX_OCTAVE:
        bounds = f"{-MAX_OCTAVE}..{MAX_OCTAVE}"
        raise ValueError(f"{option} must be [lowest, highest] within {bounds}, got {list(limits)}")
    return 2 * math.pi * 2.0 ** torch.arange(limits[0], limits[1] + 1)


def fourier_features(
    points: Float[Tensor, "*batch d"], frequencies: Float[Tensor, " octaves"]
) -> Float[Tensor, "*batch features"]:
    """[x, sin(w x), cos(w x)] for every coordinate x [m] and angular frequency w [rad/m].

    Each point has d (1 + 2 octaves) numbers.

    Source: Tancik et al., Fourier Features, 2020.

    Example:
        >>> from gaigs.splatting.tokenizer.euclidean import fourier_features, octaves
        >>> fourier_features(torch.zeros(5, 3), octaves("octaves", -1, 2)).shape
        torch.Size([5, 27])
    """
    phases = (points[..., None] * frequencies).flatten(-2)  # (..., d octaves) [rad]
    return torch.cat((points, phases.sin(), phases.cos()), -1)
