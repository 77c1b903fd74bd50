"""Mean power over the sphere against float64, on an uneven grid, and on maps on which logarithms break."""

import math

import pytest
import torch

from gaigs.data import Grid
from gaigs.pooling.mean_power import MeanPower

SPHERE = Grid.sphere(6, 9)
PIXEL = Grid(torch.tensor([0.3]), torch.tensor([0.5]))
CHANNELS = pytest.mark.parametrize("channels", [1, 2])


def formula(image, weights, floor_db):
    """The definition, in float64."""
    power = (image.double().square().sum(1) * weights.double()).sum((1, 2)) / weights.double().sum()
    return 10 * (power + 10 ** (floor_db / 10)).log10()


def graded(pooling, image):
    """Label and gradients of a map, in its dtype."""
    image = image.detach().requires_grad_()
    label = pooling(image)
    label.sum().backward()
    return label.detach(), image.grad


def draw(channels, *shape):
    return torch.randn(3, channels, *shape, generator=torch.Generator().manual_seed(0))


@CHANNELS
def test_it_is_the_formula(channels):
    for scale in (1, 1e-3):
        image = scale * draw(channels, *SPHERE.shape)
        expected = formula(image, torch.ones(SPHERE.shape), -60)
        torch.testing.assert_close(MeanPower(SPHERE, channels, -60)(image).double(), expected, rtol=0, atol=1e-4)


def test_rows_weigh_by_their_solid_angle():
    grid = Grid.degrees(range(5, 90, 10), range(0, 360, 30))
    image = draw(2, *grid.shape)
    # A row of 10 degrees at elevation e spans sin(e + 5 deg) - sin(e - 5 deg), which goes as cos e.
    expected = formula(image, grid.elevations.cos()[:, None].expand(grid.shape), -60)
    torch.testing.assert_close(MeanPower(grid, 2, -60)(image).double(), expected, rtol=0, atol=0.02)
    assert (expected - formula(image, torch.ones(grid.shape), -60)).abs().max() > 0.1


def test_a_single_row_weighs_evenly():
    grid = Grid(torch.tensor([0.3]), torch.arange(4.0))
    image = torch.tensor([1.0, 2, 3, 4]).reshape(1, 1, 1, 4)
    assert MeanPower(grid, 1, -60)(image).item() == pytest.approx(10 * math.log10(7.5), abs=1e-4)


@CHANNELS
def test_a_uniform_map_has_its_own_power(channels):
    label = MeanPower(SPHERE, channels, -300)(torch.full((2, channels, *SPHERE.shape), 0.1))
    assert label.tolist() == pytest.approx([-20 + 10 * math.log10(channels)] * 2, abs=1e-4)


def test_the_phase_does_not_matter():
    image = draw(2, *SPHERE.shape)
    pooling = MeanPower(SPHERE, 2, -60)
    torch.testing.assert_close(pooling(torch.stack((-image[:, 1], image[:, 0]), 1)), pooling(image))


@CHANNELS
@pytest.mark.parametrize("grid", [SPHERE, PIXEL], ids=["sphere", "pixel"])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_silence_is_the_floor_with_a_gradient_of_zero(channels, grid, dtype):
    silence = torch.zeros(2, channels, *grid.shape, dtype=dtype)
    for floor_db in (0, -60, -300):
        label, gradient = graded(MeanPower(grid, channels, floor_db), silence)
        assert label.tolist() == pytest.approx([floor_db] * 2, abs=1e-4)
        assert torch.equal(gradient, torch.zeros_like(gradient))


def test_the_floor_adds_as_power():
    pooling = MeanPower(PIXEL, 1, -60)
    levels = torch.tensor([1.0, 1e-3, 1e-5]).reshape(3, 1, 1, 1)
    assert pooling(levels).tolist() == pytest.approx([0, -60 + 10 * math.log10(2), -60], abs=1e-3)


@CHANNELS
def test_gradients_are_the_derivatives(channels):
    pooling = MeanPower(SPHERE, channels, -60).double()
    image = draw(channels, *SPHERE.shape).double()
    for scale in (1, 1e-3):
        assert torch.autograd.gradcheck(pooling, (scale * image).requires_grad_(), eps=1e-6 * scale)


@CHANNELS
@pytest.mark.parametrize("level", [1e-25, 1, 1e25])
def test_twelve_decades_against_float64_wherever_they_lie(channels, level):
    decades = torch.logspace(-6, 6, 3 * channels * 54).reshape(3, channels, *SPHERE.shape)
    image = level * torch.randn(decades.shape, generator=torch.Generator().manual_seed(0)).sign() * decades
    pooling = MeanPower(SPHERE, channels, -300)
    label, gradient = graded(pooling, image)
    twin, twin_gradient = graded(MeanPower(SPHERE, channels, -300).double(), image.double())
    torch.testing.assert_close(label.double(), formula(image, torch.ones(SPHERE.shape), -300), rtol=1e-5, atol=1e-4)
    torch.testing.assert_close(label.double(), twin, rtol=1e-6, atol=1e-4)
    torch.testing.assert_close(gradient.double(), twin_gradient, rtol=1e-4, atol=0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_summed_in_float32(dtype):
    pooling = MeanPower(SPHERE, 2, -60)
    for scale in (1e4, 1, 1e-4):
        image = (scale * draw(2, *SPHERE.shape)).to(dtype)
        label, gradient = graded(pooling, image)
        true, true_gradient = graded(pooling, image.float())
        assert label.dtype == torch.float32
        assert torch.equal(label, true)
        torch.testing.assert_close(gradient, true_gradient.to(dtype))


def test_a_map_does_not_depend_on_louder_ones_in_its_batch():
    image = draw(1, *SPHERE.shape) * torch.tensor([1e-3, 1, 1e9])[:, None, None, None]
    pooling = MeanPower(SPHERE, 1, -60)
    torch.testing.assert_close(pooling(image), torch.cat([pooling(one[None]) for one in image]), rtol=0, atol=0)


def test_a_map_of_another_size_is_refused():
    with pytest.raises(ValueError, match=r"built for maps of \(6, 9\) pixels, got \(1, 9\); build it with"):
        MeanPower(SPHERE, 1, -60)(torch.ones(2, 1, 1, 9))


@pytest.mark.parametrize(
    ("channels", "floor_db", "message"),
    [
        (3, -60, "1 real or 2 complex channels, got channels=3"),
        (0, -60, "1 real or 2 complex channels, got channels=0"),
        (1, 10, "floor_db must lie between -300 and 0 dB, got 10"),
        (1, -math.inf, "floor_db must lie between -300 and 0 dB, got -inf"),
        (1, math.nan, "floor_db must lie between -300 and 0 dB, got nan"),
    ],
)
def test_options_out_of_range_are_refused(channels, floor_db, message):
    with pytest.raises(ValueError, match=message):
        MeanPower(SPHERE, channels, floor_db)
