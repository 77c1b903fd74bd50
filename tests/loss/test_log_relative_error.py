"""The logarithmic loss of channels against numpy, and how little one link can pull."""

import numpy as np
import pytest
import torch

from gaigs.loss.log_relative_error import LogRelativeError
from gaigs.query import Batch, Query
from gaigs.task.csi import Csi

TASK = Csi(3, 1e9 + 1e6 * torch.arange(5))
FLOOR = 1e-3


def loss_of(values, labels):
    query = Query(torch.zeros(len(labels), 3), torch.zeros(len(labels), dtype=torch.long))
    return LogRelativeError(TASK, FLOOR)(values, Batch(query, None, labels))


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(0)
    return torch.randn(2, 6, *TASK.shape, dtype=torch.complex128, generator=generator).unbind(0)


def test_it_is_the_mean_over_links_of_the_logarithm(pair):
    values, labels = (part.numpy() for part in pair)
    each = (abs(values - labels) ** 2).sum((1, 2)) / (abs(labels) ** 2).sum((1, 2))
    loss, terms = loss_of(*pair)
    assert loss.item() == pytest.approx(np.log(1 + each / FLOOR).mean(), rel=1e-12)
    assert terms == {"log_relative_error": loss}


def test_gradients_are_the_derivatives(pair):
    values, labels = pair
    assert torch.autograd.gradcheck(lambda values: loss_of(values, labels)[0], values.clone().requires_grad_())


@pytest.mark.parametrize("shadow", [1e-3, 1e-6, 1e-15])
def test_a_link_in_deep_shadow_pulls_no_harder_than_others(pair, shadow):
    """Pull: the derivative by the logarithm of all predictions' amplitude."""

    def pulls(labels):
        scales = torch.zeros(6, 1, 1, dtype=torch.float64, requires_grad=True)
        loss, _ = loss_of(2 * pair[1].to(torch.complex64) * scales.exp(), labels.to(torch.complex64))
        (gradient,) = torch.autograd.grad(loss, scales)
        return gradient.flatten()

    labels = pair[1].clone()
    labels[0] *= shadow
    assert pulls(labels)[0] == pytest.approx(2 / 6, rel=0.01)  # of an error as large as the prediction, of six links
    assert pulls(labels)[1:] == pytest.approx(pulls(pair[1])[1:])


def test_a_perfect_channel_costs_nothing_and_does_not_pull(pair):
    values = pair[1].clone().requires_grad_()
    loss, _ = loss_of(values, pair[1])
    loss.backward()
    assert loss == 0
    assert not values.grad.any()


@pytest.mark.parametrize("floor", [0.0, -1.0, float("nan")])
def test_a_floor_that_is_not_positive_is_refused(floor):
    with pytest.raises(ValueError, match=r"loss\.floor must be more than 0"):
        LogRelativeError(TASK, floor)
