"""Mean power over the sphere against float64, and on maps on which logarithms break."""

import math

import pytest
import torch

from gaigs.geometry import Grid
from gaigs.pooling.mean_power import MeanPower
from gaigs.pooling.path_rssi import PathRssi
from gaigs.query import Query
from gaigs.testing import example_links

SHAPE = (6, 9)
CHANNELS = pytest.mark.parametrize("channels", [1, 2])


def mean_power(channels, floor_db, shape=SHAPE):
    return MeanPower([*shape], channels, floor_db)


def pool(pooling, image):
    """What the pooling gives for maps; it looks at no query."""
    return pooling(image, Query(torch.full((len(image), 3), torch.nan), torch.zeros(len(image), dtype=torch.long)))


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
    """A cap that fills a quarter of the sphere, from the zenith down to 30 degrees, heard at 1."""
    shape = (40, 6)
    cap = (Grid.sphere(*shape).elevations > math.pi / 6).float()[:, None].expand(shape)
    level = pool(mean_power(1, -300, shape), cap[None, None]).item()
    assert level == pytest.approx(10 * math.log10(0.25), abs=1e-3)


@CHANNELS
def test_a_uniform_map_has_its_own_power(channels):
    label = pool(mean_power(channels, -300), torch.full((2, channels, *SHAPE), 0.1))
    assert label.tolist() == pytest.approx([-20 + 10 * math.log10(channels)] * 2, abs=1e-4)


@CHANNELS
@pytest.mark.parametrize("shape", [SHAPE, (2, 3)])
@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_silence_is_the_floor_with_a_gradient_of_zero(channels, shape, dtype):
    silence = torch.zeros(2, channels, *shape, dtype=dtype)
    for floor_db in (0, -60, -300):
        label, gradient = graded(mean_power(channels, floor_db, shape), silence)
        assert label.tolist() == pytest.approx([floor_db] * 2, abs=1e-4)
        assert torch.equal(gradient, torch.zeros_like(gradient))


def test_the_floor_adds_as_power():
    levels = torch.tensor([1.0, 1e-3, 1e-5]).reshape(3, 1, 1, 1).expand(-1, -1, *SHAPE)
    assert pool(mean_power(1, -60), levels).tolist() == pytest.approx([0, -60 + 10 * math.log10(2), -60], abs=1e-3)


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


def test_a_map_of_another_size_is_refused():
    with pytest.raises(ValueError, match=r"built for maps of \(6, 9\) pixels, got \(1, 9\); build it with"):
        pool(mean_power(1, -60), torch.ones(2, 1, 1, 9))


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
        mean_power(channels, floor_db)


def test_its_grid_is_the_sphere_in_equal_pixels():
    pooling = mean_power(2, -60)
    torch.testing.assert_close(pooling.grid.vectors(), Grid.sphere(*SHAPE).vectors())
    assert pooling.zone == (-math.pi / 2, math.pi / 2)
    with pytest.raises(ValueError, match="at least 2 rows and 3 columns, got 1 x 9"):
        mean_power(2, -60, (1, 9))


# --- paths ---


def read(floor_db, powers):
    """The level of powers at an array of 3 x 3 elements, whose 25 lags have lag 0 in the middle."""
    lags = torch.zeros(len(powers), 25, dtype=torch.complex128)
    lags[:, 12] = torch.tensor(powers, dtype=torch.float64)
    lags[:, :12] = 1e3  # which no power depends on
    query = Query(torch.zeros(len(powers), 3), torch.zeros(len(powers), dtype=torch.long))
    return PathRssi(example_links("rssi").scene, floor_db).read(lags, query)


def test_the_power_of_paths_falls_with_the_square_of_the_distance():
    near, far = read(-300.0, [(1 / 3.0) ** 2, (1 / 6.0) ** 2]).tolist()
    assert near == pytest.approx(-20 * math.log10(3.0))
    assert near - far == pytest.approx(6.0206, abs=1e-4)


def test_silent_paths_are_at_the_floor():
    assert read(-60.0, [0.0, 1e-6]).tolist() == pytest.approx([-60.0, -60.0 + 10 * math.log10(2)])
    with pytest.raises(ValueError, match="floor_db must lie between -300 and 0 dB, got 1"):
        read(1.0, [0.0])
