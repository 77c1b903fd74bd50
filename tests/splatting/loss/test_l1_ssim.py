"""The training loss of spectra against scikit-image, and its gradients."""

import pytest
import torch
from skimage.metrics import structural_similarity as skimage_ssim
from torch.nn.functional import avg_pool2d

from gaigs.core.geometry import Grid
from gaigs.core.query import Batch, Query
from gaigs.core.task.spectrum import Spectrum
from gaigs.splatting.loss.l1_ssim import L1Ssim, structural_similarity, window_means

GRID = Grid.degrees(range(20), range(33))
TASK = Spectrum(GRID.elevations, GRID.azimuths, "none")


@pytest.fixture
def pair():
    generator = torch.Generator().manual_seed(0)
    labels = torch.rand(4, *GRID.shape, generator=generator, dtype=torch.float64)
    return labels + 0.3 * torch.randn(
        4, *GRID.shape, generator=generator, dtype=torch.float64
    ), labels


def loss_of(values, labels, directions=GRID, task=TASK, ssim=0.2):
    """The loss and its terms."""
    query = Query(torch.zeros(len(labels), 3), torch.zeros(len(labels), dtype=torch.long))
    return L1Ssim(task, ssim)(values, Batch(query, directions, labels))


def as_arrays(pair):
    return [values.numpy() for values in pair]


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
@pytest.mark.parametrize("window", [3, 7, 11])
def test_ssim_is_scikit_images(pair, window, dtype, tolerance):
    expected = [
        skimage_ssim(*both, data_range=1.0, win_size=window)
        for both in zip(*as_arrays(pair), strict=True)
    ]
    values, labels = (part.to(dtype) for part in pair)
    similarity = structural_similarity(values, labels, window)
    assert similarity.item() == pytest.approx(sum(expected) / 4, abs=tolerance)


def test_on_the_full_grid_the_loss_is_that_of_the_reported_scores(pair):
    values, labels = pair
    loss, terms = loss_of(values, labels)
    reported = [skimage_ssim(*both, data_range=1.0) for both in zip(*as_arrays(pair), strict=True)]
    assert 1 - terms["ssim"].item() == pytest.approx(sum(reported) / 4, abs=1e-12)
    assert terms["l1"].item() == pytest.approx((values - labels).abs().mean().item())
    assert loss.item() == pytest.approx(0.8 * terms["l1"].item() + 0.2 * terms["ssim"].item())


@pytest.mark.parametrize(("step", "window"), [(1, 7), (2, 5), (3, 3), (4, 3), (6, 3)])
@pytest.mark.parametrize("first", [0, 1])
def test_the_window_spans_the_same_angle_on_a_thinned_grid(pair, step, window, first):
    part = slice(min(first, step - 1), None, step)
    thinned = [values[:, part, part] for values in pair]
    _, terms = loss_of(*thinned, GRID.thin(part, part))
    assert terms["ssim"] == 1 - structural_similarity(*thinned, window)


@pytest.mark.parametrize(
    ("rows", "stride", "window"),
    [(7, 2, 3), (9, 2, 3), (11, 2, 5), (5, 1, 5), (4, 1, 3), (3, 1, 3)],
)
def test_the_window_is_at_most_the_thinned_grid(rows, stride, window):
    """The last row and column on, which leaves the fewest."""
    grid = Grid.degrees(range(rows), range(40))
    part = slice(stride - 1, None, stride)
    values, labels = torch.rand(2, 3, rows, 40, generator=torch.Generator().manual_seed(0))[
        :, :, part, part
    ]
    task = Spectrum(grid.elevations, grid.azimuths, "none")
    _, terms = loss_of(values, labels, grid.thin(part, part), task)
    assert terms["ssim"] == 1 - structural_similarity(values, labels, window)


def test_gradients_are_those_of_finite_differences(pair):
    grid = GRID.thin(slice(9), slice(8))
    values, labels = (part[:1, :9, :8] for part in pair)

    def ssim(values):
        return loss_of(values, labels, grid)[1]["ssim"]

    assert torch.autograd.gradcheck(ssim, values.requires_grad_())


@pytest.mark.parametrize("value", [0.0, 0.5, 1.0, 1e3])
@pytest.mark.parametrize("label", [0.0, 0.5, 1.0])
def test_constant_images_have_finite_gradients(value, label):
    grid = GRID.thin(slice(12), slice(12))
    values = torch.full((2, 12, 12), value, requires_grad=True)
    _, terms = loss_of(values, torch.full((2, 12, 12), label), grid)
    (terms["l1"] + terms["ssim"]).backward()
    assert terms["ssim"].isfinite()
    assert values.grad.isfinite().all()
    if label != value < 2:
        assert (values.grad.sign() == (1 if value > label else -1)).all()


def test_single_directions_are_refused(pair):
    rays = [values.flatten(1)[:, :50] for values in pair]
    with pytest.raises(
        ValueError, match=r"needs rows and columns; with training\.thinning\.rays set loss=absolute"
    ):
        loss_of(*rays, GRID.flatten()[:50])


@pytest.mark.parametrize("rows", [1, 2])
def test_fewer_rows_than_a_window_are_refused(pair, rows):
    few = [values[:, :rows] for values in pair]
    with pytest.raises(ValueError, match=rf"at least 3 x 3 directions, got \({rows}, 33\)"):
        loss_of(*few, GRID.thin(slice(rows), slice(None)))


@pytest.mark.parametrize(
    ("shape", "window"),
    [
        ((2, 3, 9, 14), 3),
        ((1, 1, 7, 7), 7),
        ((3, 2, 8, 7), 5),
        ((0, 2, 6, 5), 3),
        ((2, 1, 4, 6), 1),
    ],
)
@pytest.mark.parametrize("transposed", [False, True])
def test_window_means_and_gradients_equal_mean_pooling(shape, window, transposed):
    torch.manual_seed(0)
    images = torch.randn(shape, dtype=torch.float64, requires_grad=True)
    seen = images.mT if transposed else images
    expected = (
        avg_pool2d(seen, window, stride=1) if len(images) else seen[..., window - 1 :, window - 1 :]
    )
    before, found = images.detach().clone(), window_means(seen, window)
    torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-13)
    assert torch.equal(images, before)
    weights = torch.randn_like(expected)
    gradients = [torch.autograd.grad(means, images, weights)[0] for means in (found, expected)]
    torch.testing.assert_close(*gradients, rtol=1e-12, atol=1e-13)
