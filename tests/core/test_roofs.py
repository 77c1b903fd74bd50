"""Roofs between the ends of a link: lengths, walls and edges against plane geometry and Fresnel's
integrals.
"""

import math

import numpy as np
import pytest
import torch
from scipy.special import fresnel

from gaigs.core.roofs import Building, knife_edge, obstruct, plan_grid, rasterize_roofs


def box(x0, y0, x1, y1, roof, *holes):
    corners = [np.array([[a, b], [c, b], [c, d], [a, d]], float) for a, b, c, d in holes]
    outline = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]], float)
    return Building([outline, *corners], roof)


def roofs_of(*buildings, cell=0.25):
    grid = plan_grid(np.array([0.0, -30.0]), np.array([100.0, 30.0]), cell)
    return rasterize_roofs(buildings, grid)


def slope(length, rise, cell=1.0):
    """Ground of 100 m to the side that rises along x, and its grid."""
    grid = plan_grid(np.array([0.0, -50.0]), np.array([length, 50.0]), cell)
    middles = (np.arange(grid.columns) + 0.5) * grid.cell
    return np.tile(np.float32(rise * middles), (grid.rows, 1)), grid


def between(roofs, start, end):
    ends = torch.tensor([start]), torch.tensor([end])
    return obstruct(roofs, *ends, wavelength=0.1)[0].tolist()


def test_the_approximation_is_near_the_integrals_of_fresnel():
    v = np.linspace(-0.7, 5, 50)
    sine, cosine = fresnel(v)
    exact = -20 * np.log10(np.hypot(1 - cosine - sine, cosine - sine) / 2)
    assert knife_edge(torch.tensor(v)).numpy() == pytest.approx(exact, abs=0.15)
    assert knife_edge(torch.tensor([-0.9])).item() == 0


def test_a_block_with_a_court():
    court = box(20, -10, 60, 10, 15.0, (30, -5, 50, 5))
    blocked, inside, walls, _ = between(roofs_of(court), [5.0, 0.0, 2.0], [95.0, 0.0, 2.0])
    assert (blocked, walls) == (1, 4)
    assert inside == pytest.approx(20, abs=0.6)


def test_only_the_part_of_a_slanted_path_below_the_roof_counts():
    tall = box(20, -10, 60, 10, 10.0)
    _, inside, walls, _ = between(roofs_of(tall), [0.0, 0.0, 20.0], [100.0, 0.0, 0.0])
    # The path comes below 10 m at x = 50, and leaves through the wall at x = 60.
    assert inside == pytest.approx(10 * math.hypot(1, 0.2), abs=0.6)
    assert walls == 2


def test_one_edge_between_the_ends_has_its_own_loss():
    blocked, _, _, loss = between(
        roofs_of(box(49.9, -9, 50.1, 9, 20.0), cell=0.1), [0.0, 0.0, 10.0], [100.0, 0.0, 2.0]
    )
    v = (20 - 6) * math.sqrt(2 / 0.1 * (1 / 50 + 1 / 50))
    edge = 6.9 + 20 * math.log10(math.hypot(v - 0.1, 1) + v - 0.1)
    assert blocked == 1
    assert loss == pytest.approx(edge + (1 - math.exp(-edge / 6)) * 10, abs=0.05)


def test_a_clear_path_far_above_has_no_loss_and_a_grazing_one_half_of_the_field():
    roofs = roofs_of(box(40, -9, 60, 9, 10.0))
    assert between(roofs, [0.0, 0.0, 40.0], [100.0, 0.0, 40.0]) == [0, 0, 0, 0]
    blocked, _, _, loss = between(roofs, [0.0, 0.0, 10.01], [100.0, 0.0, 10.01])
    edge = 20 * math.log10(2)
    assert blocked == 0
    assert loss == pytest.approx(edge + (1 - math.exp(-edge / 6)) * 10, abs=0.2)


