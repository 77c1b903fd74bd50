"""Log-distance path loss: exact on its own law, defined where links are too few or equally long."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Pose
from gaigs.core.query import Query
from gaigs.core.task.rssi import Rssi
from gaigs.core.task.scalar import Scalar
from gaigs.data import Links, Split
from gaigs.model.path_loss import PathLoss, shrunk
from gaigs.testing import example_links

GATEWAYS = torch.tensor([[0.0, 0.0, 2.5], [6.0, 1.0, 1.0]])


class PathGain(Scalar):
    """One real number a link of another unit."""

    name, quantity, unit, error_unit = "path_gain", "path gain", "dB", "dB"


def make(transmitters, labels, heard_by=None, task=None):
    """Links to two gateways, the first half to the first one if not given; the last three test."""
    n = len(transmitters)
    if heard_by is None:
        heard_by = torch.arange(2).repeat_interleave(n // 2)
    return Links(
        query=Query(transmitters, heard_by),
        receivers=tuple(
            Receiver(f"gateway{i}", Pose(position, torch.eye(3)))
            for i, position in enumerate(GATEWAYS)
        ),
        labels=labels.float(),
        task=task or Rssi(),
        split=Split(
            "made up", torch.arange(n - 6), torch.arange(n - 6, n - 3), torch.arange(n - 3, n)
        ),
    )


def law(transmitters, receiver, level, exponent):
    distances = np.linalg.norm(
        transmitters.double().numpy() - GATEWAYS[receiver].double().numpy(), axis=-1
    )
    return torch.tensor(level - 10 * exponent * np.log10(distances))


@pytest.fixture
def places():
    return torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [6.0, 4.0, 2.0]
    )


def fitted(links):
    model = PathLoss(links.scene)
    model.fit(links)
    return model


@pytest.mark.filterwarnings("ignore::gaigs.core.geometry.ExtrapolationWarning")
@pytest.mark.parametrize(("shift", "task"), [(0.0, Rssi()), (1e4, PathGain())])
def test_level_and_exponent_of_the_law_are_recovered(places, shift, task, monkeypatch):
    monkeypatch.setattr(__name__ + ".GATEWAYS", GATEWAYS + shift)
    places = places + shift
    model = fitted(
        make(
            places,
            torch.cat((law(places[:30], 0, -40, 2.7), law(places[30:], 1, -52, -0.7))),
            task=task,
        )
    )
    assert model.levels.tolist() == pytest.approx([-40, -52], abs=1e-3)
    assert model.exponents.tolist() == pytest.approx([2.7, -0.7], abs=1e-3)
    asked = shift + torch.tensor([[3.0, 2.0, 1.0], [60.0, 2.0, 1.0]])
    for receiver, (level, exponent) in enumerate([(-40, 2.7), (-52, -0.7)]):
        predicted = model.predict(asked, receiver)
        torch.testing.assert_close(
            predicted, law(asked, receiver, level, exponent).float(), rtol=0, atol=1e-2
        )


@pytest.mark.filterwarnings("ignore::gaigs.core.geometry.ExtrapolationWarning")
@pytest.mark.parametrize("jitter", [0.0, 1e-3])
def test_links_of_one_length_get_the_slope_of_other_receivers(places, jitter):
    angles = torch.linspace(0, 6, 30)
    places[:30] = GATEWAYS[0] + (3 + jitter * angles.cos())[:, None] * torch.stack(
        (angles.cos(), angles.sin(), 0 * angles), -1
    )
    labels = torch.cat((-55 + angles.sin(), law(places[30:], 1, -52, 1.6)))
    model = fitted(make(places, labels))
    assert model.exponents.tolist() == pytest.approx([1.6, 1.6], abs=1e-4)
    predicted = model.predict(GATEWAYS[0] + torch.tensor([[3.0, 0.0, 0.0], [0.0, 30.0, 0.0]]), 0)
    mean = labels[:30].mean().item()
    assert predicted.tolist() == pytest.approx([mean, mean - 16], abs=1e-2)


def test_one_link_is_enough(places):
    index = torch.ones(60, dtype=torch.long)
    index[4] = 0
    model = fitted(make(places, law(places, 1, -52, 1.6), index))
    assert model.predict(places[4:5], 0).item() == pytest.approx(
        law(places[4], 1, -52, 1.6).item(), abs=1e-3
    )
    assert model.exponents.tolist() == pytest.approx([1.6, 1.6], abs=1e-4)


def test_slopes_of_few_readings_are_drawn_towards_the_mean():
    own, weights = (
        torch.tensor([2.9, 3.1, 3.0, -4.0], dtype=torch.float64),
        torch.tensor([9e4, 9e4, 9e4, 2.0]).double(),
    )
    *many, few = shrunk(own, weights, torch.tensor(16.0).double()).tolist()
    assert many == pytest.approx([2.9, 3.1, 3.0], abs=0.01)
    assert few == pytest.approx(3.0, abs=0.1)
    torch.testing.assert_close(
        shrunk(own, weights, torch.tensor(0.0).double()), own
    )  # no noise explains the scatter
    assert shrunk(own, 0 * weights, torch.tensor(1.0)).tolist() == [2, 2, 2, 2]  # free space
    # The variance of DerSimonian and Laird, by hand: squares 2, chance 1, both weights 1.
    found = shrunk(
        torch.tensor([1.0, 3.0]).double(), torch.ones(2).double(), torch.tensor(1.0).double()
    )
    assert found.tolist() == pytest.approx([1.5, 2.5])


def test_slopes_of_two_readings_each_are_one():
    slopes, weights = torch.tensor([-1.0, 5.0]), torch.tensor([1.0, 3.0])
    torch.testing.assert_close(
        shrunk(slopes, weights, torch.tensor(torch.nan)), torch.tensor([3.5, 3.5])
    )


def test_lines_through_two_readings_leave_no_noise_to_estimate(places):
    """Their residuals are 0 but for rounding, and no reading is left over."""
    for seed in range(20):
        labels = -50 + 9 * torch.randn(60, generator=torch.Generator().manual_seed(seed))
        few = Split("few", torch.tensor([0, 1, 58, 59]), torch.arange(0), torch.arange(3))
        model = fitted(replace(make(places, labels), split=few))
        assert model.exponents.isfinite().all()
        assert model.levels.isfinite().all()


@pytest.mark.parametrize("task", ["spectrum", "csi"])
def test_more_than_a_real_number_is_refused(task):
    with pytest.raises(
        ValueError, match=f"predicts one real number a link, not labels of task '{task}'"
    ):
        PathLoss(example_links(task).scene)
