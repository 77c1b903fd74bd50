"""Means over windows against torch's pooling, values and gradients."""

import pytest
import torch
from torch.nn.functional import avg_pool2d

from gaigs.loss.windows import window_means


@pytest.mark.parametrize(
    ("shape", "window"),
    [((2, 3, 9, 14), 3), ((1, 1, 7, 7), 7), ((3, 2, 8, 7), 5), ((0, 2, 6, 5), 3), ((2, 1, 4, 6), 1)],
)
@pytest.mark.parametrize("transposed", [False, True])
def test_they_are_those_of_mean_pooling_and_so_are_gradients(shape, window, transposed):
    torch.manual_seed(0)
    images = torch.randn(shape, dtype=torch.float64, requires_grad=True)
    seen = images.mT if transposed else images
    expected = avg_pool2d(seen, window, stride=1) if len(images) else seen[..., window - 1 :, window - 1 :]
    before, found = images.detach().clone(), window_means(seen, window)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-13)
    assert torch.equal(images, before)
    weights = torch.randn_like(expected)
    gradients = [torch.autograd.grad(means, images, weights)[0] for means in (found, expected)]
    torch.testing.assert_close(*gradients, rtol=1e-12, atol=1e-13)
