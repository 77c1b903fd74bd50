"""Gaussians that stand where they were learnt to stand."""

import torch

from gaigs.placement.free import Free
from gaigs.query import Query
from gaigs.testing import example_links
from gaigs.testing.placement import example_gaussians


def test_gaussians_stand_at_their_means_whoever_sends():
    gaussians = example_gaussians(example_links().scene, 20)
    for b in (0, 1, 5):
        placed = Free()(gaussians, Query(torch.rand(b, 3), torch.zeros(b, dtype=torch.long)))
        assert torch.equal(placed.means, gaussians.means[None])
        assert placed.lengths is None


def test_where_they_stand_is_learnt():
    gaussians = example_gaussians(example_links().scene, 20)
    placed = Free()(gaussians, Query(torch.rand(2, 3), torch.zeros(2, dtype=torch.long)))
    placed.means.square().sum().backward()
    torch.testing.assert_close(gaussians.means.grad, 2 * gaussians.means.detach())
    assert not list(Free().parameters())
    assert not Free().sees_receivers
