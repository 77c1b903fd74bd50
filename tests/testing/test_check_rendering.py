"""Checks of projections and rasterizers find what is broken."""

from dataclasses import replace

import pytest
import torch
from torch import nn

from gaigs.projection import Plane
from gaigs.projection.direction_cosine import DirectionCosine
from gaigs.projection.equirectangular import Equirectangular
from gaigs.projection.mercator import Mercator
from gaigs.rasterizer.torch import TorchRasterizer
from gaigs.testing import check_projection, check_rasterizer


class Skewed(Mercator):
    def jacobian(self, points):
        return super().jacobian(points) * torch.tensor([[1.0], [1.001]]).to(points)


class Unclamped(Equirectangular):
    def jacobian(self, points):
        azimuth, elevation = super().jacobian(points).unbind(-2)
        azimuth = nn.functional.normalize(azimuth, dim=-1) / points[..., :2].norm(dim=-1, keepdim=True)
        return torch.stack((azimuth, elevation), -2)


class Shifted(Equirectangular):
    def plane(self, directions):
        plane = super().plane(directions)
        return replace(plane, v=plane.v + 1e-6)


class Unwrapping(Equirectangular):
    def plane(self, directions):
        return replace(super().plane(directions), period=None)


class Gridded(Mercator):
    """Takes a list of rays for rows and columns."""

    def plane(self, directions):
        plane = super().plane(directions)
        return Plane(plane.u, plane.v.reshape(-1, 1), plane.period)


class Single(DirectionCosine):
    def plane(self, directions):
        plane = super().plane(directions)
        return Plane(plane.u.float(), plane.v.float(), None)


class Hiding(Mercator):
    def project(self, means, semi_axes, receiver):
        splats = super().project(means, semi_axes, receiver)
        return replace(splats, visible=splats.depths < 100)


@pytest.mark.parametrize(
    ("projection", "message"),
    [
        (Skewed, "jacobian must be the derivative of coordinates"),
        (Unclamped, "factors at hard places must be finite"),
        (Shifted, "plane.v must be coordinates' v"),
        (Unwrapping, "a plane must have the projection's period"),
        (Gridded, r"plane.v of a list of rays must be of shape \(1, 1\) or \(1, 108\), got \(108, 1\)"),
        (Single, "a plane must be of its directions' dtype"),
        (Hiding, "only what sits on the receiver is hidden"),
    ],
)
def test_a_broken_projection_is_found(projection, message):
    with pytest.raises(AssertionError, match=message):
        check_projection(projection(0.02))


class Unwrapped(TorchRasterizer):
    def __call__(self, splats, signal, opacities, attenuations, plane):
        return super().__call__(splats, signal, opacities, attenuations, replace(plane, period=None))


class Unsorted(TorchRasterizer):
    def __call__(self, splats, *others):
        return super().__call__(replace(splats, depths=torch.zeros_like(splats.depths)), *others)


class Clear(TorchRasterizer):
    def __call__(self, splats, signal, opacities, attenuations, plane):
        return super().__call__(splats, signal, opacities, None, plane)


class Frozen(TorchRasterizer):
    def __call__(self, splats, *others):
        return super().__call__(replace(splats, means2d=splats.means2d.detach()), *others)


class Culling(TorchRasterizer):
    def __call__(self, splats, signal, *others):
        return super().__call__(splats, signal.nan_to_num(), *others)


class Rounding(TorchRasterizer):
    def __call__(self, *arguments):
        return (result.float() for result in super().__call__(*arguments))


class Mixing(TorchRasterizer):
    def __call__(self, *arguments):
        image, left = super().__call__(*arguments)
        return image + 1e-2 * (len(image) - 2), left


class Narrow(TorchRasterizer):
    """Draws eight channels, and repeats the first beyond."""

    def __call__(self, splats, signal, *others):
        drawn = torch.cat((signal[..., :8], signal[..., :1].expand_as(signal)[..., 8:]), -1)
        return super().__call__(splats, drawn, *others)


class Nameless(TorchRasterizer):
    used = None


@pytest.mark.parametrize(
    ("rasterizer", "message"),
    [
        (Unwrapped, "random: map must be that of the formula"),
        (Unsorted, "random: map must be that of the formula"),
        (Clear, "attenuations: map must be that of the formula"),
        (Frozen, "random: gradient of means2d must be that of the formula"),
        (Culling, "NaN in signal must show as NaN in the map"),
        (Rounding, r"random: map must be torch\.float64 as its input, got torch\.float32"),
        (Mixing, "random: a map must not depend on other transmitters"),
        (Narrow, "many channels: map must be that of the formula"),
        (Nameless, "used must say what drew the map, got None"),
    ],
)
def test_a_broken_rasterizer_is_found(rasterizer, message):
    with pytest.raises(AssertionError, match=message):
        check_rasterizer(rasterizer())
