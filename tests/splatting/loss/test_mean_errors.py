"""Means of a function of the error, against numpy and scipy."""

import numpy as np
import pytest
import torch
from scipy.special import huber

from gaigs.core.query import Batch, Query
from gaigs.core.task.rssi import Rssi
from gaigs.registry import registry

FORMULAS = {
    "absolute": lambda errors: np.abs(errors).mean(),
    "squared": lambda errors: (errors**2).mean(),
    "huber": lambda errors: huber(3.0, errors).mean(),
}
every = pytest.mark.parametrize("name", FORMULAS)


def build(name, task=None, **options):
    options = {"delta": 3.0} | options if name == "huber" else options
    return registry("loss").build({"name": name, **options}, task=task or Rssi())


def batch_of(labels, directions=None):
    query = Query(torch.zeros(len(labels), 3), torch.zeros(len(labels), dtype=torch.long))
    return Batch(query, directions, labels)


@pytest.fixture
def errors():
    return torch.tensor([0.0, 0.5, -2.9, 3.1, -40.0, 3.0])


@every
def test_losses_equal_their_formulas(name, errors):
    labels = torch.linspace(-90, -40, 6)
    loss, terms = build(name)(labels + errors, batch_of(labels))
    exact = (labels + errors).double().numpy() - labels.double().numpy()
    assert loss.item() == pytest.approx(FORMULAS[name](exact), rel=1e-5)
    assert [*terms] == ["mae"]
    assert terms["mae"].item() == pytest.approx(np.abs(exact).mean(), rel=1e-5)


@every
def test_gradients_equal_finite_differences(name, errors):
    values = (errors + 0.05).double().requires_grad_()  # off the kinks
    labels = torch.zeros(6, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda values: build(name)(values, batch_of(labels))[0], values)
