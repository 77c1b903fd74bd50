"""One real number a link: scores against numpy, under the names of its unit."""

import numpy as np
import pytest
import torch

from gaigs.core.task.rssi import Rssi
from gaigs.core.task.scalar import Scalar


class Delay(Scalar):
    name, quantity, unit, error_unit = "delay", "delay", "ns", "ns"


def test_rssi_is_scored_in_db():
    labels, values = (
        torch.tensor([-50.0, -60.0, -70.0, -80.0]),
        torch.tensor([-49.0, -62.0, -70.0, -75.0]),
    )
    scores = Rssi().scores(labels, values)
    assert scores["mae_db"].tolist() == [1, 2, 0, 5]
    assert Rssi().summarise(scores) == {
        "mae_db": 2,
        "median_ae_db": 1.5,
        "rmse_db": pytest.approx(7.5**0.5),
    }
    assert [*Rssi.metrics()] == ["mae_db", "median_ae_db", "rmse_db"]
    assert (Rssi().shape, Rssi().unit, Rssi().normalisation, Rssi().directions) == (
        (),
        "dBm",
        "dBm",
        None,
    )
    assert Rssi().is_noisy


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_the_summary_is_that_of_numpy(dtype):
    labels, values = torch.randn(2, 41, generator=torch.Generator().manual_seed(0)).to(dtype)
    errors = np.abs(values.double().numpy() - labels.double().numpy())
    expected = {
        "mae_db": errors.mean(),
        "median_ae_db": np.median(errors),
        "rmse_db": np.sqrt((errors**2).mean()),
    }
    scores = Rssi().scores(labels, values)
    assert scores["mae_db"].dtype == torch.float64
    assert Rssi().summarise(scores) == pytest.approx(expected, rel=1e-12)


def test_another_quantity_has_names_of_its_own_unit():
    task = Delay()
    assert [metric.title for metric in Delay.metrics().values()] == [
        "MAE [ns]",
        "median AE [ns]",
        "RMSE [ns]",
    ]
    scores = task.scores(torch.zeros(3), torch.ones(3))
    assert [*scores] == [task.monitor] == ["mae_ns"]
    assert task.summarise(scores) == {"mae_ns": 1, "median_ae_ns": 1, "rmse_ns": 1}


def test_the_signed_error_is_stored():
    labels, values = torch.tensor([-50.0, -60.0]), torch.tensor([-49.0, -62.0])
    stored = Rssi().stored(labels, values, Rssi().scores(labels, values))
    assert [*stored] == ["error"]
    assert stored["error"].tolist() == [1, -2]


@pytest.mark.parametrize(
    ("labels", "values", "message"),
    [
        (torch.zeros(3), torch.zeros(4), r"must both be \('k',\), got \(3,\) and \(4,\)"),
        (torch.zeros(3, 1), torch.zeros(3, 1), r"must both be \('k',\)"),
        (torch.tensor(0.0), torch.tensor(0.0), r"must both be \('k',\), got \(\) and \(\)"),
        (
            torch.zeros(3),
            torch.tensor([0, torch.nan, 0]),
            "predictions must be finite, got NaN or infinity in 1 of 3",
        ),
        (
            torch.tensor([0, 0, torch.inf]),
            torch.zeros(3),
            "labels must be finite, .* 1 of 3 readings, first in number 2",
        ),
    ],
)
def test_impossible_readings_are_refused(labels, values, message):
    with pytest.raises(ValueError, match=message):
        Rssi().scores(labels, values)


def test_nothing_to_summarise_is_refused():
    with pytest.raises(ValueError, match="at least one sample, got none"):
        Rssi().summarise(Rssi().scores(torch.zeros(0), torch.zeros(0)))
