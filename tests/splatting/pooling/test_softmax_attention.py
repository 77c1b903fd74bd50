"""Attention over the map against the paper's formula, its limits, and extreme maps."""

import pytest
import torch

from gaigs.core.query import Query
from gaigs.registry import registry
from gaigs.splatting.pooling.softmax_attention import SoftmaxAttention

LEARN = pytest.mark.parametrize("learn", [False, True])


def paper(image, temperature, prior):
    """The paper's formula step by step, in float64."""
    m = image.double().flatten(1)
    z = (m - m.mean(1, keepdim=True)) / temperature
    z = z - z.amax(1, keepdim=True)
    weights = (1 - prior) * z.exp() / z.exp().sum(1, keepdim=True) + prior / m.shape[1]
    return 10 * (weights * m).sum(1)


def attention(temperature, prior, learn=False):
    return SoftmaxAttention([6, 9], float(temperature), float(prior), learn)


def pool(pooling, image):
    return pooling(
        image,
        Query(torch.full((len(image), 3), torch.nan), torch.zeros(len(image), dtype=torch.long)),
    )


def graded(pooling, image):
    """Label and gradients of a map, in its dtype."""
    image = image.detach().requires_grad_()
    label = pool(pooling, image)
    label.sum().backward()
    return label.detach(), image.grad


@pytest.fixture
def image():
    return torch.randn(3, 1, 6, 9, generator=torch.Generator().manual_seed(0))


@LEARN
def test_levels_far_beyond_the_temperature_do_not_overflow(learn):
    image = torch.full((1, 1, 6, 9), 1e33)
    image[0, 0, 2, 3] = 2e33
    label, gradient = graded(attention(1e-6, 1e-3, learn), image)
    assert label.item() == pytest.approx(10 * 2e33 * 0.999 + 10 * 1e33 * (55 / 54) * 1e-3, rel=1e-5)
    assert gradient.isfinite().all()


@LEARN
@pytest.mark.parametrize(("temperature", "prior"), [(0.434, 0.1), (3.0, 0.0), (0.05, 0.7)])
def test_it_is_the_formula_of_the_paper(image, temperature, prior, learn):
    if learn and prior == 0:
        prior = 1e-3
    pooling = attention(temperature, prior, learn)
    torch.testing.assert_close(
        pool(pooling, image).double(), paper(image, temperature, prior), rtol=1e-5, atol=1e-5
    )


def test_limits(image):
    mean, most = 10 * image.mean((1, 2, 3)), 10 * image.amax((1, 2, 3))
    for pooling, limit in (
        (attention(0.434, 1), mean),
        (attention(1e6, 0), mean),
        (attention(1e-6, 0), most),
        (attention(1e-6, 0.25), 0.75 * most + 0.25 * mean),
    ):
        torch.testing.assert_close(pool(pooling, image), limit, rtol=1e-5, atol=1e-4)


def test_the_prior_gives_every_pixel_a_gradient():
    image = torch.zeros(1, 1, 3, 4)
    image[..., 0, 0] = 1e3
    for prior in (0, 0.24):
        _, gradient = graded(attention(0.434, prior), image)
        assert gradient[0, 0, 1:].flatten().tolist() == pytest.approx([10 * prior / 12] * 8)


@LEARN
def test_gradients_are_the_derivatives(image, learn):
    pooling = attention(0.434, 0.1, learn).double()
    leaves = [image[:, :, :3, :4].double().requires_grad_(), *pooling.parameters()]
    assert len(leaves) == (3 if learn else 1)
    assert torch.autograd.gradcheck(lambda image, *_: pool(pooling, image), leaves)


def test_one_deep_hole_does_not_blur_the_attention():
    image = torch.tensor([0.0, 1.0, 2.0, -1e9]).reshape(1, 1, 2, 2)
    label, _ = graded(attention(0.434, 0), image)
    torch.testing.assert_close(
        label, pool(attention(0.434, 0), image[..., :3].flatten()[None, None, None, :3])
    )


@pytest.mark.parametrize("target", [-100.0, 100.0])
@pytest.mark.parametrize("rate", [0.01, 10.0])
def test_training_moves_temperature_and_prior_within_their_ranges(target, rate):
    pooling = attention(0.434, 0.1, learn=True)
    image = torch.tensor([0.0, 1.0, 2.0, 3.0]).reshape(1, 1, 2, 2)
    before = pool(pooling, image).item(), pooling.temperature.item(), pooling.prior.item()
    optimizer = torch.optim.SGD(pooling.parameters(), lr=rate)
    for _ in range(20):
        optimizer.zero_grad()
        (pool(pooling, image) - target).abs().sum().backward()
        optimizer.step()
        assert 0 < pooling.temperature < torch.inf
        assert 0 <= pooling.prior <= 1
    label, temperature, prior = (
        pool(pooling, image).item(),
        pooling.temperature.item(),
        pooling.prior.item(),
    )
    louder = target > before[0]
    assert [label > before[0], temperature < before[1], prior < before[2]] == [louder] * 3


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"temperature": 0.0}, "temperature must lie between 1e-6 and 1e6 bels, got 0.0"),
        ({"prior": -0.1}, "prior must lie between 0 and 1, got -0.1"),
        ({"prior": 1.0, "learn": True}, "a learnt prior must start between 0 and 1, got 1.0"),
        ({"prior": 0.0, "learn": True}, "a learnt prior must start between 0 and 1, got 0.0"),
        ({"grid": [4]}, r"pooling.grid must be \[rows, columns\], got \[4\]"),
        ({"grid": [1, 8]}, "at least 2 rows and 3 columns, got 1 x 8"),
    ],
)
def test_options_out_of_range_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        registry("pooling").build({"name": "softmax_attention", **options})
