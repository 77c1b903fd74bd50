"""The spatial spectrum: the map's magnitude."""

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.core.geometry import Directions, magnitudes
from gaigs.core.query import Query
from gaigs.registry import register
from gaigs.splatting.pooling import Pooling


@register("pooling", "spectrum")
class SpectrumPooling(Pooling):
    """The magnitude of a map, |C_0| for one channel C_0 or |C_0 + j C_1| for two.

    Channels are signed, so that paths can cancel.

    Args:
        channels: 1 (real) or 2 (complex).

    Raises:
        ValueError: The number of channels is neither 1 nor 2.

    Source: GAI-GS, eq. (14), where R_k is the map; channels and magnitude are ours.
    """

    def __init__(self, channels: int = 2):
        super().__init__()
        if channels not in (1, 2):
            raise ValueError(
                f"pooling 'spectrum' renders 1 real or 2 complex channels, got channels={channels}"
            )
        self.channels = channels

    def forward(
        self,
        image: Float[Tensor, "b c rows columns"],
        query: Query,
        directions: Directions | None = None,
    ) -> Float[Tensor, "b rows columns"]:
        """The predicted spectrum, with a gradient of 0 where the map is 0."""
        if self.channels == 1:
            return image[:, 0].abs()
        real, imaginary = image.unbind(1)
        return magnitudes(torch.complex(real, imaginary))
