"""Scores against scikit-image and numpy, called here on each pair of images."""

import numpy as np
import pytest
import torch
from skimage.metrics import structural_similarity

from gaigs.training.metrics import rssi_scores, spectrum_scores, summarise_rssi, summarise_spectra


@pytest.fixture
def pairs():
    generator = torch.Generator().manual_seed(3)
    labels = torch.rand(5, 9, 24, generator=generator)
    return labels, labels + 0.2 * torch.randn(5, 9, 24, generator=generator)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float32, torch.float64])
def test_scores_are_those_of_scikit_image(pairs, dtype):
    labels, predictions = (values.to(dtype) for values in pairs)
    scores = spectrum_scores(labels, predictions)
    for k in range(5):
        a, b = labels[k].double().numpy(), predictions[k].double().numpy()
        assert scores["ssim"][k].item() == structural_similarity(a, b, data_range=1)
        assert scores["mae"][k].item() == pytest.approx(np.abs(a - b).mean(), rel=1e-12)


def test_equal_spectra_score_one(pairs):
    scores = spectrum_scores(pairs[0], pairs[0])
    torch.testing.assert_close(scores["ssim"], torch.ones(5, dtype=torch.float64))
    assert not scores["mae"].any()


def test_predictions_may_carry_a_gradient(pairs):
    assert not spectrum_scores(pairs[0], pairs[1].requires_grad_())["mae"].requires_grad


def test_summary_is_that_of_numpy():
    ssim, mae = np.random.default_rng(0).random((2, 17))
    summary = summarise_spectra({"ssim": torch.tensor(ssim), "mae": torch.tensor(mae)})
    expected = {
        "ssim_median": np.median(ssim),
        "ssim_mean": ssim.mean(),
        "ssim_p10": np.percentile(ssim, 10),
        "ssim_p90": np.percentile(ssim, 90),
        "mae": mae.mean(),
    }
    assert list(summary) == list(expected)
    assert summary == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("labels", "predictions", "message"),
    [
        (torch.zeros(9, 9), torch.zeros(9, 9), r"must both be \(k, rows, columns\), got \(9, 9\)"),
        (torch.zeros(2, 9, 9), torch.zeros(1, 9, 9), r"got \(2, 9, 9\) and \(1, 9, 9\)"),
        (torch.zeros(2, 6, 9), torch.zeros(2, 6, 9), r"at least 7 x 7 pixels, got \(6, 9\)"),
        (torch.zeros(3, 9, 9), torch.zeros(3, 9, 9).index_fill(0, torch.tensor([1]), torch.nan), "in number 1"),
        (torch.full((1, 9, 9), torch.inf), torch.zeros(1, 9, 9), "labels must be finite"),
    ],
)
def test_unusable_spectra_are_refused(labels, predictions, message):
    with pytest.raises(ValueError, match=message):
        spectrum_scores(labels, predictions)


def test_nothing_to_summarise_is_refused():
    with pytest.raises(ValueError, match="at least one sample"):
        summarise_spectra(spectrum_scores(torch.zeros(0, 9, 9), torch.zeros(0, 9, 9)))


def test_rssi_is_scored_in_db():
    labels, predictions = torch.tensor([-50.0, -60.0, -70.0, -80.0]), torch.tensor([-49.0, -62.0, -70.0, -75.0])
    scores = rssi_scores(labels, predictions)
    assert scores["mae_db"].tolist() == [1, 2, 0, 5]
    assert summarise_rssi(scores) == {"mae_db": 2, "median_ae_db": 1.5, "rmse_db": pytest.approx(7.5**0.5)}


@pytest.mark.parametrize(
    ("labels", "predictions", "message"),
    [
        (torch.zeros(3), torch.zeros(4), r"must both be \(k,\), got \(3,\) and \(4,\)"),
        (torch.zeros(3, 1), torch.zeros(3, 1), r"must both be \(k,\)"),
        (torch.zeros(3), torch.tensor([0, torch.nan, 0]), "predictions must be finite, got NaN or infinity in 1 of 3"),
    ],
)
def test_impossible_rssi_is_refused(labels, predictions, message):
    with pytest.raises(ValueError, match=message):
        rssi_scores(labels, predictions)
    with pytest.raises(ValueError, match="at least one sample, got none"):
        summarise_rssi(rssi_scores(torch.zeros(0), torch.zeros(0)))
