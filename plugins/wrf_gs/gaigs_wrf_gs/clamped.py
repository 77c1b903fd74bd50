"""Spectra as WRF-GS reads them: the map within the range of a label."""

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.core.geometry import Directions
from gaigs.core.query import Query
from gaigs.splatting.pooling.spectrum import SpectrumPooling


class _Clamp(torch.autograd.Function):
    """Clamps values to 0..1. Beyond, it passes gradients that lead back into the range.

    Without these, a map that starts below 0 everywhere would stay 0 for good.
    """

    @staticmethod
    def forward(ctx, values: Tensor) -> Tensor:
        ctx.save_for_backward(values)
        return values.clamp(0, 1)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> Tensor:
        (values,) = ctx.saved_tensors
        outwards = ((values < 0) & (gradient > 0)) | ((values > 1) & (gradient < 0))
        return gradient.masked_fill(outwards, 0)


class Clamped(SpectrumPooling):
    """Spectra C_0, or |C_0 + j C_1|, clamped to 0..1; beyond, gradients that lead back count.

    Args:
        channels: Number of channels C: 1 (real) or 2 (complex).

    Source: WRF-GS (INFOCOM 2025), which renders one channel.
    """

    def forward(
        self,
        image: Float[Tensor, "b c rows columns"],
        query: Query,
        directions: Directions | None = None,
    ) -> Float[Tensor, "b rows columns"]:
        """The predicted spectrum."""
        spectrum = image[:, 0] if self.channels == 1 else super().forward(image, query, directions)
        return _Clamp.apply(spectrum)
