"""RSSI as GSRF reads it: the mean amplitude over all directions."""

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.core.geometry import Directions, magnitudes
from gaigs.core.query import Query
from gaigs.data import Links
from gaigs.splatting.pooling import Pooling, sphere

RANGE = 100.0
"""An amplitude of 0 is -100 dBm, one of 1 is 0 dBm, as NeRF² scales its readings [dB]."""


class MeanAmplitude(Pooling):
    """100 (mean |C_0 + j C_1| - 1) [dBm], the mean over the grid.

    Args:
        grid: Rows and columns of the map over the full sphere, ``Grid.sphere``, whose pixels have
            equal solid angles.

    Source: GSRF (NeurIPS 2025); the scale of NeRF² (MobiCom 2023).
    """

    channels = 2

    def __init__(self, grid: list[int]):
        super().__init__()
        self.grid = sphere("pooling.grid", grid)

    def fit(self, links: Links) -> None:
        """Checks that the training labels can be predicted.

        Raises:
            ValueError: A label is at -100 dBm or below, where no amplitude is.
        """
        least = links.labels[links.split.train].min().item()
        if least <= -RANGE:
            raise ValueError(
                "pooling 'mean_amplitude' gives levels above -100 dBm, and a training label is "
                f"{least:.6g} dBm; leave such readings out, or take another pooling"
            )

    def forward(
        self,
        image: Float[Tensor, "b 2 rows columns"],
        query: Query,
        directions: Directions | None = None,
    ) -> Float[Tensor, " b"]:
        """Levels [dBm], in single precision at least; the gradient of a pixel of 0 is 0."""
        image = image.to(torch.promote_types(image.dtype, torch.float32))
        amplitudes = magnitudes(torch.complex(*image.unbind(1)))  # (b, rows, columns)
        return RANGE * (amplitudes.mean((1, 2)) - 1)
