"""Grids and lists of rays: unit vectors against numpy, solid angles against integrals."""

import math

import numpy as np
import pytest
import torch

from gaigs.core.geometry import Grid, Rays

GRID = Grid.degrees(range(5, 90, 10), range(0, 360, 30))


def test_the_default_is_the_grid_of_the_nerf2_spectra():
    grid = Grid.degrees()
    assert grid.shape == (90, 360)
    np.testing.assert_allclose(grid.elevations, np.radians(np.arange(1, 91)), rtol=1e-6)
    np.testing.assert_allclose(grid.azimuths, np.radians(np.arange(360)), rtol=1e-6)
    assert grid.pitch == pytest.approx(math.radians(1), rel=1e-6)


def test_vectors_are_those_of_spherical_coordinates():
    elevations, azimuths = (
        GRID.elevations.double().numpy()[:, None],
        GRID.azimuths.double().numpy()[None],
    )
    x, y = np.cos(elevations) * np.cos(azimuths), np.cos(elevations) * np.sin(azimuths)
    expected = np.stack(np.broadcast_arrays(x, y, np.sin(elevations)), -1)
    np.testing.assert_allclose(GRID.vectors(), expected, atol=1e-6)
    assert GRID.vectors().shape == (*GRID.shape, 3)


def test_pixels_in_a_list_run_row_by_row():
    rays = GRID.flatten()
    assert isinstance(rays, Rays)
    assert rays.shape == (9 * 12,)
    torch.testing.assert_close(rays.vectors(), GRID.vectors().flatten(0, 1))
    assert rays.flatten() is rays
    for row, column in ((0, 0), (0, 11), (3, 5), (8, 11)):
        number = row * 12 + column
        assert rays.elevations[number] == GRID.elevations[row]
        assert rays.azimuths[number] == GRID.azimuths[column]


def test_a_thinned_grid_has_its_rows_and_columns():
    thin = GRID.thin(slice(1, None, 3), slice(2, None, 5))
    assert thin.shape == (3, 2)
    torch.testing.assert_close(thin.vectors(), GRID.vectors()[1::3, 2::5])
    assert thin.pitch == pytest.approx(3 * GRID.pitch, rel=1e-6)


@pytest.mark.parametrize("directions", [GRID, GRID.flatten()], ids=["grid", "rays"])
def test_directions_go_to_another_dtype_and_device(directions):
    moved = directions.to(torch.zeros(1, dtype=torch.float64, device="meta"))
    assert type(moved) is type(directions)
    assert moved.elevations.dtype == moved.azimuths.dtype == torch.float64
    assert moved.elevations.device.type == moved.azimuths.device.type == "meta"


@pytest.mark.parametrize("turned", [False, True])
def test_solid_angles_are_the_integrals_of_the_rows(turned):
    """A row of 10 degrees at elevation e spans sin(e + 5 deg) - sin(e - 5 deg), in proportion to
    cos e.
    """
    grid = Grid(GRID.elevations.flip(0), GRID.azimuths) if turned else GRID
    shares = grid.solid_angles
    assert shares.shape == grid.shape
    assert shares.sum().item() == pytest.approx(1)
    expected = np.cos(grid.elevations.numpy())[:, None] * np.ones(12)
    np.testing.assert_allclose(shares * expected.sum(), expected, atol=0.025)


@pytest.mark.parametrize(("rows", "columns"), [(2, 3), (4, 8), (7, 5), (40, 6)])
def test_pixels_of_a_sphere_are_of_equal_solid_angle(rows, columns):
    grid = Grid.sphere(rows, columns)
    assert grid.shape == (rows, columns)
    shares = grid.solid_angles
    torch.testing.assert_close(
        shares, torch.full_like(shares, 1 / (rows * columns)), rtol=1e-5, atol=0
    )
    vectors = grid.vectors().double().flatten(0, 1)
    np.testing.assert_allclose(vectors.mean(0), 0, atol=1e-6)
    # The mean square along any axis of a sphere is 1/3; along z rows of equal width in height miss
    # rows^-2 of it.
    height = (1 - rows**-2) / 3
    np.testing.assert_allclose(
        vectors.square().mean(0), [(1 - height) / 2, (1 - height) / 2, height], atol=1e-6
    )


def test_grids_of_too_few_pixels_are_refused():
    for rows, columns in ((1, 8), (4, 2)):
        with pytest.raises(
            ValueError, match=f"at least 2 rows and 3 columns, got {rows} x {columns}"
        ):
            Grid.sphere(rows, columns)
    with pytest.raises(ValueError, match="take at least 2 rows, got 1"):
        _ = Grid(torch.zeros(1), torch.zeros(4)).solid_angles
