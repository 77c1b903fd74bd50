"""Which rasterizer the fastest one is."""

import logging

import pytest
import torch

from gaigs.projection import Plane, Splats
from gaigs.rasterizer.fastest import FastestRasterizer
from gaigs.rasterizer.torch import TorchRasterizer

opencl = pytest.importorskip("gaigs.rasterizer.opencl", exc_type=ImportError)
found_devices = pytest.importorskip("gaigs.rasterizer.devices", exc_type=ImportError)


def scene(n=12, dtype=torch.float32, channels=2, attenuations=None):
    generator = torch.Generator().manual_seed(0)
    random = lambda *shape: torch.rand(*shape, generator=generator).to(dtype)
    splats = Splats(random(n, 2), 0.1 * torch.tensor([1, 0, 1]).to(dtype).expand(1, n, 3), random(n), random(n) < 2)
    return splats, random(3, n, channels), random(3, n), attenuations, Plane(random(1, 9), random(7, 1), None)


@pytest.fixture
def fastest():
    rasterizer = FastestRasterizer()
    assert rasterizer.used is None
    return rasterizer


@pytest.mark.usefixtures("opencl_works")
def test_is_opencl_where_that_suits(fastest):
    image, _ = fastest(*scene())
    assert fastest.used == f"opencl on {found_devices.default_device()}"
    assert torch.equal(image, opencl.OpenCLRasterizer()(*scene())[0])


@pytest.mark.parametrize(
    "options",
    [
        {"channels": 0},
        {"dtype": torch.float64},
        {"attenuations": torch.full((3, 12), 0.5, dtype=torch.float64)},
        {"n": 13},
    ],
    ids=str,
)
@pytest.mark.usefixtures("opencl_works")
def test_is_torch_for_what_opencl_refuses(options, fastest, monkeypatch):
    monkeypatch.setattr(opencl, "SPLATS", 13)  # a scene of 2^24 takes seconds
    arguments = scene(**options)
    fastest(*scene())
    assert fastest.used != "torch"
    with pytest.raises((TypeError, ValueError), match="use rasterizer=torch"):
        opencl.OpenCLRasterizer()(*arguments)
    image, left = fastest(*arguments)
    assert fastest.used == "torch"
    same_image, same_left = TorchRasterizer()(*arguments)
    assert torch.equal(image, same_image)
    assert torch.equal(left, same_left)


@pytest.mark.usefixtures("opencl_works")
def test_leaves_what_nobody_can_render_to_who_says_so_best(fastest):
    splats, signal, opacities, *others = scene()
    with pytest.raises(ValueError, match=r"opacities must be \(3, 12\)"):
        fastest(splats, signal, opacities[:, 1:], *others)


def test_is_torch_where_a_driver_is_broken(monkeypatch, caplog):
    def fail(*_):
        raise opencl.cl.LogicError("clCreateContext failed: INVALID_DEVICE")

    found_devices._open.cache_clear()
    monkeypatch.setattr(opencl.cl, "Context", fail)
    with caplog.at_level(logging.INFO):
        fastest = FastestRasterizer()
    assert "rasterizer: torch, as opencl does not work here" in caplog.text
    assert "cannot be opened (clCreateContext failed: INVALID_DEVICE); mend its driver" in caplog.text
    fastest(*scene())
    assert fastest.used == "torch"


@pytest.mark.usefixtures("opencl_works")
@pytest.mark.parametrize("channels", [1, 8, 9, 40])
def test_is_opencl_for_any_number_of_channels(fastest, channels):
    image, _ = fastest(*scene(channels=channels))
    assert fastest.used.startswith("opencl on ")
    torch.testing.assert_close(image, TorchRasterizer()(*scene(channels=channels))[0], rtol=0, atol=1e-5)
