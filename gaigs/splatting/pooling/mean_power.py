"""RSSI by physics: the total power from all directions."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.core.geometry import Directions
from gaigs.core.query import Query
from gaigs.registry import register
from gaigs.splatting.pooling import Pooling, sphere


@register("pooling", "mean_power")
class MeanPower(Pooling):
    """The mean power over all directions plus the power of the receiver's noise, in dB.

    The power of a pixel is |C_0|², or |C_0|² + |C_1|², eq. (3). RSSI is averaged over bandwidth and
    time, so powers add and paths do not cancel. The noise is independent of the arriving power: an
    empty map gives the noise floor, with a gradient of 0.

    Args:
        grid: Rows and columns of the map over the full sphere, ``Grid.sphere``.
        channels: 1 (real) or 2 (complex).
        floor_db: Power of the noise relative to the model's trend, between -300 and 0 [dB].

    Raises:
        ValueError: An option is out of range, or a map has another number of pixels.

    Source: GAI-GS, eq. (3), for the level; the noise is ours.
    """

    weights: Tensor

    def __init__(self, grid: Sequence[int] = (4, 8), channels: int = 2, floor_db: float = -60.0):
        super().__init__()
        if channels not in (1, 2):
            raise ValueError(
                "pooling 'mean_power' renders 1 real or 2 complex channels, "
                f"got channels={channels}"
            )
        self.channels = channels
        self.floor = noise_amplitude(floor_db)
        self.grid = sphere("pooling.grid", grid)
        self.register_buffer("weights", self.grid.solid_angles, persistent=False)

    def forward(
        self,
        image: Float[Tensor, "b c rows columns"],
        query: Query,
        directions: Directions | None = None,
    ) -> Float[Tensor, " b"]:
        """Level relative to the model's trend [dB]; float32 for a map of half precision."""
        pixels = tuple(image.shape[2:])
        if pixels != tuple(self.weights.shape):
            raise ValueError(f"maps must have {tuple(self.weights.shape)} pixels, got {pixels}")
        image = image.to(torch.promote_types(image.dtype, torch.float32))
        # Scaled by the largest amplitude, squares neither overflow nor underflow.
        largest = image.detach().abs().amax((1, 2, 3)).clamp(min=self.floor)  # (b,)
        powers = (image / largest[:, None, None, None]).square().sum(1)  # (b, rows, columns)
        power = powers.mul(self.weights).sum((1, 2))  # (b,)
        noise = (self.floor / largest).square()
        return 20 * largest.log10() + 10 * (power + noise).log10()


def noise_amplitude(floor_db: float) -> float:
    """Amplitude of a receiver's noise from its level [dB]; a ``ValueError`` if out of range."""
    if not -300 <= floor_db <= 0:
        raise ValueError(f"pooling option floor_db must lie between -300 and 0 dB, got {floor_db}")
    return 10 ** (floor_db / 20)
