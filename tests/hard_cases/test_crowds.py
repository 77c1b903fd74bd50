"""10,000 opaque splats in one pixel hide all behind them, without overflow of sums or gradients."""

import math

import pytest
import torch
from precision import build_rasterizer

from gaigs.registry import registry
from gaigs.splatting.projection import Plane, Splats
from gaigs.splatting.rasterizer import ALPHA_MAX

CROWD = 10_000
PLANE = Plane(
    torch.linspace(-0.1, 0.1, 5)[None], torch.linspace(-0.1, 0.1, 4)[:, None], 2 * math.pi
)
DRAWING = [name for name in registry("rasterizer").names() if name != "fastest"]
"""``fastest`` is one of the others."""


def drawn(name, dtype, opacity, attenuation, alike):
    """Map and transmittance of a crowd in the pixel at row 2, column 2, and its leaves."""
    rasterizer = build_rasterizer(name)
    if rasterizer is None:
        pytest.skip("OpenCL does not work here")
    middle = torch.stack((PLANE.u[0, 2], PLANE.v[2, 0])).to(dtype)
    leaves = {
        "means2d": middle.repeat(CROWD, 1),
        "factors": torch.tensor([1e-3, 0, 1e-3], dtype=dtype).repeat(1, CROWD, 1),
        "signal": torch.ones(1, CROWD, 1, dtype=dtype),
        "opacities": torch.full((1, CROWD), opacity, dtype=dtype),
        "attenuations": torch.full((1, CROWD), attenuation, dtype=dtype),
    }
    leaves = {part: leaf.requires_grad_() for part, leaf in leaves.items()}
    depths = (
        torch.full((CROWD,), 2.0, dtype=dtype)
        if alike
        else torch.linspace(1, 9, CROWD, dtype=dtype).flip(0)
    )
    splats = Splats(
        leaves["means2d"], leaves["factors"], depths, torch.ones(CROWD, dtype=torch.bool)
    )
    plane = Plane(PLANE.u.to(dtype), PLANE.v.to(dtype), PLANE.period)
    try:
        image, left = rasterizer(
            splats, leaves["signal"], leaves["opacities"], leaves["attenuations"], plane
        )
    except TypeError:
        if dtype == torch.float32:
            raise
        pytest.skip("takes float32 alone")
    return image, left, leaves


@pytest.mark.parametrize("name", DRAWING)
@pytest.mark.parametrize(
    ("dtype", "opacity", "attenuation", "alike"),
    [
        (torch.float32, 1.0, 1.0, True),
        (torch.float32, 0.02, 1.0, False),
        (torch.float64, 1.0, 0.0, False),
    ],
    ids=["equal depths", "hardly opaque", "float64"],
)
def test_a_crowd_in_one_pixel(name, dtype, opacity, attenuation, alike):
    image, left, leaves = drawn(name, dtype, opacity, attenuation, alike)
    # Each splat takes the share a of the remaining field: sum a (1 - a)^i d^i.
    a, d = min(opacity, ALPHA_MAX), attenuation
    expected = a / (1 - (1 - a) * d)
    assert image[0, 0, 2, 2].item() == pytest.approx(expected, abs=1e-4)
    assert left[0, 2, 2].item() == pytest.approx(0, abs=1e-30)
    elsewhere = torch.ones(4, 5, dtype=torch.bool)
    elsewhere[2, 2] = False
    assert not image[0, 0, elsewhere].any()
    assert (left[0, elsewhere] == 1).all()
    (image.sum() + left.sum()).backward()
    for part, leaf in leaves.items():
        assert leaf.grad.isfinite().all(), part
    front = 0 if alike else CROWD - 1
    assert leaves["signal"].grad[0, front, 0].item() == pytest.approx(a, rel=1e-4)
