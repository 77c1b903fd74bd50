"""Sheets in place of obstacles: what paths lose at them, and where they stand."""

import math

import numpy as np
import pytest
import torch

import gaigs
from gaigs.core.query import Query
from gaigs.planes import obstacle_surfaces as surfaces
from gaigs.planes.obstacle_surfaces import SurfaceOptions
from gaigs.splatting.placement.mirrored.obstacles import Obstacles
from gaigs.splatting.placement.mirrored.paths import Mirrored

CORNERS = np.zeros(3), np.array([7.0, 5.0, 3.0])


def placement_of(obstacles):
    """Free space in the built-in room, with obstacles at places from its middle."""
    torch.manual_seed(0)
    placement = Mirrored(
        gaigs.links("synthetic_csi", transmitters=10, order=0).scene, 2, obstacles=0, order=0
    )
    placement.kept.fill_(True)
    if obstacles:
        placement.obstacles = Obstacles(len(obstacles), -placement.middle, placement.middle)
        with torch.no_grad():
            for number, (place, width, density) in enumerate(obstacles):
                placement.obstacles.places[number] = torch.tensor(place) / placement.obstacles.unit
                placement.obstacles.log_widths[number] = math.log(width)
                placement.obstacles.log_densities[number] = math.log(density)
    return placement


@torch.no_grad()
def test_crossings_of_a_ball():
    placement = placement_of([((0.0, 0.0, 0.0), 0.5, 2.0)])
    steps = torch.linspace(-2, 2, 192).double()
    radius = 0.5 * math.sqrt(2 * math.log(2.0))  # at half of the density
    starts = torch.tensor([[-2.0, 0.0, 0.0], [-2.0, radius / 2, 0.0], [-2.0, 0.0, 2.0]]).double()
    levels = 2 * (-2 * (steps**2 + starts[:, 1:].square().sum(1)[:, None])).exp()
    along = torch.tensor([[4.0, 0, 0]]).double().expand(3, 3)
    matter = surfaces.sample_matter(placement.obstacles, -np.ones(3), np.ones(3), 50_000)
    found = surfaces.find_crossings(
        placement.obstacles, matter, 1.0, surfaces.Legs(starts, along, torch.arange(3), levels)
    )
    assert found.paths.tolist() == [0, 0, 1, 1]
    assert found.surfaces.tolist() == [0] * 4
    torch.testing.assert_close(
        found.cosines, torch.tensor([1, 1, 0.75**0.5, 0.75**0.5]).double(), atol=2e-3, rtol=0
    )
    vertices, _ = matter.mesh(1.0, 1)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), radius, atol=2e-3)


def test_losses_of_a_sheet():
    crossings = surfaces.Crossings(
        torch.tensor([0.5, 0.5]),
        torch.tensor([0.0, 1.0]),
        torch.tensor([0, 1]),
        torch.tensor([0, 0]),
    )
    losses = crossings.losses(torch.tensor([2.0]), 3)
    torch.testing.assert_close(losses, torch.tensor([math.log(3.0), math.log(1.5), 0.0]))


def test_sheets_dim_paths_as_two_unlike_obstacles_do():
    options = SurfaceOptions(voxels=50_000, candidates=4)
    placement = placement_of([((1.5, 0.5, 0.0), 0.3, 8.0), ((-1.0, -0.5, 0.3), 0.3, 2.0)])
    places = torch.cartesian_prod(
        torch.linspace(0.5, 6.5, 16), torch.linspace(0.5, 4.5, 10), torch.linspace(0.2, 2.8, 5)
    )
    query = Query(places, torch.zeros(len(places), dtype=torch.long))
    found, rest = surfaces.fit_sheets(placement, query, *CORNERS, options)
    at = [sheet.vertices.mean(0)[0] - float(placement.middle[0]) for sheet in found]
    thin, dense = (
        sum(sheet.loss_db for sheet, x in zip(found, at, strict=True) if abs(x - y) < 0.2)
        for y in (-1, 1.5)
    )
    # Through the middle they lose 6.5 and 26 dB on each side.
    assert 2 < thin < 7
    assert thin + 3 < dense < 30
    assert abs(rest) < 0.05


def test_clear_rooms_have_no_sheets():
    options = SurfaceOptions(voxels=1_000)
    query = Query(torch.tensor([[2.0, 2.0, 1.5]]), torch.zeros(1, dtype=torch.long))
    assert surfaces.fit_sheets(placement_of([]), query, *CORNERS, options) == ([], 0.0)
    clear = placement_of([((0.0, 0.0, 0.0), 0.01, 1e-9)])
    found, _ = surfaces.fit_sheets(clear, query, *CORNERS, options)
    assert found == []


@torch.no_grad()
def test_sheets_of_a_box_take_its_loss():
    placement = placement_of([((0.0, 0.0, 0.0), 0.5, 2.0)])
    corners = torch.tensor([[[1.0, -0.5, -0.5], [1.5, 0.5, 0.5]]])
    turned = torch.tensor([[0.6, -0.8, 0.0], [0.8, 0.6, 0.0], [0.0, 0.0, 1.0]])
    placement.obstacles.place_boxes(turned, corners, torch.tensor([1.2]))
    middle = np.array([3.5, 2.5, 1.5])
    (sheet,) = surfaces.sheets_of_boxes(placement.obstacles, middle)
    passed = (1 + sheet.conductance / 2) ** -2  # of a path through two faces
    assert -math.log(passed) == pytest.approx(1.2)
    expected = placement.obstacles.box_corners[0].double().numpy() + middle
    assert {*map(tuple, sheet.vertices.round(6))} == {*map(tuple, expected.round(6))}
    # Faces look outwards: the volume that they enclose is positive.
    a, b, c = (sheet.vertices[sheet.faces[:, corner]] - middle for corner in range(3))
    assert (np.cross(a, b) * c).sum() / 6 == pytest.approx(0.5, rel=1e-5)
