"""Roofs between the ends of a link: lengths, walls and edges against plane geometry and Fresnel's
integrals.
"""

import math

import numpy as np
import pytest
import torch
from scipy.special import fresnel

from gaigs.core.roofs import knife_edge, obstruct, rasterize_roofs


def box(x0, y0, x1, y1, roof, *holes):
    corners = [np.array([[a, b], [c, b], [c, d], [a, d]], float) for a, b, c, d in holes]
    outline = np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1], [x0, y0]], float)
    return [outline, *corners], roof


def roofs_of(*buildings, cell=0.25):
    return rasterize_roofs(buildings, np.array([0.0, -30.0]), np.array([100.0, 30.0]), cell)


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
    roofs = rasterize_roofs(
        [box(20, -10, 60, 10, 15.0)], np.array([0.0, -50.0]), np.array([100.0, 50.0]), most=100
    )
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
