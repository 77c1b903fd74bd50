import torch

from gaigs.core.query import Query
from gaigs.splatting.placement.free import Free
from gaigs.testing import example_links
from gaigs.testing.placement import example_gaussians


def test_means_are_those_of_the_gaussians_for_every_query_with_gradients():
    gaussians = example_gaussians(example_links().scene, 20)
    placed = Free()(gaussians, Query(torch.rand(5, 3), torch.zeros(5, dtype=torch.long)))
    assert torch.equal(placed.means, gaussians.means[None])
    assert placed.lengths is None
    placed.means.square().sum().backward()
    torch.testing.assert_close(gaussians.means.grad, 2 * gaussians.means.detach())