def test_an_antenna_at_a_wall_and_paths_beyond_the_map_are_clear():
    roofs = roofs_of(box(20, -10, 60, 10, 15.0))
    assert between(roofs, [60.1, 0.0, 5.0], [95.0, 0.0, 2.0])[:3] == [0, 0, 0]
    assert between(roofs, [500.0, 0.0, 5.0], [900.0, 40.0, 2.0])[:3] == [0, 0, 0]
    assert between(roofs, [70.0, 0.0, 5.0], [70.0, 0.0, 2.0])[:3] == [0, 0, 0]


def test_large_sites_get_larger_cells():
    grid = plan_grid(np.array([0.0, -50.0]), np.array([100.0, 50.0]), most=100)
    roofs = rasterize_roofs([box(20, -10, 60, 10, 15.0)], grid)
    assert roofs.cell == 10
    assert (roofs.heights == 15).sum() == 8


def test_many_links_are_computed_in_parts():
    roofs = roofs_of(box(20, -10, 60, 10, 15.0))
    draw = torch.Generator().manual_seed(0)
    starts, ends = 90 * torch.rand(2, 50, 3, generator=draw)
    whole = obstruct(roofs, starts, ends, 0.1)
    parts = obstruct(roofs, starts, ends, 0.1, most=1000)
    assert whole[:, 0].any()
    # A part's longest path sets its samples, so lengths differ by a cell.
    torch.testing.assert_close(parts[:, 1], whole[:, 1], rtol=0, atol=0.5)


def test_a_ridge_has_the_loss_of_its_edge_and_blocks_no_path_as_a_roof():
    ground, grid = slope(100.0, 0.0, cell=0.1)
    ground[:, 499:501] = 20.0
    blocked, inside, walls, loss = between(
        rasterize_roofs([], grid, ground), [0.0, 0.0, 10.0], [100.0, 0.0, 2.0]
    )
    v = (20 - 6) * math.sqrt(2 / 0.1 * (1 / 50 + 1 / 50))
    edge = 6.9 + 20 * math.log10(math.hypot(v - 0.1, 1) + v - 0.1)
    assert (blocked, inside, walls) == (0, 0, 0)
    assert loss == pytest.approx(edge + (1 - math.exp(-edge / 6)) * 10, abs=0.05)


def test_ground_is_linear_between_cells_and_level_beyond_the_margin():
    ground, grid = slope(100.0, 0.5, cell=10.0)
    roofs = rasterize_roofs([], grid, ground)
    points = torch.tensor([[7.0, 3.0, 0.0], [83.0, -41.0, 9.0], [-500.0, 0.0, 0.0]])
    assert roofs.ground_at(points).tolist() == pytest.approx([3.5, 41.5, 2.5], abs=1e-4)


def test_a_slope_obstructs_no_path_between_ends_above_it():
    ground, grid = slope(3000.0, 0.4, cell=30.0)
    roofs = rasterize_roofs([], grid, ground)
    ends = torch.tensor([[100.0, 0.0, 10.0], [1333.0, 11.0, 1.5], [2900.0, -7.0, 40.0]])
    ends[:, 2] += roofs.ground_at(ends)
    loss = obstruct(roofs, ends[[0, 0, 2]], ends[[1, 2, 0]], wavelength=0.15)[:, 3]
    assert (loss < 3).all()  # the slope lies below the path: some of Fresnel's zone alone


def test_a_building_stands_on_the_ground_or_on_its_own():
    ground, grid = slope(100.0, 0.5)
    own = box(70, -10, 80, 10, 6.0)._replace(ground=3.0)
    heights = rasterize_roofs([box(20, -10, 40, 10, 6.0), own], grid, ground).heights
    assert heights[50, 30].item() == pytest.approx(15 + 6)
    assert heights[50, 75].item() == pytest.approx(3 + 6)


def test_the_earth_rises_between_distant_ends():
    ground, grid = slope(30000.0, 0.0, cell=10.0)
    roofs = rasterize_roofs([], grid, ground)
    edge = 15000**2 / 2 / 8.5e6  # 13.2 m in the middle
    *_, loss = between(roofs, [0.0, 0.0, edge], [30000.0, 0.0, edge])
    # The path grazes the middle: half of the field.
    grazing = 20 * math.log10(2)
    assert loss == pytest.approx(grazing + (1 - math.exp(-grazing / 6)) * (10 + 0.6), abs=0.3)
