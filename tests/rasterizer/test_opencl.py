"""The OpenCL rasterizer against the dense float64 one, over random scenes and hard ones; what it refuses."""

import math
from dataclasses import dataclass, replace

import pytest
import torch
from reference import factors_of, margin, rasterize

from gaigs.geometry import Grid, Rays
from gaigs.projection import Plane, Splats
from gaigs.projection.direction_cosine import DirectionCosine
from gaigs.projection.mercator import Mercator
from gaigs.rasterizer.torch import TorchRasterizer

opencl = pytest.importorskip("gaigs.rasterizer.opencl", exc_type=ImportError)
pytestmark = pytest.mark.usefixtures("opencl_works")

VALUES, GRADIENTS = 2e-6, 1e-5
"""Tolerances, of the image's largest value and of each parameter's largest gradient."""


@pytest.fixture(autouse=True, scope="module")
def one_thread():
    """The dense rasterizer's many small steps are faster without waiting for each other's threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@dataclass
class Scene:
    splats: Splats
    signal: torch.Tensor
    opacities: torch.Tensor
    attenuations: torch.Tensor | None
    plane: Plane

    def parameters(self) -> dict[str, torch.Tensor]:
        names = {"means2d": self.splats.means2d, "factors": self.splats.factors}
        names |= {"signal": self.signal, "opacities": self.opacities, "attenuations": self.attenuations}
        return {name: tensor for name, tensor in names.items() if tensor is not None}


def grid(projection, rows=37, columns=60) -> Plane:
    """A plane whose rows and columns fill no whole number of tiles."""
    return projection.plane(Grid(torch.linspace(0.02, 1.45, rows), torch.arange(columns) * (2 * math.pi / columns)))


def scattered(projection, rays=70) -> Plane:
    """A single row of rays all over the upper hemisphere, in no order."""
    elevations, azimuths = torch.rand(2, rays, generator=torch.Generator().manual_seed(0))
    return projection.plane(Rays(1.5 * elevations, 2 * math.pi * azimuths))


def random_scene(
    n=60, b=3, c=2, own=False, attenuations=None, plane=None, spread=(0.05, 0.6), opacities=(0.0, 0.95), seed=0
):
    """Splats all over the plane; ``spread`` bounds the standard deviations, log-uniform, along two random axes."""
    generator = torch.Generator().manual_seed(seed)
    uniform = lambda low, high, *shape: low + (high - low) * torch.rand(*shape, generator=generator)
    plane = plane or grid(Mercator(0.1))
    u = uniform(plane.u.min(), plane.u.max(), n)
    if plane.period is not None:
        u = (u + math.pi).remainder(plane.period) - math.pi  # as atan2 gives azimuths, whatever the grid counts from
    angles = uniform(0, math.pi, b if own else 1, n)
    axes = torch.stack((angles.cos(), -angles.sin(), angles.sin(), angles.cos()), -1).unflatten(-1, (2, 2))
    half = axes * uniform(*map(math.log, spread), len(angles), n, 2).exp()[..., None, :]
    splats = Splats(
        torch.stack((u, uniform(plane.v.min(), plane.v.max(), n)), -1),
        factors_of(half @ half.mT),
        uniform(0.5, 5, n),
        uniform(0, 1, n) > 0.05,
    )
    signal = torch.randn(b, n, c, generator=generator)
    return Scene(splats, signal, uniform(*opacities, b, n), attenuations and uniform(*attenuations, b, n), plane)


def at_the_seam() -> Scene:
    scene = random_scene(spread=(0.02, 0.3))
    scene.splats.means2d[:, 0] = torch.linspace(-0.3, 0.3, 60).sub(math.pi).remainder(2 * math.pi).sub(math.pi)
    return replace(scene, plane=Plane(scene.plane.u - math.pi, scene.plane.v, scene.plane.period))


def needles() -> Scene:
    """Diagonal splats forty times as long as wide."""
    scene = random_scene()
    half = math.sqrt(0.5) * torch.tensor([[1.0, -1.0], [1.0, 1.0]]) * torch.tensor([0.8, 0.02])
    factors = factors_of(half.double() @ half.double().mT).float()
    return replace(scene, splats=replace(scene.splats, factors=factors.repeat(1, 60, 1)))


def depths_of_either_sign() -> Scene:
    scene = random_scene()
    scene.splats.depths.sub_(2.5)
    return scene


def points_on_pixels() -> Scene:
    """Each acts on the one pixel it is centred on: those at the edges of tiles among them."""
    plane = replace(grid(Mercator(0.1)), period=None)
    scene = random_scene(n=60, plane=plane, spread=(1e-9, 1e-9), opacities=(0.5, 0.9))
    scene.splats.means2d.copy_(torch.stack((plane.u[0], plane.v[torch.arange(60) % 37, 0]), -1))
    scene.splats.visible.fill_(True)
    return scene


def loud_behind_walls() -> Scene:
    """Every layer lets 0.3 through and the next is four times as loud: what is behind matters however dark it is."""
    scene = random_scene(n=24, b=1, spread=(20.0, 20.0), opacities=(0.7, 0.7))
    scene.splats.depths[:] = torch.arange(24.0)
    return replace(scene, signal=scene.signal * (4.0 ** torch.arange(24))[:, None])


def dark_in_half() -> Scene:
    """Light is used up at low v long before it is at high v: rows of one tile end at different depths."""
    scene = random_scene(n=300, b=1, spread=(0.2, 0.6), opacities=(0.3, 0.9))
    low = scene.plane.v.min()
    scene.splats.means2d[:, 1] = low + 0.4 * (scene.splats.means2d[:, 1] - low)
    return scene


def unsorted_plane() -> Scene:
    plane = grid(Mercator(0.1))
    shuffle = torch.Generator().manual_seed(0)
    u, v = plane.u[:, torch.randperm(60, generator=shuffle)], plane.v[torch.randperm(37, generator=shuffle)]
    return random_scene(plane=Plane(u, v, plane.period))


def twisted_plane() -> Scene:
    """A period, and rows that mix with columns."""
    u, v, period = vars(grid(Mercator(0.1))).values()
    return random_scene(plane=Plane(u + 0.3 * v.sin(), v + 0.2 * u.cos(), period))


SCENES = {
    "random": random_scene,
    "own covariances": lambda: random_scene(own=True),
    "no period": lambda: random_scene(plane=replace(grid(Mercator(0.1)), period=None)),
    "direction cosines": lambda: random_scene(plane=grid(DirectionCosine(0.1))),
    "direction cosines, own": lambda: random_scene(plane=grid(DirectionCosine(0.1)), own=True, attenuations=(0.1, 1)),
    "attenuation": lambda: random_scene(attenuations=(0.3, 1.0)),
    "strong attenuation": lambda: random_scene(attenuations=(1e-6, 1e-2)),
    "no attenuation left": lambda: random_scene(attenuations=(1.0, 1.0)),
    "eight channels": lambda: random_scene(c=8),
    "nine channels": lambda: random_scene(c=9, attenuations=(0.3, 1.0)),
    "many channels": lambda: random_scene(c=21, own=True, attenuations=(0.3, 1.0)),
    "one transmitter": lambda: random_scene(b=1),
    "many transmitters": lambda: random_scene(b=19, spread=(1.0, 2.0)),
    "depths of either sign": depths_of_either_sign,
    "points on pixels": points_on_pixels,
    "empty tiles": lambda: random_scene(n=5, spread=(0.03, 0.05)),
    "narrower than a pixel": lambda: random_scene(n=150, spread=(0.005, 0.05)),
    "wider than the plane": lambda: random_scene(spread=(3.0, 30.0)),
    "needles": needles,
    "narrow and wide": lambda: random_scene(spread=(0.02, 2.0), seed=2),
    "opaque": lambda: random_scene(n=120, spread=(0.3, 2.0), opacities=(1.0, 1.0)),
    "nearly opaque": lambda: random_scene(n=120, spread=(0.3, 2.0), opacities=(0.8, 0.99), attenuations=(0.1, 1.0)),
    "loud behind walls": loud_behind_walls,
    "dark in half": dark_in_half,
    "at the seam": at_the_seam,
    "unsorted plane": unsorted_plane,
    "twisted plane": twisted_plane,
    "one pixel": lambda: random_scene(plane=grid(Mercator(0.1), 1, 1)),
    "one row": lambda: random_scene(plane=grid(Mercator(0.1), 1, 50)),
    "rays": lambda: random_scene(plane=scattered(Mercator(0.1)), attenuations=(0.3, 1.0)),
    "rays, own": lambda: random_scene(plane=scattered(DirectionCosine(0.1)), own=True),
}


def render(rasterizer, scene: Scene, pixels: torch.Tensor):
    """Map, transmittance, and the gradients of a random function of both at ``pixels``."""
    parameters = {name: tensor.clone().requires_grad_() for name, tensor in scene.parameters().items()}
    image, left = rasterizer(
        replace(scene.splats, means2d=parameters["means2d"], factors=parameters["factors"]),
        parameters["signal"],
        parameters["opacities"],
        parameters.get("attenuations"),
        scene.plane,
    )
    generator = torch.Generator().manual_seed(0)
    image_gradient, left_gradient = (torch.randn(tensor.shape, generator=generator) for tensor in (image, left))
    (image * image_gradient * pixels[:, None]).sum().add((left * left_gradient * pixels).sum()).backward()
    return image.detach(), left.detach(), {name: tensor.grad for name, tensor in parameters.items()}


@pytest.mark.parametrize("name", SCENES)
def test_agrees_with_the_dense_float64_rasterizer(name):
    scene = SCENES[name]()
    # Where a G meets one of its bounds to within rounding, the two may decide differently.
    pixels = (margin(scene.splats, scene.opacities, scene.plane) > 1e-5).float()
    assert pixels.mean() > 0.99 or not pixels.numel()
    image, left, gradients = render(opencl.OpenCLRasterizer(), scene, pixels)
    true_image, true_left, true_gradients = render(rasterize, scene, pixels)
    assert image.dtype == left.dtype == torch.float32
    torch.testing.assert_close(
        image * pixels[:, None], (true_image * pixels[:, None]).float(), rtol=0, atol=VALUES * largest(true_image)
    )
    torch.testing.assert_close(left * pixels, (true_left * pixels).float(), rtol=0, atol=VALUES)
    for parameter, true_gradient in true_gradients.items():
        tolerance = GRADIENTS * largest(true_gradient)
        torch.testing.assert_close(
            gradients[parameter], true_gradient, rtol=0, atol=tolerance, msg=lambda m, p=parameter: f"{p}: {m}"
        )


def largest(tensor: torch.Tensor) -> float:
    return tensor.abs().max().item() if tensor.numel() else 0.0


def test_the_transmittance_is_right_where_nothing_is_heard():
    scene = random_scene(n=120, spread=(3.0, 30.0), opacities=(0.1, 0.3))
    arguments = scene.splats, torch.zeros_like(scene.signal), scene.opacities, None, scene.plane
    _, left = opencl.OpenCLRasterizer()(*arguments)
    _, true_left = rasterize(*arguments)
    torch.testing.assert_close(left, true_left.float(), rtol=0, atol=VALUES)


@pytest.mark.parametrize(("c", "own"), [(9, False), (16, True), (19, True)])
def test_channels_beyond_those_of_a_chunk_change_no_other(c, own):
    """Each channel's map is what it is alone; gradients of all else are sums over the channels, as torch has them."""
    scene = random_scene(c=c, own=own, attenuations=(0.3, 1.0))
    pixels = (margin(scene.splats, scene.opacities, scene.plane) > 1e-5).float()
    image, left, gradients = render(opencl.OpenCLRasterizer(), scene, pixels)
    assert image.shape == (3, c, *scene.plane.shape)
    for first in range(0, c, opencl.CHANNELS):
        part = slice(first, first + opencl.CHANNELS)
        alone, same_left, _ = render(opencl.OpenCLRasterizer(), replace(scene, signal=scene.signal[..., part]), pixels)
        assert torch.equal(image[:, part], alone)
        assert torch.equal(left, same_left)
    _, _, expected = render(TorchRasterizer(), scene, pixels)
    for name, gradient in gradients.items():
        tolerance = GRADIENTS * largest(expected[name])
        torch.testing.assert_close(gradient, expected[name], rtol=0, atol=tolerance, msg=lambda m, n=name: f"{n}: {m}")


