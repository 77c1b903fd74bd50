"""Log-distance path loss: exact on its own law, least squares on others, defined where the data say too little."""

import numpy as np
import pytest
import torch

from gaigs.data import Links, Split
from gaigs.geometry import Pose
from gaigs.model.path_loss import PathLoss
from gaigs.query import Query
from gaigs.scene import Receiver
from gaigs.task.rssi import Rssi
from gaigs.task.scalar import Scalar
from gaigs.testing import check_model, example_links

GATEWAYS = torch.tensor([[0.0, 0.0, 2.5], [6.0, 1.0, 1.0]])


def make(transmitters, labels, heard_by=None, task=None):
    """Links to two gateways, each with all transmitters unless told; the last three are held out for the test."""
    if heard_by is None:
        heard_by = torch.arange(2).repeat_interleave(len(transmitters) // 2)
    n = len(transmitters)
    return Links(
        query=Query(transmitters, heard_by),
        receivers=tuple(Receiver(f"gateway{i}", Pose(position, torch.eye(3))) for i, position in enumerate(GATEWAYS)),
        labels=labels.float(),
        task=task or Rssi(),
        split=Split("made up", torch.arange(n - 6), torch.arange(n - 6, n - 3), torch.arange(n - 3, n)),
    )


def law(transmitters, receiver, level, exponent):
    distances = np.linalg.norm(transmitters.double().numpy() - GATEWAYS[receiver].double().numpy(), axis=-1)
    return torch.tensor(level - 10 * exponent * np.log10(distances))


@pytest.fixture
def places():
    return torch.rand(60, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([6.0, 4.0, 2.0])


def fitted(links):
    model = PathLoss(links.scene)
    model.fit(links)
    return model


@pytest.mark.filterwarnings("ignore::gaigs.geometry.ExtrapolationWarning")
@pytest.mark.parametrize("shift", [0.0, 1e4])
def test_its_own_law_comes_back(places, shift, monkeypatch):
    monkeypatch.setattr(__name__ + ".GATEWAYS", GATEWAYS + shift)
    places = places + shift
    links = make(places, torch.cat((law(places[:30], 0, -40, 2.7), law(places[30:], 1, -52, 1.6))))
    model = fitted(links)
    assert model.levels.tolist() == pytest.approx([-40, -52], abs=1e-3)
    assert model.exponents.tolist() == pytest.approx([2.7, 1.6], abs=1e-3)
    asked = shift + torch.tensor([[3.0, 2.0, 1.0], [60.0, 2.0, 1.0]])
    for receiver, (level, exponent) in enumerate([(-40, 2.7), (-52, 1.6)]):
        predicted = model.predict(asked, receiver)
        torch.testing.assert_close(predicted, law(asked, receiver, level, exponent).float(), rtol=0, atol=1e-2)


def test_noisy_readings_are_fitted_by_least_squares_without_the_test(places):
    labels = torch.randn(60, generator=torch.Generator().manual_seed(1)) * 6 - 60
    labels[-3:] = torch.nan
    model = fitted(make(places, labels))
    for receiver, part in enumerate((slice(0, 30), slice(30, 57))):
        distances = np.linalg.norm((places[part] - GATEWAYS[receiver]).double().numpy(), axis=-1)
        slope, level = np.polyfit(np.log10(distances), labels[part].double().numpy(), 1)
        assert model.levels[receiver].item() == pytest.approx(level, abs=1e-3)
        assert model.exponents[receiver].item() == pytest.approx(-slope / 10, abs=1e-4)


def test_a_signal_that_grows_with_distance_keeps_its_sign(places):
    labels = torch.cat((law(places[:30], 0, -60, -0.7), law(places[30:], 1, -52, 1.6)))
    assert fitted(make(places, labels)).exponents.tolist() == pytest.approx([-0.7, 1.6], abs=1e-4)


@pytest.mark.filterwarnings("ignore::gaigs.geometry.ExtrapolationWarning")
@pytest.mark.parametrize("jitter", [0.0, 1e-3])
def test_links_of_one_length_get_the_slope_of_free_space(places, jitter):
    angles = torch.linspace(0, 6, 30)
    places[:30] = GATEWAYS[0] + (3 + jitter * angles.cos())[:, None] * torch.stack(
        (angles.cos(), angles.sin(), 0 * angles), -1
    )
    labels = torch.cat((-55 + angles.sin(), law(places[30:], 1, -52, 1.6)))
    model = fitted(make(places, labels))
    assert model.exponents.tolist() == pytest.approx([2, 1.6], abs=1e-4)
    predicted = model.predict(GATEWAYS[0] + torch.tensor([[3.0, 0.0, 0.0], [0.0, 30.0, 0.0]]), 0)
    mean = labels[:30].mean().item()
    assert predicted.tolist() == pytest.approx([mean, mean - 20], abs=1e-2)


def test_one_link_is_enough(places):
    index = torch.ones(60, dtype=torch.long)
    index[4] = 0
    model = fitted(make(places, law(places, 1, -52, 1.6), index))
    assert model.predict(places[4:5], 0).item() == pytest.approx(law(places[4], 1, -52, 1.6).item(), abs=1e-3)
    assert model.exponents[0].item() == 2


def test_on_top_of_the_receiver_counts_as_a_decimetre(places):
    labels = torch.cat((law(places[:30], 0, -40, 2.7), law(places[30:], 1, -52, 1.6)))
    places[5], labels[5] = GATEWAYS[0], -40 + 27
    model = fitted(make(places, labels))
    assert model.exponents.tolist() == pytest.approx([2.7, 1.6], abs=1e-3)
    asked = GATEWAYS[0] + torch.tensor([[0.0, 0, 0], [0.05, 0, 0], [0, 0.1, 0], [0, 0, 1.0]])
    assert model.predict(asked, 0).tolist() == pytest.approx([-13, -13, -13, -40], abs=1e-2)


def test_the_state_dict_has_it_all(places):
    links = make(places, torch.cat((law(places[:30], 0, -40, 2.7), law(places[30:], 1, -52, 1.6))))
    model, twin = fitted(links), PathLoss(links.scene)
    assert twin.predict(places).isnan().all()
    assert not list(model.parameters())
    twin.load_state_dict(model.state_dict())
    for receiver in (0, 1):
        assert torch.equal(model.predict(places, receiver), twin.predict(places, receiver))


class PathGain(Scalar):
    """One real number a link of another unit."""

    name, quantity, unit, error_unit = "path_gain", "path gain", "dB", "dB"


def test_any_real_number_a_link_will_do(places):
    links = make(places, torch.cat((law(places[:30], 0, -40, 2.7), law(places[30:], 1, -52, 1.6))), task=PathGain())
    assert fitted(links).exponents.tolist() == pytest.approx([2.7, 1.6], abs=1e-3)


@pytest.mark.parametrize(("task", "words"), [("spectrum", r"amplitude of shape \(18, 36\)"), ("csi", "channel of")])
def test_more_than_a_real_number_is_refused(task, words):
    with pytest.raises(ValueError, match=f"must have one real number a link as label, got {words}"):
        PathLoss(example_links(task).scene)


def test_it_keeps_the_contract_of_models():
    check_model(PathLoss, example_links("rssi"))


def test_a_receiver_without_known_links_is_refused(places):
    links = make(places, torch.zeros(60), torch.zeros(60, dtype=torch.long))
    links.query.receivers[-3:] = 1  # heard, but in the test alone
    with pytest.raises(ValueError, match="'made up' there are none of gateway1; choose another split"):
        fitted(links)
