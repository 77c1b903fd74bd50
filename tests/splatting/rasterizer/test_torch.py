"""The torch rasterizer at the seam, in any chunks, in depth order, and its memory.

``contracts.rasterizer.check_rasterizer``, which tests/test_contracts.py runs, compares it with the
formula.
"""

import math
import subprocess
import sys
from dataclasses import replace
from fractions import Fraction

import pytest
import torch
from contracts.rasterizer import cast_scene, rasterize_densely, render_with_gradients

from gaigs.core.geometry import Grid, Pose, from_spherical
from gaigs.splatting.projection import Plane, Splats
from gaigs.splatting.projection.direction_cosine import DirectionCosine
from gaigs.splatting.projection.mercator import Mercator
from gaigs.splatting.rasterizer import torch as module
from gaigs.splatting.rasterizer.torch import TorchRasterizer

GRID = Grid.degrees(range(1, 91, 3), [0.3 + 6 * k for k in range(60)])
HERE = Pose(torch.zeros(3), torch.eye(3))
PROJECTIONS = {"mercator": Mercator, "direction_cosine": DirectionCosine}


def scene(projection="mercator", n=40, own=False, attenuations=True, size=0.3):
    """Arguments of a rasterizer: Gaussians about a receiver, on its plane."""
    generator = torch.Generator().manual_seed(n)

    def uniform(low, high, *shape):
        return low + (high - low) * torch.rand(*shape, generator=generator)

    projection = PROJECTIONS[projection](GRID.pitch)
    means = from_spherical(uniform(0, math.tau, n), uniform(-0.5, 1.57, n)) * uniform(0.5, 4, n, 1)
    half = size * torch.randn(2 if own else 1, n, 3, 3, generator=generator)
    splats, signal = (
        projection.project(means, half, HERE),
        torch.randn(2, n, 2, generator=generator),
    )
    lets = uniform(0.2, 1, 2, n) if attenuations else None
    return splats, signal, uniform(0, 1, 2, n), lets, projection.plane(GRID)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_offsets_are_exact_at_the_seam(dtype):
    generator = torch.Generator().manual_seed(0)
    seam = math.pi * torch.tensor([-1, 1, 3], dtype=torch.float64)
    ends = seam[torch.randint(3, (2, 300), generator=generator)]
    beyond = 10 ** -(1 + 5 * torch.rand(2, 300, generator=generator, dtype=torch.float64))
    a, b = (ends + beyond).to(dtype)
    a, b = (
        torch.cat((a, a.new_tensor([0.5, -2.0, math.pi]))),
        torch.cat((b, b.new_tensor([0.25, 2.0, -math.pi]))),
    )
    period = torch.tensor(math.tau, dtype=dtype).item()
    found, eps = (
        module._nearest(a, b, module._Period(period, math.tau - period)),
        torch.finfo(dtype).eps,
    )
    for x, y, offset in zip(a.tolist(), b.tolist(), found.tolist(), strict=True):
        true = Fraction(x) - Fraction(y)
        true -= round(true / Fraction(math.tau)) * Fraction(math.tau)
        assert abs(Fraction(offset) - true) <= 2 * eps * (abs(true) + eps)


def test_narrow_splats_at_the_seam_are_as_good_as_elsewhere():
    generator = torch.Generator().manual_seed(0)
    width, n = 1e-5, 40
    errors = []
    for centre in (math.pi, 0.0):
        u = centre + width * torch.linspace(-2, 2, 9)[None]
        means = torch.stack(
            (centre + width * torch.randn(n, generator=generator), torch.zeros(n)), -1
        )
        means[::2, 0] -= math.tau * bool(centre)  # the same places, a turn away
        factors = (width * torch.tensor([1.0, 0, 1])).expand(1, n, 3)
        splats = Splats(means, factors, torch.arange(1.0 * n), torch.ones(n).bool())
        arguments = splats, torch.rand(1, n, 1, generator=generator), torch.full((1, n), 0.1), None
        plane = Plane(u, torch.zeros(1, 1), math.tau)
        image, _ = TorchRasterizer()(*arguments, plane)
        errors.append((image - rasterize_densely(*arguments, plane)[0]).abs().max().item())
    assert max(errors) < 1e-5


