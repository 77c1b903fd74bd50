"""Means of a function of the error, against numpy and scipy."""

import numpy as np
import pytest
import torch
from scipy.special import huber

from gaigs.geometry import Grid
from gaigs.query import Batch, Query
from gaigs.registry import registry
from gaigs.task.rssi import Rssi
from gaigs.task.spectrum import Spectrum

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
def test_it_is_the_mean_of_the_formula(name, errors):
    labels = torch.linspace(-90, -40, 6)
    loss, terms = build(name)(labels + errors, batch_of(labels))
    exact = (labels + errors).double().numpy() - labels.double().numpy()
    assert loss.item() == pytest.approx(FORMULAS[name](exact), rel=1e-5)
    assert [*terms] == ["mae"]
    assert terms["mae"].item() == pytest.approx(np.abs(exact).mean(), rel=1e-5)


@every
def test_it_takes_spectra_in_any_directions(name):
    grid = Grid.degrees(range(1, 10), range(12))
    loss = build(name, Spectrum(grid.elevations, grid.azimuths, "none"))
    values, labels = torch.rand(2, 3, *grid.shape, generator=torch.Generator().manual_seed(0))
    expected = FORMULAS[name]((values - labels).double().numpy())
    assert loss(values, batch_of(labels, grid))[0].item() == pytest.approx(expected, rel=1e-5)
    rays = loss(values.flatten(1), batch_of(labels.flatten(1), grid.flatten()))[0]
    assert rays.item() == pytest.approx(expected, rel=1e-5)


@every
def test_the_gradient_is_that_of_the_formula(name, errors):
    values = (errors + 0.05).double().requires_grad_()  # off the kinks
    labels = torch.zeros(6, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda values: build(name)(values, batch_of(labels))[0], values)


def test_an_outlier_pulls_no_harder_than_another_but_on_the_square(errors):
    pulls = {}
    for name in FORMULAS:
        values = torch.tensor([4.0, 400.0], requires_grad=True)
        build(name)(values, batch_of(torch.zeros(2)))[0].backward()
        pulls[name] = (values.grad[1] / values.grad[0]).item()
    assert pulls == {"absolute": 1, "squared": 100, "huber": 1}
