"""Spectra as WRF-GS reads them: the map within the range of a label."""

from jaxtyping import Float
from torch import Tensor

from gaigs.directions import Directions
from gaigs.pooling.spectrum import Spectrum
from gaigs.query import Query


class Clamped(Spectrum):
    """C_0, or |C_0 + j C_1|, clamped to 0..1; where it is beyond, the gradient is 0.

    Args:
        channels: 1 (real) or 2 (complex).

    Source: WRF-GS (INFOCOM 2025), which renders one.
    """

    def forward(
        self, image: Float[Tensor, "b c rows columns"], query: Query, directions: Directions | None = None
    ) -> Float[Tensor, "b rows columns"]:
        """The predicted spectrum."""
        spectrum = image[:, 0] if self.channels == 1 else super().forward(image, query, directions)
        return spectrum.clamp(0, 1)
