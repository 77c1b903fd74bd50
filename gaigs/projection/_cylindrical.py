"""What the projections whose u is the azimuth share."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.geometry import to_spherical
from gaigs.projection import Plane, Projection


class Cylindrical(Projection):
    """u = azimuth, with period 2 pi, and v = f(elevation).

    Args:
        pixel: See ``Projection`` [rad].
        limit_deg: Elevations are clamped to this absolute value [deg], in (0, 90): at the pole the azimuth of a small
            step diverges as 1 / cos(elevation), and here it stops growing.
    """

    def __init__(self, pixel: float, limit_deg: float):
        super().__init__(pixel)
        if not 0 < limit_deg < 90:
            raise ValueError(f"limit_deg must lie between 0 and 90 degrees, got {limit_deg}")
        self.limit = math.radians(limit_deg)

    def stretch(self, elevations: Tensor) -> tuple[Tensor, Tensor]:
        """v and dv/d(elevation) at elevations [rad] within the limit."""
        raise NotImplementedError

    def coordinates(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        x, y, z = points.unbind(-1)
        v, _ = self.stretch(torch.atan2(z, self._horizontal(points)).clamp(-self.limit, self.limit))
        return torch.stack((torch.atan2(y, x), v), -1)

    def jacobian(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
        x, y, z = points.unbind(-1)
        square = (points * points).sum(-1)
        horizontal = self._horizontal(points)
        _, slope = self.stretch(torch.atan2(z, horizontal).clamp(-self.limit, self.limit))
        # d azimuth = (-y, x, 0) / rho²  and  d elevation = (-z x / rho, -z y / rho, rho) / r²
        azimuth = torch.stack((-y, x, torch.zeros_like(x)), -1) / horizontal.square()[..., None]
        elevation = torch.stack((-z * x / horizontal, -z * y / horizontal, horizontal), -1) / square[..., None]
        return torch.stack((azimuth, slope[..., None] * elevation), -2)

    def plane(self, elevations: Float[Tensor, "rows"], azimuths: Float[Tensor, "columns"]) -> Plane:
        v, _ = self.stretch(elevations.clamp(-self.limit, self.limit))
        return Plane(azimuths[None, :], v[:, None], 2 * math.pi)

    def _horizontal(self, points: Tensor) -> Tensor:
        """Distance from the pole's axis, not below that of the elevation limit."""
        x, y, _ = points.unbind(-1)
        least = math.cos(self.limit) ** 2 * (points * points).sum(-1)
        return torch.maximum(x * x + y * y, least).sqrt()