@pytest.mark.parametrize("projection", ["mercator", "direction_cosine"])
@pytest.mark.parametrize("own", [False, True])
def test_gradients_are_those_of_finite_differences(projection, own):
    splats, signal, opacities, attenuations, plane = scene(
        n=6, own=own, projection=projection, size=0.5
    )
    plane = Plane(plane.u[::7, ::9], plane.v[::7, ::9], plane.period)

    def rasterize_with(means, factors, *others):
        return TorchRasterizer()(replace(splats, means2d=means, factors=factors), *others, plane)

    inputs = (splats.means2d, splats.factors, signal, 0.9 * opacities, attenuations)
    leaves = tuple(leaf.detach().double().requires_grad_() for leaf in inputs)
    assert torch.autograd.gradcheck(rasterize_with, leaves, fast_mode=True)


@pytest.mark.parametrize("chunk", [1, 3000, 2**40])
@pytest.mark.parametrize("projection", ["mercator", "direction_cosine"])
def test_chunks_of_tiles_of_any_size_give_the_same_map(monkeypatch, chunk, projection):
    arguments = cast_scene(scene(n=60, projection=projection), "cpu", torch.float64)
    pixels = torch.ones(2, *GRID.shape, dtype=torch.bool)
    usual = render_with_gradients(TorchRasterizer(), arguments, pixels)
    monkeypatch.setattr(TorchRasterizer, "chunk", chunk)
    for name, found in render_with_gradients(TorchRasterizer(), arguments, pixels).items():
        torch.testing.assert_close(found, usual[name], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("depths", "order"),
    [
        ((1, 2, 3), (0, 1, 2)),
        ((3, 1, 2), (1, 2, 0)),
        ((2, 2, 1), (2, 0, 1)),
        ((2, math.inf, 2), (0, 2, 1)),
    ],
)
def test_depth_decides_and_among_equals_the_index(depths, order):
    splats = Splats(
        torch.zeros(3, 2),
        torch.tensor([1.0, 0, 1]).expand(1, 3, 3),
        torch.tensor(depths).float(),
        torch.ones(3).bool(),
    )
    signal = torch.tensor([[[1.0], [10.0], [100.0]]])
    image, left = TorchRasterizer()(
        splats, signal, torch.full((1, 3), 0.9), None, Plane(*torch.zeros(2, 1, 1), None)
    )
    assert image.item() == pytest.approx(
        sum(0.9 * 0.1**k * 10**i for k, i in enumerate(order)), rel=1e-5
    )
    assert left.item() == pytest.approx(1e-3, rel=1e-5)


MEMORY = """
import re
from pathlib import Path
import torch
from gaigs.core.geometry import Grid, Pose
from gaigs.splatting.gaussians import fibonacci_lattice
from gaigs.splatting.projection.mercator import Mercator
from gaigs.splatting.rasterizer.torch import TorchRasterizer

n, grid = 10_000, Grid.degrees()
projection = Mercator(grid.pitch)
points = (3 * fibonacci_lattice(n, 0.0, 1.57)).requires_grad_()
width = 3 * (2 * torch.pi / n) ** 0.5 / 4  # a quarter of the way to the next Gaussian
semi_axes = (width * torch.eye(3)).expand(1, n, 3, 3)
splats = projection.project(points, semi_axes, Pose(torch.zeros(3), torch.eye(3)))
opacities, signal = torch.full((1, n), 0.1, requires_grad=True), torch.randn(1, n, 2, requires_grad=True)
attenuations = torch.full((1, n), 0.9, requires_grad=True)
# getrusage would count the parent's memory, too.
peak = lambda: int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1]) * 2**10
before = peak()
plane = projection.plane(grid)
image, left = TorchRasterizer()(splats, signal, opacities, attenuations, plane)
(image.square().sum() + left.sum()).backward()
assert opacities.grad.isfinite().all() and opacities.grad.any()
print(peak() - before)
"""


@pytest.mark.skipif(
    sys.platform != "linux", reason="other systems count the peak memory in other units, or not"
)
def test_memory_does_not_grow_with_pairs_of_splats_and_pixels():
    done = subprocess.run([sys.executable, "-c", MEMORY], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (
        int(done.stdout) < 2**29
    )  # a float32 for each pair of 10,000 splats and 32,400 pixels would be 1.2 GiB