def test_reads_tensors_of_any_layout():
    scene = random_scene(plane=grid(DirectionCosine(0.1)))
    pixels = torch.ones(3, *scene.plane.shape)
    image, left, gradients = render(opencl.OpenCLRasterizer(), scene, pixels)
    strided = lambda tensor: tensor.mT.contiguous().mT
    scene.signal, scene.opacities = strided(scene.signal), strided(scene.opacities)
    scene.splats = replace(
        scene.splats, means2d=strided(scene.splats.means2d), depths=scene.splats.depths.repeat_interleave(2)[::2]
    )
    scene.plane = replace(scene.plane, u=strided(scene.plane.u), v=strided(scene.plane.v))
    same_image, same_left, same_gradients = render(opencl.OpenCLRasterizer(), scene, pixels)
    assert torch.equal(image, same_image)
    assert torch.equal(left, same_left)
    assert all(torch.equal(gradients[name], same_gradients[name]) for name in gradients)


@pytest.mark.parametrize("name", ["u", "v"])
def test_a_plane_changed_in_place_is_another_plane(name):
    scene = random_scene()
    pixels = torch.ones(3, *scene.plane.shape)
    render(opencl.OpenCLRasterizer(), scene, pixels)
    getattr(scene.plane, name).mul_(0.5)
    image, *_ = render(opencl.OpenCLRasterizer(), scene, pixels)
    true_image, *_ = render(rasterize, scene, pixels)
    torch.testing.assert_close(image, true_image.float(), rtol=0, atol=1e-2 * largest(true_image))


