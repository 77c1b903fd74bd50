"""Rasterizers on arbitrary splats: the formula in float64, the order of the input, bounds of what is let through."""

import functools
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from strategies import cast, drawings, seeds

from gaigs.projection import Splats
from gaigs.rasterizer import ALPHA_MAX, ALPHA_MIN
from gaigs.registry import registry
from gaigs.testing.rasterizer import rasterize_densely

DRAWING = [name for name in registry("rasterizer").names() if name != "fastest"]
"""``fastest`` is one of the others."""


@functools.cache
def build(name):
    try:
        return registry("rasterizer").build({"name": name})
    except (ImportError, RuntimeError) as error:
        pytest.skip(str(error))


def sure(arguments):
    """Pixels where no a G is so near to a bound that precisions may rightly decide differently."""
    splats, _, opacities, _, plane = arguments
    near = torch.zeros(len(opacities), *plane.shape, dtype=torch.bool)
    for i in range(len(splats.depths)):
        parts = splats.means2d[[i]], splats.factors[:, [i]], splats.depths[[i]], splats.visible[[i]]
        full = torch.full((1, 1), ALPHA_MAX, dtype=torch.float64)
        footprint = rasterize_densely(Splats(*parts), torch.ones(1, 1, 1), full, None, plane)[0][:, 0] / ALPHA_MAX
        product = opacities[:, i, None, None] * footprint
        for bound in (ALPHA_MIN, ALPHA_MAX):
            near |= (product / bound - 1).abs() < 1e-3
    return ~near


@pytest.mark.parametrize("name", DRAWING)
@given(drawings())
def test_a_map_is_that_of_the_formula(name, arguments):
    rasterizer = build(name)
    arguments = cast(cast(arguments, torch.float32), torch.float64)
    image, left = rasterize_densely(*arguments)
    found, passed = rasterizer(*cast(arguments, torch.float32))
    certain = sure(arguments)
    assert ((found - image).abs() * certain[:, None]).max() < 2e-4
    assert ((passed - left).abs() * certain).max() < 2e-4


@pytest.mark.parametrize("name", DRAWING)
@given(drawings(), seeds)
def test_the_order_of_the_input_does_not_matter(name, arguments, seed):
    """Where no two splats are equally far."""
    rasterizer = build(name)
    splats, signal, opacities, attenuations, plane = cast(arguments, torch.float32)
    splats = replace(splats, depths=splats.depths + 1e-3 * torch.arange(len(splats.depths)))
    order = torch.randperm(len(splats.depths), generator=torch.Generator().manual_seed(seed))
    mixed = Splats(splats.means2d[order], splats.factors[:, order], splats.depths[order], splats.visible[order])
    lets = None if attenuations is None else attenuations[:, order]
    found = rasterizer(splats, signal, opacities, attenuations, plane)
    again = rasterizer(mixed, signal[:, order], opacities[:, order], lets, plane)
    for one, two in zip(found, again, strict=True):
        torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", DRAWING)
@given(drawings())
def test_what_is_let_through_and_what_is_taken_make_at_most_the_whole(name, arguments):
    rasterizer = build(name)
    splats, signal, opacities, attenuations, plane = cast(arguments, torch.float32)
    image, left = rasterizer(splats, torch.ones_like(signal), opacities, attenuations, plane)
    assert left.ge(0).all()
    assert left.le(1).all()
    assert image.ge(0).all()
    assert (image[:, 0] + left).le(1 + 1e-5).all()
    if attenuations is None:
        torch.testing.assert_close(image[:, 0] + left, torch.ones_like(left), rtol=0, atol=1e-5)
    _, further = rasterizer(splats, signal, opacities * 0.5, attenuations, plane)
    assert further.ge(left - 1e-5).all()
    silent, _ = rasterizer(splats, 0 * signal, opacities, attenuations, plane)
    assert not silent.any()
