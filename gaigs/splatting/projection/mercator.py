"""The Mercator plane of the paper."""

import math

import torch
from torch import Tensor

from gaigs.registry import register
from gaigs.splatting.projection.cylindrical import Cylindrical


@register("projection", "mercator")
class Mercator(Cylindrical):
    """u = azimuth, v = alpha log tan(pi / 4 + elevation / 2).

    v is computed as alpha asinh(tan(elevation)), which is equal, and exact near the horizon. alpha
    maps the elevation limit to the plane's edge v = pi, so height and width of the plane are equal.
    At the default limit, atan(sinh(pi)) = 85.0511 degrees, alpha is 1 and the projection is
    conformal: small round Gaussians stay round everywhere. Options are as for ``Cylindrical``.

    Source: GAI-GS, "Projection and Render Module".
    """

    def __init__(self, pixel: float, limit_deg: float = 85.0511287798066):
        super().__init__(pixel, limit_deg)
        self.alpha = math.pi / math.asinh(math.tan(self.limit))

    def stretch(self, elevations: Tensor) -> tuple[Tensor, Tensor]:
        v = self.alpha * torch.asinh(torch.tan(elevations))
        return v, self.alpha / torch.cos(elevations)
