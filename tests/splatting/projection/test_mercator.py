import math

import numpy as np
import pytest
import torch

from gaigs.core.geometry import Grid, Pose, from_spherical
from gaigs.splatting.projection.mercator import Mercator

HERE = Pose(torch.zeros(3), torch.eye(3))


@pytest.mark.parametrize("limit", [60.0, 85.0511287798066, 89.0])
def test_it_is_the_papers_logarithm_scaled_to_the_limit(limit):
    degrees = np.linspace(-limit, limit, 41)[1:-1]
    azimuths = torch.linspace(-3, 3, 39, dtype=torch.float64)
    points = 2 * from_spherical(azimuths, torch.from_numpy(degrees).deg2rad())
    u, v = Mercator(0.01, limit).coordinates(points).unbind(-1)

    def paper(elevation):
        return np.log(np.tan(np.pi / 4 + np.radians(elevation) / 2))

    torch.testing.assert_close(u, azimuths)
    np.testing.assert_allclose(v, np.pi * paper(degrees) / paper(limit), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("limit", [60.0, 85.0511287798066, 89.0])
def test_the_plane_is_as_high_as_it_is_wide(limit):
    elevations = torch.tensor([-90, -limit, 0, limit, 90], dtype=torch.float64).deg2rad()
    plane = Mercator(0.01, limit).plane(Grid(elevations, torch.zeros(1)))
    torch.testing.assert_close(
        plane.v.flatten(), torch.tensor([-1, -1, 0, 1, 1], dtype=torch.float64) * math.pi
    )
    assert plane.period == 2 * math.pi


def test_a_small_round_gaussian_stays_round_anywhere():
    """At the default limit, where alpha is 1; its width grows as 1 / cos(elevation) up to the
    limit.
    """
    assert Mercator(0.01).alpha == pytest.approx(1, abs=1e-12)
    azimuths, elevations = torch.meshgrid(
        torch.linspace(-math.pi, math.pi, 13, dtype=torch.float64),
        torch.tensor(
            [-90, -89.9, -70, -1, 0, 30, 60, 85, 85.1, 87, 89.99, 90], dtype=torch.float64
        ).deg2rad(),
        indexing="ij",
    )
    points = (5 * from_spherical(azimuths, elevations)).flatten(0, 1)
    semi_axes = (0.01 * torch.eye(3, dtype=torch.float64)).expand(1, len(points), 3, 3)
    footprints = Mercator(1e-9).project(points, semi_axes, HERE).covariances2d[0]
    least = math.cos(math.atan(math.sinh(math.pi)))
    widths = 0.01 / 5 / elevations.cos().clamp_min(least).flatten()
    torch.testing.assert_close(
        footprints, widths.square()[:, None, None] * torch.eye(2, dtype=torch.float64)
    )
