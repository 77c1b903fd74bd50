"""The training loss against scikit-image, and its gradients."""

import pytest
import torch
from skimage.metrics import structural_similarity as skimage_ssim
from torch import nn

from gaigs.model import Batch, Prediction
from gaigs.training.losses import RssiLoss, spectrum_loss, structural_similarity


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(0)
    labels = torch.rand(4, 20, 33, generator=generator, dtype=torch.float64)
    return labels + 0.3 * torch.randn(4, 20, 33, generator=generator, dtype=torch.float64), labels


def as_arrays(pair):
    return [values.numpy() for values in pair]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
@pytest.mark.parametrize("window", [3, 7, 11])
def test_ssim_is_scikit_images(pair, window, dtype, tolerance):
    expected = [skimage_ssim(*both, data_range=1.0, win_size=window) for both in zip(*as_arrays(pair), strict=True)]
    predictions, labels = (values.to(dtype) for values in pair)
    similarity = structural_similarity(predictions, labels, window)
    assert similarity.item() == pytest.approx(sum(expected) / 4, abs=tolerance)


def test_on_the_full_grid_the_loss_is_that_of_the_reported_scores(pair):
    predictions, labels = pair
    terms = spectrum_loss(predictions, labels)
    reported = [skimage_ssim(*both, data_range=1.0) for both in zip(*as_arrays(pair), strict=True)]
    assert 1 - terms["ssim"].item() == pytest.approx(sum(reported) / 4, abs=1e-12)
    assert terms["l1"].item() == pytest.approx((predictions - labels).abs().mean().item())


@pytest.mark.parametrize(("step", "window"), [(1, 7), (2, 5), (3, 3), (4, 3), (8, 3)])
def test_a_thinned_grid_is_looked_at_through_the_same_angle(pair, step, window):
    ssim = spectrum_loss(*pair, step)["ssim"]
    assert ssim == 1 - structural_similarity(*pair, window)


def test_equal_spectra_cost_nothing(pair):
    terms = spectrum_loss(pair[0], pair[0])
    assert terms["l1"] == 0
    assert terms["ssim"].item() == pytest.approx(0, abs=1e-12)


def test_gradients_are_those_of_finite_differences(pair):
    predictions, labels = (values[:1, :9, :8] for values in pair)
    ssim = lambda p: spectrum_loss(p, labels)["ssim"]
    assert torch.autograd.gradcheck(ssim, predictions.requires_grad_())


@pytest.mark.parametrize("prediction", [0.0, 0.5, 1.0, 1e3])
@pytest.mark.parametrize("label", [0.0, 0.5, 1.0])
def test_constant_images_have_finite_gradients(prediction, label):
    predictions = torch.full((2, 12, 12), prediction, requires_grad=True)
    terms = spectrum_loss(predictions, torch.full((2, 12, 12), label))
    (terms["l1"] + terms["ssim"]).backward()
    assert terms["ssim"].isfinite()
    assert predictions.grad.isfinite().all()
    if label != prediction < 2:
        assert (predictions.grad.sign() == (1 if prediction > label else -1)).all()


class Echo(nn.Module):
    """Predicts the first coordinate, and remembers where it was asked."""

    def forward(self, batch):
        self.asked = batch.transmitters
        return Prediction(batch.transmitters[:, 0], {})


def test_jitter_moves_a_place_alike_for_all_who_hear_it():
    places = torch.rand(500, 3, generator=torch.Generator().manual_seed(0))
    batch = Batch(places.repeat(2, 1), torch.arange(2).repeat_interleave(500), None, places[:, 0].repeat(2))
    model, loss = Echo(), RssiLoss("absolute", 5.0, jitter=0.4)
    value, terms, _ = loss(model, batch, torch.Generator().manual_seed(1))
    moves = (model.asked - batch.transmitters).view(2, 500, 3)
    assert torch.equal(moves[0], moves[1])
    assert moves.std().item() == pytest.approx(0.4, rel=0.05)
    assert value.item() == pytest.approx(moves[..., 0].abs().mean().item(), rel=1e-4)
    assert terms["mae_db"].item() == pytest.approx(value.item())
    again = model.asked
    loss(model, batch, torch.Generator().manual_seed(1))
    assert torch.equal(model.asked, again), "the generator decides"
    RssiLoss("absolute", 5.0, jitter=0.0)(model, batch, torch.Generator())
    assert torch.equal(model.asked, batch.transmitters)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("cubic", 5.0, 0.0), r"training\.loss\.kind must be absolute, squared or huber, got 'cubic'"),
        (("huber", 0.0, 0.0), r"training\.loss\.bend must be more than 0 dB, got 0"),
        (("huber", 5.0, -1.0), r"training\.loss\.jitter must be at least 0 m, got -1"),
    ],
)
def test_an_rssi_loss_refuses(options, message):
    with pytest.raises(ValueError, match=message):
        RssiLoss(*options)
