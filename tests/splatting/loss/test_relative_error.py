"""The relative error of channels and its logarithm against numpy, links whose channels are weak,
and deep shadow.
"""

import numpy as np
import pytest
import torch

from gaigs.core.query import Batch, Query
from gaigs.core.task.csi import Csi
from gaigs.splatting.loss.log_relative_error import LogRelativeError
from gaigs.splatting.loss.relative_error import RelativeError

TASK = Csi(3, 1e9 + 1e6 * torch.arange(5))


FLOOR = 1e-3
LOSSES = RelativeError(TASK), LogRelativeError(TASK, FLOOR)
ALIGNED = [
    LogRelativeError(Csi(3, TASK.frequencies, phase), FLOOR)
    for phase in ("per_link", "per_link_and_delay")
]
both = pytest.mark.parametrize("loss", LOSSES, ids=lambda loss: loss.name)


def loss_of(values, labels, loss=LOSSES[0]):
    query = Query(torch.zeros(len(labels), 3), torch.zeros(len(labels), dtype=torch.long))
    return loss(values, Batch(query, None, labels))


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(0)
    return torch.randn(2, 6, *TASK.shape, dtype=torch.complex128, generator=generator).unbind(0)


def test_losses_equal_their_formulas_in_numpy(pair):
    values, labels = (part.numpy() for part in pair)
    each = (abs(values - labels) ** 2).sum((1, 2)) / (abs(labels) ** 2).sum((1, 2))
    loss, terms = loss_of(*pair)
    assert loss.item() == pytest.approx(each.mean(), rel=1e-12)
    assert terms == {"relative_error": loss}
    loss, terms = loss_of(*pair, LOSSES[1])
    assert loss.item() == pytest.approx(
        np.log((1 + each / FLOOR) / (1 + each * FLOOR)).mean(), rel=1e-12
    )
    assert terms == {"log_relative_error": loss}


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


@pytest.mark.parametrize("loss", [*LOSSES, *ALIGNED])
def test_gradients_are_the_derivatives(pair, loss):
    values, labels = pair
    assert torch.autograd.gradcheck(
        lambda values: loss_of(values, labels, loss)[0], values.clone().requires_grad_()
    )


@both
def test_a_perfect_channel_costs_nothing_and_does_not_pull(pair, loss):
    values = pair[1].clone().requires_grad_()
    loss, _ = loss_of(values, pair[1], loss)
    loss.backward()
    assert loss == 0
    assert not values.grad.any()


@pytest.mark.parametrize("shadow", [0.3, 0.1, 1e-3, 1e-6, 1e-15])
def test_a_link_pulls_the_less_the_deeper_its_shadow_is(pair, shadow):
    """Pull: the derivative by the logarithm of the prediction's amplitude, which is twice that out
    of the shadow.
    """

    def pulls(labels):
        scales = torch.zeros(6, 1, 1, dtype=torch.float64, requires_grad=True)
        loss, _ = loss_of(
            2 * pair[1].to(torch.complex64) * scales.exp(), labels.to(torch.complex64), LOSSES[1]
        )
        (gradient,) = torch.autograd.grad(loss, scales)
        return gradient.flatten()

    labels = pair[1].clone()
    labels[0] *= shadow
    error, change = (
        (2 / shadow - 1) ** 2,
        4 / (2 - shadow),
    )  # relative error, and by what power it goes
    expected = change * (error / (error + FLOOR) - error * FLOOR / (1 + error * FLOOR)) / 6
    assert pulls(labels)[0].item() == pytest.approx(expected, rel=1e-4)
    assert expected < change / 6
    assert pulls(labels)[1:] == pytest.approx(pulls(pair[1])[1:])


@pytest.mark.parametrize("loss", ALIGNED)
def test_unknown_phases_leave_loss_and_gradient_as_they_are(pair, loss):
    values, labels = (part.requires_grad_() for part in pair)
    phases = torch.linspace(-3, 3, 6, dtype=torch.float64)
    turned = labels.detach() * torch.polar(torch.ones_like(phases), phases)[:, None, None]
    found = [loss_of(values, part, loss)[0] for part in (labels.detach(), turned)]
    assert found[1].item() == pytest.approx(found[0].item())
    torch.testing.assert_close(
        *(torch.autograd.grad(each, values)[0] for each in found), rtol=1e-6, atol=1e-9
    )


@pytest.mark.parametrize("loss", ALIGNED)
def test_a_prediction_of_silence_has_a_loss_and_a_gradient(pair, loss):
    values = torch.zeros_like(pair[0], requires_grad=True)
    each, _ = loss_of(values, pair[1], loss)
    each.backward()
    assert each.item() == pytest.approx(np.log((1 + 1 / FLOOR) / (1 + FLOOR)))
    assert values.grad.isfinite().all()