def test_kernels_that_do_not_build_are_an_error_that_names_the_device(monkeypatch):
    monkeypatch.setattr(opencl, "_literal", lambda value: "(")
    scene = random_scene()
    with pytest.raises(RuntimeError, match=r"cannot build the kernels \(.*error: .*\); use rasterizer=torch"):
        render(opencl.OpenCLRasterizer(), scene, torch.ones(3, *scene.plane.shape))


def test_tensors_it_cannot_read_are_errors_that_say_what_to_do():
    rasterizer, scene = opencl.OpenCLRasterizer(), random_scene()
    call = lambda **changes: rasterizer(*vars(replace(scene, **changes)).values())
    with pytest.raises(
        TypeError, match=r"takes signal as torch.float32 on the CPU, got torch.float64 on cpu; use rasterizer=torch"
    ):
        call(signal=scene.signal.double())
    with pytest.raises(TypeError, match=r"takes opacities as torch\.float32 on the CPU, got torch\.float32 on meta"):
        call(opacities=scene.opacities.to("meta"))
    with pytest.raises(ValueError, match=r"opacities must be \(3, 60\) where signal is \(3, 60, 2\), got \(3, 59\)"):
        call(opacities=scene.opacities[:, 1:])
    with pytest.raises(TypeError, match=r"takes visible as torch\.bool"):
        call(splats=replace(scene.splats, visible=torch.ones(60)))
    with pytest.raises(ValueError, match="at least 1 channel, got 0"):
        call(signal=torch.zeros(3, 60, 0))


def test_more_splats_than_an_entry_counts_are_refused(monkeypatch):
    monkeypatch.setattr(opencl, "SPLATS", 60)  # a scene of 2^24 takes seconds
    scene = random_scene()
    with pytest.raises(ValueError, match="got 60; use rasterizer=torch"):
        opencl.OpenCLRasterizer()(*vars(scene).values())
