"""The OpenCL rasterizer against the dense float64 one on scenes that its kernels treat in special
ways.
"""

import math
from dataclasses import replace

import pytest
import torch
from contracts.rasterizer import (
    cast_scene,
    distance_to_jumps,
    rasterize_densely,
    render_with_gradients,
)

from gaigs.core.geometry import Grid, Rays
from gaigs.splatting.projection import Plane, Splats
from gaigs.splatting.projection.direction_cosine import DirectionCosine
from gaigs.splatting.projection.mercator import Mercator
from gaigs.splatting.rasterizer.torch import TorchRasterizer

opencl = pytest.importorskip("gaigs.splatting.rasterizer.opencl", exc_type=ImportError)
pytestmark = pytest.mark.usefixtures("opencl_works")

VALUES, GRADIENTS = 2e-6, 2e-5
"""Tolerances, of the image's largest value and of each parameter's largest gradient."""


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """The dense rasterizer's many small steps are faster without waiting for each other's threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def grid(projection, rows=37, columns=60) -> Plane:
    return projection.plane(
        Grid(torch.linspace(0.02, 1.45, rows), torch.arange(columns) * (2 * math.pi / columns))
    )


def scattered(projection, rays=70) -> Plane:
    elevations, azimuths = torch.rand(2, rays, generator=torch.Generator().manual_seed(0))
    return projection.plane(Rays(1.5 * elevations, 2 * math.pi * azimuths))


def random_scene(
    n=60,
    b=3,
    c=2,
    own=False,
    attenuations=None,
    plane=None,
    spread=(0.05, 0.6),
    opacities=(0.0, 0.95),
    seed=0,
):
    """Splats all over the plane; ``spread`` bounds the standard deviations, log-uniform, along two
    random axes.
    """
    generator = torch.Generator().manual_seed(seed)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=generator)

    plane = plane or grid(Mercator(0.1))
    u = uniform(plane.u.min(), plane.u.max(), n)
    if plane.period is not None:
        u = (u + math.pi).remainder(
            plane.period
        ) - math.pi  # as atan2 gives azimuths, whatever the grid counts from
    angles = uniform(0, math.pi, b if own else 1, n)
    axes = torch.stack((angles.cos(), -angles.sin(), angles.sin(), angles.cos()), -1).unflatten(
        -1, (2, 2)
    )
    half = axes * uniform(*map(math.log, spread), len(angles), n, 2).exp()[..., None, :]
    splats = Splats(
        torch.stack((u, uniform(plane.v.min(), plane.v.max(), n)), -1),
        torch.linalg.cholesky(half @ half.mT)[..., [0, 1, 1], [0, 0, 1]],
        uniform(0.5, 5, n),
        uniform(0, 1, n) > 0.05,
    )
    signal = torch.randn(b, n, c, generator=generator)
    return (
        splats,
        signal,
        uniform(*opacities, b, n),
        attenuations and uniform(*attenuations, b, n),
        plane,
    )


def at_the_seam():
    splats, *others, plane = random_scene(spread=(0.02, 0.3))
    splats.means2d[:, 0] = (
        torch.linspace(-0.3, 0.3, 60).sub(math.pi).remainder(2 * math.pi).sub(math.pi)
    )
    return splats, *others, Plane(plane.u - math.pi, plane.v, plane.period)


def needles():
    """Diagonal splats forty times as long as wide."""
    splats, *others = random_scene()
    half = math.sqrt(0.5) * torch.tensor([[1.0, -1.0], [1.0, 1.0]]) * torch.tensor([0.8, 0.02])
    factors = torch.linalg.cholesky(half.double() @ half.double().mT)[[0, 1, 1], [0, 0, 1]].float()
    return replace(splats, factors=factors.repeat(1, 60, 1)), *others


def depths_of_either_sign():
    scene = random_scene()
    scene[0].depths.sub_(2.5)
    return scene


def points_on_pixels():
    """Each acts on the one pixel it is centred on, also at the edges of tiles."""
    plane = replace(grid(Mercator(0.1)), period=None)
    scene = random_scene(n=60, plane=plane, spread=(1e-9, 1e-9), opacities=(0.5, 0.9))
    scene[0].means2d.copy_(torch.stack((plane.u[0], plane.v[torch.arange(60) % 37, 0]), -1))
    scene[0].visible.fill_(True)
    return scene


def loud_behind_walls():
    """Every layer lets 0.3 through and the next is four times as loud."""
    splats, signal, *others = random_scene(n=24, b=1, spread=(20.0, 20.0), opacities=(0.7, 0.7))
    splats.depths[:] = torch.arange(24.0)
    return splats, signal * (4.0 ** torch.arange(24))[:, None], *others


def dark_in_half():
    """Light is used up at low v long before it is at high v: rows of one tile end at different
    depths.
    """
    scene = random_scene(n=300, b=1, spread=(0.2, 0.6), opacities=(0.3, 0.9))
    low = scene[-1].v.min()
    scene[0].means2d[:, 1] = low + 0.4 * (scene[0].means2d[:, 1] - low)
    return scene


def unsorted_plane():
    plane = grid(Mercator(0.1))
    shuffle = torch.Generator().manual_seed(0)
    u, v = (
        plane.u[:, torch.randperm(60, generator=shuffle)],
        plane.v[torch.randperm(37, generator=shuffle)],
    )
    return random_scene(plane=Plane(u, v, plane.period))


def twisted_plane():
    """A period, and rows that mix with columns."""
    u, v, period = vars(grid(Mercator(0.1))).values()
    return random_scene(plane=Plane(u + 0.3 * v.sin(), v + 0.2 * u.cos(), period))


SCENES = {
    "random": random_scene,
    "own covariances": lambda: random_scene(own=True),
    "no period": lambda: random_scene(plane=replace(grid(Mercator(0.1)), period=None)),
    "direction cosines, own": lambda: random_scene(
        plane=grid(DirectionCosine(0.1)), own=True, attenuations=(0.1, 1)
    ),
    "strong attenuation": lambda: random_scene(attenuations=(1e-6, 1e-2)),
    "eight channels": lambda: random_scene(c=8),
    "nine channels": lambda: random_scene(c=9, attenuations=(0.3, 1.0)),
    "many channels": lambda: random_scene(c=21, own=True, attenuations=(0.3, 1.0)),
    "many transmitters": lambda: random_scene(b=19, spread=(1.0, 2.0)),
    "depths of either sign": depths_of_either_sign,
    "points on pixels": points_on_pixels,
    "empty tiles": lambda: random_scene(n=5, spread=(0.03, 0.05)),
    "wider than the plane": lambda: random_scene(n=120, spread=(3.0, 30.0), opacities=(0.1, 0.3)),
    "needles": needles,
    "narrow and wide": lambda: random_scene(spread=(0.02, 2.0), seed=2),
    "nearly opaque": lambda: random_scene(
        n=120, spread=(0.3, 2.0), opacities=(0.8, 0.99), attenuations=(0.1, 1.0)
    ),
    "loud behind walls": loud_behind_walls,
    "dark in half": dark_in_half,
    "at the seam": at_the_seam,
    "unsorted plane": unsorted_plane,
    "twisted plane": twisted_plane,
    "one pixel": lambda: random_scene(plane=grid(Mercator(0.1), 1, 1)),
    "rays": lambda: random_scene(plane=scattered(Mercator(0.1)), attenuations=(0.3, 1.0)),
    "rays, own": lambda: random_scene(plane=scattered(DirectionCosine(0.1)), own=True),
}


def render(rasterizer, scene):
    """Map, transmittance and gradients away from jumps, where a G meets one of its bounds to within
    rounding.
    """
    pixels = distance_to_jumps(*scene) > 1e-5
    assert pixels.double().mean() > 0.99 or not pixels.numel()
    return render_with_gradients(rasterizer, scene, pixels)


def largest(tensor: torch.Tensor) -> float:
    return tensor.abs().max().item() if tensor.numel() else 0.0


@pytest.mark.parametrize("name", SCENES)
def test_values_and_gradients_are_those_of_the_dense_float64_rasterizer(name):
    found, true = (
        render(rasterizer, SCENES[name]())
        for rasterizer in (opencl.OpenCLRasterizer(), rasterize_densely)
    )
    assert found["map"].dtype == found["transmittance"].dtype == torch.float32
    for part, value in found.items():
        bound = 1 if part == "transmittance" else largest(true[part])
        tolerance = bound * (GRADIENTS if part.startswith("gradient") else VALUES)
        torch.testing.assert_close(
            value, true[part].float(), rtol=0, atol=tolerance, msg=lambda m, p=part: f"{p}: {m}"
        )


def test_an_attenuation_of_0_has_the_gradient_of_the_float64_rasterizer():
    scene = random_scene(attenuations=(0.0, 0.0))
    pixels = torch.ones(3, *scene[-1].shape, dtype=torch.bool)
    true = render_with_gradients(TorchRasterizer(), cast_scene(scene, "cpu", torch.float64), pixels)
    found = render_with_gradients(opencl.OpenCLRasterizer(), scene, pixels)
    assert torch.equal(found["gradient of attenuations"], true["gradient of attenuations"].float())


@pytest.mark.parametrize(("c", "own"), [(9, False), (19, True)])
def test_channels_beyond_those_of_a_chunk_change_no_other(c, own):
    splats, signal, *others = random_scene(c=c, own=own, attenuations=(0.3, 1.0))
    image, left = opencl.OpenCLRasterizer()(splats, signal, *others)
    for part in (
        slice(first, first + opencl.LAYOUT.channels)
        for first in range(0, c, opencl.LAYOUT.channels)
    ):
        alone, same_left = opencl.OpenCLRasterizer()(splats, signal[..., part], *others)
        assert torch.equal(image[:, part], alone)
        assert torch.equal(left, same_left)


def test_tensors_may_have_any_layout():
    splats, signal, opacities, _, plane = random_scene(plane=grid(DirectionCosine(0.1)))
    pixels = torch.ones(3, *plane.shape, dtype=torch.bool)

    def strided(tensor):
        return tensor.mT.contiguous().mT

    depths = splats.depths.repeat_interleave(2)[::2]
    other = (
        replace(splats, means2d=strided(splats.means2d), depths=depths),
        strided(signal),
        strided(opacities),
        None,
    )
    there = Plane(strided(plane.u), strided(plane.v), plane.period)
    expected, found = (
        render_with_gradients(opencl.OpenCLRasterizer(), arguments, pixels)
        for arguments in ((splats, signal, opacities, None, plane), (*other, there))
    )
    assert all(torch.equal(found[name], expected[name]) for name in expected)


@pytest.mark.parametrize("name", ["u", "v"])
def test_a_plane_changed_in_place_is_another_plane(name):
    scene = random_scene()
    opencl.OpenCLRasterizer()(*scene)
    getattr(scene[-1], name).mul_(0.5)
    image, true = opencl.OpenCLRasterizer()(*scene)[0], rasterize_densely(*scene)[0]
    torch.testing.assert_close(image, true.float(), rtol=0, atol=1e-2 * largest(true))


def test_kernels_that_do_not_build_are_an_error_that_names_the_device(monkeypatch):
    monkeypatch.setattr(opencl, "_literal", lambda value: "(")
    with pytest.raises(
        RuntimeError, match=r"cannot build the kernels \(.*error: .*\); use rasterizer=torch"
    ):
        opencl.OpenCLRasterizer()(*random_scene())


def test_tensors_it_cannot_read_are_errors_that_say_what_to_do(monkeypatch):
    splats, signal, opacities, _, plane = random_scene()
    bad = {
        "takes signal as torch.float32 on the CPU, got torch.float64": (
            splats,
            signal.double(),
            opacities,
        ),
        "takes opacities as torch.float32 on the CPU, got torch.float32 on meta": (
            splats,
            signal,
            opacities.to("meta"),
        ),
        r"opacities must be \(3, 60\) where signal is \(3, 60, 2\), got \(3, 59\)": (
            splats,
            signal,
            opacities[:, 1:],
        ),
        "at least 1 channel and fewer than 2.24 splats, got 0": (
            splats,
            signal[..., :0],
            opacities,
        ),
    }
    for message, arguments in bad.items():
        with pytest.raises((TypeError, ValueError), match=message):
            opencl.OpenCLRasterizer()._check(*arguments, None, plane)
    monkeypatch.setattr(opencl.OpenCLRasterizer, "too_many", 60)  # a scene of 2^24 takes seconds
    with pytest.raises(ValueError, match="got 2 and 60; use rasterizer=torch"):
        opencl.OpenCLRasterizer()(splats, signal, opacities, None, plane)
