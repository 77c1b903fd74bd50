"""Mean power over the sphere against float64, and at the floor."""

import math

import pytest
import torch

from gaigs.core.geometry import Grid
from gaigs.core.query import Query
from gaigs.splatting.pooling.mean_power import MeanPower
from gaigs.splatting.pooling.path_rssi import PathRssi
from gaigs.testing import example_links

SHAPE = (6, 9)
CHANNELS = pytest.mark.parametrize("channels", [1, 2])


def mean_power(channels, floor_db, shape=SHAPE):
    return MeanPower([*shape], channels, float(floor_db))


def pool(pooling, image):
    return pooling(
        image,
        Query(torch.full((len(image), 3), torch.nan), torch.zeros(len(image), dtype=torch.long)),
    )


def formula(image, floor_db):
    """The definition, in float64, over pixels of equal solid angle."""
    return 10 * (image.double().square().sum(1).mean((1, 2)) + 10 ** (floor_db / 10)).log10()


def graded(pooling, image):
    """Label and gradients of a map, in its dtype."""
    image = image.detach().requires_grad_()
    label = pool(pooling, image)
    label.sum().backward()
    return label.detach(), image.grad


def draw(channels, shape=SHAPE):
    return torch.randn(3, channels, *shape, generator=torch.Generator().manual_seed(0))


@CHANNELS
def test_it_is_the_formula(channels):
    for scale in (1, 1e-3):
        image = scale * draw(channels)
        found = pool(mean_power(channels, -60), image)
        torch.testing.assert_close(found.double(), formula(image, -60), rtol=0, atol=1e-4)


def test_a_beam_brings_its_share_of_the_sphere():
    """A cap of a quarter of the sphere, heard at 1."""
    shape = (40, 6)
    cap = (Grid.sphere(*shape).elevations > math.pi / 6).float()[:, None].expand(shape)
    level = pool(mean_power(1, -300, shape), cap[None, None]).item()
    assert level == pytest.approx(10 * math.log10(0.25), abs=1e-3)


@CHANNELS
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_silence_is_the_floor_with_a_gradient_of_zero(channels, dtype):
    for floor_db in (0, -60, -300):
        label, gradient = graded(
            mean_power(channels, floor_db), torch.zeros(2, channels, *SHAPE, dtype=dtype)
        )
        assert label.tolist() == pytest.approx([floor_db] * 2, abs=1e-4)
        assert torch.equal(gradient, torch.zeros_like(gradient))


def test_the_floor_adds_as_power():
    levels = torch.tensor([1.0, 1e-3, 1e-5]).reshape(3, 1, 1, 1).expand(-1, -1, *SHAPE)
    assert pool(mean_power(1, -60), levels).tolist() == pytest.approx(
        [0, -60 + 10 * math.log10(2), -60], abs=1e-3
    )


@CHANNELS
def test_gradients_are_the_derivatives(channels):
    pooling = mean_power(channels, -60).double()
    image = draw(channels).double()
    for scale in (1, 1e-3):
        leaf = (scale * image).requires_grad_()
        assert torch.autograd.gradcheck(lambda image: pool(pooling, image), leaf, eps=1e-6 * scale)


def test_a_map_does_not_depend_on_louder_ones_in_its_batch():
    image = draw(1) * torch.tensor([1e-3, 1, 1e9])[:, None, None, None]
    pooling = mean_power(1, -60)
    each = torch.cat([pool(pooling, one[None]) for one in image])
    torch.testing.assert_close(pool(pooling, image), each, rtol=0, atol=0)


def test_options_out_of_range_and_maps_of_another_size_are_refused():
    with pytest.raises(ValueError, match=r"maps must have \(6, 9\) pixels, got \(1, 9\)"):
        pool(mean_power(1, -60), torch.ones(2, 1, 1, 9))
    with pytest.raises(ValueError, match="1 real or 2 complex channels, got channels=3"):
        mean_power(3, -60)
    for floor_db in (10, -math.inf, math.nan):
        with pytest.raises(
            ValueError, match=f"floor_db must lie between -300 and 0 dB, got {floor_db}"
        ):
            mean_power(1, floor_db)


def read(floor_db, powers):
    """The level of powers at an array of 3 x 3 elements, where lag 0 is in the middle of 25."""
    lags = torch.zeros(len(powers), 25, dtype=torch.complex128)
    lags[:, 12] = torch.tensor(powers, dtype=torch.float64)
    lags[:, :12] = 1e3
    query = Query(torch.zeros(len(powers), 3), torch.zeros(len(powers), dtype=torch.long))
    return PathRssi(example_links("rssi").scene, floor_db).read(lags, query)


def test_the_power_of_paths_falls_with_the_square_of_the_distance():
    near, far = read(-300.0, [(1 / 3.0) ** 2, (1 / 6.0) ** 2]).tolist()
    assert near == pytest.approx(-20 * math.log10(3.0))
    assert near - far == pytest.approx(6.0206, abs=1e-4)


def test_silent_paths_are_at_the_floor():
    assert read(-60.0, [0.0, 1e-6]).tolist() == pytest.approx([-60.0, -60.0 + 10 * math.log10(2)])
