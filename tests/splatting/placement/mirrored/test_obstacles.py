"""Optical depths of Gaussian obstacles against numerical integrals, and at extremes."""

import math

import numpy as np
import pytest
import torch

from gaigs.splatting.placement.mirrored.obstacles import Obstacles

LOWER, UPPER = torch.tensor([0.0, 0.0, 0.0]), torch.tensor([6.0, 4.0, 3.0])


@pytest.fixture(params=[False, True], ids=["real", "with phases"])
def obstacles(request):
    """Seven of different shapes, float64."""
    torch.manual_seed(0)
    made = Obstacles(7, LOWER, UPPER, request.param).double()
    with torch.no_grad():
        if request.param:
            made.turns.uniform_(-2.0, 2.0)
        made.log_widths.uniform_(math.log(0.1), math.log(1.5))
        made.log_densities.uniform_(math.log(0.05), math.log(5.0))
    return made


def segments(count, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return (UPPER * torch.rand(2, count, 3, generator=generator)).double()


def integral(obstacles, start, end, steps=4000):
    """The density along a segment by Gauss-Legendre quadrature."""
    nodes, weights = np.polynomial.legendre.leggauss(8)
    edges = np.linspace(0, 1, steps // 8 + 1)
    t = (edges[:-1, None] + np.diff(edges)[:, None] * (nodes + 1) / 2).ravel()
    w = (np.diff(edges)[:, None] * weights / 2).ravel()
    points = start + t[:, None] * (end - start)
    parts = (obstacles.centres, obstacles.widths, obstacles.densities)
    centres, widths, densities = (part.detach().numpy() for part in parts)
    if obstacles.turns is not None:
        densities = densities * (1 + 1j * obstacles.turns.detach().numpy())
    squares = (((points[:, None] - centres) / widths) ** 2).sum(-1)
    return np.linalg.norm(end - start) * (w[:, None] * densities * np.exp(-squares / 2)).sum()


def test_the_depth_is_the_integral_of_the_density(obstacles):
    starts, ends = segments(30)
    depths = obstacles(starts, ends)
    for start, end, depth in zip(starts.numpy(), ends.numpy(), depths.tolist(), strict=True):
        assert depth == pytest.approx(integral(obstacles, start, end), rel=1e-7)
    assert depths.abs().max() > 1


def test_pieces_of_a_segment_add_up_and_its_direction_does_not_matter(obstacles):
    starts, ends = segments(20)
    middles = torch.lerp(starts, ends, 0.3)
    whole = obstacles(starts, ends)
    torch.testing.assert_close(obstacles(starts, middles) + obstacles(middles, ends), whole)
    torch.testing.assert_close(obstacles(ends, starts), whole)
    assert obstacles(starts[0], ends[0]).shape == ()
    torch.testing.assert_close(
        obstacles(starts.view(4, 5, 3), ends.view(4, 5, 3)), whole.view(4, 5)
    )


def test_segments_taken_in_parts_have_the_same_depths_and_gradients(obstacles):
    starts, ends = segments(9)
    results = []
    for pairs in (1000, 15, 1):
        obstacles.pairs = pairs
        depths = obstacles(starts, ends)
        results.append(
            (depths, *torch.autograd.grad(depths.abs().square().sum(), [*obstacles.parameters()]))
        )
    for other in results[1:]:
        torch.testing.assert_close(other, results[0])


def test_gradients_are_the_derivatives(obstacles):
    starts, ends = (part.requires_grad_() for part in segments(6))
    names, leaves = zip(*obstacles.named_parameters(), strict=True)

    def depth(start, end, *values):
        return torch.func.functional_call(
            obstacles, dict(zip(names, values, strict=True)), (start, end)
        )

    assert torch.autograd.gradcheck(depth, [starts, ends, *leaves])


def test_a_segment_of_no_length_has_no_depth(obstacles):
    start = segments(5)[0].requires_grad_()
    end = start.detach().clone().requires_grad_()
    depth = obstacles(start, end)
    assert not depth.any()
    for gradient in torch.autograd.grad(depth.abs().sum(), [start, end, *obstacles.parameters()]):
        assert gradient.isfinite().all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_depths_vanish_far_away(obstacles, dtype):
    obstacles.to(dtype)
    start = torch.tensor(
        [[100.0, 0, 0], [0, 1e4, 0], [1e6, 1e6, 1e6]], dtype=dtype, requires_grad=True
    )
    depth = obstacles(start, start.detach() + torch.tensor([0, 0, 50.0], dtype=dtype))
    assert (depth.abs() < 1e-20).all()
    parts = torch.view_as_real(depth) if depth.is_complex() else depth
    for gradient in torch.autograd.grad(parts.sum(), [start, *obstacles.parameters()]):
        assert gradient.isfinite().all()
        assert gradient.abs().max() < 1e-15


def test_single_precision_is_near_double(obstacles):
    starts, ends = segments(40)
    true = obstacles(starts, ends)
    weights = torch.arange(40.0).cos().double()
    exact = torch.autograd.grad((true * weights).abs().sum(), [*obstacles.parameters()])
    obstacles.float()
    found = obstacles(starts.float(), ends.float())
    gradients = torch.autograd.grad(
        (found * weights.float()).abs().sum(), [*obstacles.parameters()]
    )
    torch.testing.assert_close(found.to(true), true, rtol=1e-4, atol=1e-5)
    for gradient, expected in zip(gradients, exact, strict=True):
        torch.testing.assert_close(
            gradient.double(), expected, rtol=0, atol=1e-4 * expected.abs().max().item()
        )


@pytest.mark.parametrize("width", [1e-4, 1.0, 1e5])
@pytest.mark.parametrize("density", [1e-12, 1e6])
def test_extreme_obstacles_have_finite_gradients(width, density):
    torch.manual_seed(0)
    obstacles = Obstacles(20, LOWER, UPPER)
    with torch.no_grad():
        obstacles.log_widths.fill_(math.log(width))
        obstacles.log_widths[::2, 0] += 3  # not all are balls
        obstacles.log_densities.fill_(math.log(density))
    starts, ends = (part.float().requires_grad_() for part in segments(50))
    with torch.no_grad():
        starts[0] = obstacles.centres[0]
        starts[1], ends[1] = obstacles.centres[1] - 1e-6, obstacles.centres[1] + 1e-6
    depth = obstacles(starts, ends)
    assert depth.isfinite().all()
    assert (depth >= 0).all()
    for gradient in torch.autograd.grad(depth.sum(), [starts, ends, *obstacles.parameters()]):
        assert gradient.isfinite().all()


def test_initial_obstacles_are_faint_and_all_over_the_room():
    torch.manual_seed(0)
    obstacles = Obstacles(500, LOWER, UPPER)
    assert len(obstacles) == 500
    margin = 0.05 * (UPPER - LOWER)
    assert (obstacles.centres >= LOWER - margin).all()
    assert (obstacles.centres <= UPPER + margin).all()
    spread = obstacles.centres.std(0) / (UPPER - LOWER)
    torch.testing.assert_close(spread, torch.full((3,), 1.1 / math.sqrt(12)), rtol=0.1, atol=0)
    one = Obstacles(1, LOWER, UPPER)
    ray = torch.tensor([10.0, 0, 0])
    assert 0 < one(one.centres[0] - ray, one.centres[0] + ray) < 0.12  # a decibel is 0.115 Np


def test_boxes_dim_whatever_the_way_inside(obstacles):
    start = torch.tensor([[-2.0, 0, 0], [-2.0, 0.4, 0], [-2.0, -2, 0]]).double()
    end = torch.tensor([[2.0, 0, 0], [2.0, 0.4, 0], [2.0, -2, 0]]).double()
    before = obstacles(start, end)
    corners = torch.tensor([[[-0.1, -0.5, -0.5], [0.1, 0.5, 0.5]]]).double()
    obstacles.place_boxes(torch.eye(3).double(), corners, torch.tensor([1.5]).double())
    obstacles.log_densities.data.fill_(-80)
    added = obstacles(start, end)
    torch.testing.assert_close(added.real, torch.tensor([1.5, 1.5, 0.0]).double())
    assert not torch.allclose(before.real, added.real)
    (gradient,) = torch.autograd.grad(added.real.sum(), obstacles.box_depths)
    assert gradient[0] == 2


def test_checkpoint_without_boxes_loads(obstacles):
    state = obstacles.state_dict()
    for name in ("boxes", "box_axes", "box_depths"):
        del state[name]
    obstacles.load_state_dict(state)
