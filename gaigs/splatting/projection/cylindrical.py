"""Base of projections whose u is the azimuth."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.core.geometry import Directions, Grid, to_spherical
from gaigs.splatting.projection import Plane, Projection


class Cylindrical(Projection):
    """u = azimuth, with period 2 pi, and v = f(elevation).

    Args:
        pixel: As for ``Projection`` [rad].
        limit_deg: Largest absolute elevation [deg], in (0, 90); higher elevations are clamped. Near
            the pole the azimuth of a small step diverges as 1 / cos(elevation).
    """

    period = 2 * math.pi

    def __init__(self, pixel: float, limit_deg: float):
        super().__init__(pixel)
        if not 0 < limit_deg < 90:
            raise ValueError(f"limit_deg must lie between 0 and 90 degrees, got {limit_deg}")
        self.limit = math.radians(limit_deg)

    def stretch(self, elevations: Tensor) -> tuple[Tensor, Tensor]:
        """v and dv/d(elevation) at elevations [rad] within the limit."""
        raise NotImplementedError

    def coordinates(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        azimuths, elevations, _ = to_spherical(points)
        v, _ = self.stretch(elevations.clamp(-self.limit, self.limit))
        return torch.stack((azimuths, v), -1)

    def jacobian(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
        azimuths, elevations, distances = to_spherical(points)  # (...) each
        clamped = elevations.clamp(-self.limit, self.limit)
        _, slope = self.stretch(clamped)
        # Unit vectors of growing azimuth (east) and of growing elevation (north).
        sin, cos = torch.sin(azimuths), torch.cos(azimuths)
        east = torch.stack((-sin, cos, torch.zeros_like(sin)), -1)  # (..., 3)
        height, horizontal = torch.sin(elevations), torch.cos(elevations)
        north = torch.stack((-height * cos, -height * sin, horizontal), -1)  # (..., 3)
        # Gradients of u and v [1/m]: east / (r cos el) and f'(el) north / r, at the distance r.
        rates = torch.stack((1 / torch.cos(clamped), slope), -1) / distances[..., None]  # (..., 2)
        return rates[..., None] * torch.stack((east, north), -2)  # (..., 2, 3)

    def plane(self, directions: Directions) -> Plane:
        """Plane coordinates; u and v of a grid are separable."""
        v, _ = self.stretch(directions.elevations.clamp(-self.limit, self.limit))
        v = v[:, None] if isinstance(directions, Grid) else v[None]  # (rows, 1) or (1, k)
        return Plane(directions.azimuths[None], v, self.period)
