"""The plate carrée plane."""

import torch
from torch import Tensor

from gaigs.registry import register
from gaigs.splatting.projection.cylindrical import Cylindrical


@register("projection", "equirectangular")
class Equirectangular(Cylindrical):
    """u = azimuth, v = elevation; options as for ``Cylindrical``."""

    def __init__(self, pixel: float, limit_deg: float = 89.5):
        super().__init__(pixel, limit_deg)

    def stretch(self, elevations: Tensor) -> tuple[Tensor, Tensor]:
        return elevations, torch.ones_like(elevations)
