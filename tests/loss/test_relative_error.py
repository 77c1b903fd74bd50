"""The normalised error of channels against numpy, and links whose channels are weak."""

import numpy as np
import pytest
import torch

from gaigs.loss.relative_error import RelativeError
from gaigs.query import Batch, Query
from gaigs.task.csi import Csi
from gaigs.task.rssi import Rssi

TASK = Csi(3, 1e9 + 1e6 * torch.arange(5))


def loss_of(values, labels):
    query = Query(torch.zeros(len(labels), 3), torch.zeros(len(labels), dtype=torch.long))
    return RelativeError(TASK)(values, Batch(query, None, labels))


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(0)
    return torch.randn(2, 6, *TASK.shape, dtype=torch.complex128, generator=generator).unbind(0)


def test_it_is_the_mean_over_links_of_their_normalised_error(pair):
    values, labels = (part.numpy() for part in pair)
    each = (abs(values - labels) ** 2).sum((1, 2)) / (abs(labels) ** 2).sum((1, 2))
    loss, terms = loss_of(*pair)
    assert loss.item() == pytest.approx(each.mean(), rel=1e-12)
    assert terms == {"relative_error": loss}


def test_it_is_the_snr_of_the_score():
    """-10 log10 of it is the SNR of a single link."""
    generator = torch.Generator().manual_seed(1)
    values, labels = torch.randn(2, 1, *TASK.shape, dtype=torch.complex64, generator=generator)
    snr = TASK.scores(labels, values)["snr_db"].item()
    assert -10 * np.log10(loss_of(values, labels)[0].item()) == pytest.approx(snr, abs=1e-5)


def test_each_link_counts_alike_however_weak_its_channel_is(pair):
    values, labels = (part.to(torch.complex64) for part in pair)
    expected = loss_of(values, labels)[0].item()
    strengths = torch.logspace(-30, 15, 6)[:, None, None]  # squares of either end are no float32
    values, labels = (strengths * values).requires_grad_(), strengths * labels
    loss, _ = loss_of(values, labels)
    assert loss.item() == pytest.approx(expected, rel=1e-4)
    loss.backward()
    assert values.grad.isfinite().all()
    assert values.grad.flatten(1).any(1).all()


def test_gradients_are_the_derivatives(pair):
    values, labels = pair
    assert torch.autograd.gradcheck(lambda values: loss_of(values, labels)[0], values.clone().requires_grad_())


def test_a_perfect_channel_costs_nothing_and_does_not_pull(pair):
    values = pair[1].clone().requires_grad_()
    loss, _ = loss_of(values, pair[1])
    loss.backward()
    assert loss == 0
    assert not values.grad.any()


def test_real_labels_are_refused():
    message = "'rssi' are real, and loss 'relative_error' takes complex channels; take loss=squared"
    with pytest.raises(ValueError, match=message):
        RelativeError(Rssi())
