import os
import signal

import pytest
import torch

from gaigs.splatting.projection import Plane, Splats
from gaigs.splatting.rasterizer.fastest import FastestRasterizer
from gaigs.splatting.rasterizer.torch import TorchRasterizer

opencl = pytest.importorskip("gaigs.splatting.rasterizer.opencl", exc_type=ImportError)
found_devices = pytest.importorskip("gaigs.splatting.rasterizer.devices", exc_type=ImportError)
pytestmark = pytest.mark.usefixtures("opencl_works")


def scene(n=12, dtype=torch.float32, channels=2, attenuations=None):
    generator = torch.Generator().manual_seed(0)

    def random(*shape):
        return torch.rand(*shape, generator=generator).to(dtype)

    splats = Splats(
        random(n, 2),
        0.1 * torch.tensor([1, 0, 1]).to(dtype).expand(1, n, 3),
        random(n),
        random(n) < 2,
    )
    return (
        splats,
        random(3, n, channels),
        random(3, n),
        attenuations,
        Plane(random(1, 9), random(7, 1), None),
    )


@pytest.mark.parametrize("channels", [1, 9, 40])
def test_opencl_draws_float32_maps_of_any_number_of_channels(channels):
    fastest = FastestRasterizer()
    assert fastest.used is None
    image, _ = fastest(*scene(channels=channels))
    assert fastest.used == f"opencl on {found_devices.default_device()}"
    assert torch.equal(image, opencl.OpenCLRasterizer()(*scene(channels=channels))[0])
    torch.testing.assert_close(
        image, TorchRasterizer()(*scene(channels=channels))[0], rtol=0, atol=1e-5
    )


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
def test_torch_draws_maps_that_opencl_refuses(options, monkeypatch):
    monkeypatch.setattr(opencl.OpenCLRasterizer, "too_many", 13)  # a scene of 2^24 takes seconds
    fastest, arguments = FastestRasterizer(), scene(**options)
    fastest(*scene())
    assert fastest.used != "torch"
    with pytest.raises((TypeError, ValueError), match="use rasterizer=torch"):
        opencl.OpenCLRasterizer()(*arguments)
    found = fastest(*arguments)
    assert fastest.used == "torch"
    assert all(map(torch.equal, found, TorchRasterizer()(*arguments)))


def test_shapes_that_do_not_fit_are_an_error_and_no_reason_to_take_torch():
    splats, signal, opacities, *others = scene()
    assert FastestRasterizer().opencl.takes(splats, signal, opacities[:, 1:], *others)
    with pytest.raises(ValueError, match=r"opacities must be \(3, 12\)"):
        opencl.OpenCLRasterizer()._check(splats, signal, opacities[:, 1:], *others)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="Windows has no forks")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded")
def test_a_forked_process_renders_by_torch_though_drivers_have_their_threads_elsewhere():
    """Without a time limit of its own the child would wait for them for ever."""
    fastest, own = FastestRasterizer(), opencl.OpenCLRasterizer()
    expected = fastest(*scene())[0]
    threads = torch.get_num_threads()
    torch.set_num_threads(2)
    torch.rand(10**6).exp()  # starts the threads of torch
    child = os.fork()
    if child == 0:
        signal.alarm(120)
        try:
            with pytest.raises(
                RuntimeError, match="forked from one that has used it\nstart processes by"
            ):
                own(*scene())
            torch.rand(10**6).exp()
            torch.testing.assert_close(fastest(*scene())[0], expected, rtol=0, atol=1e-5)
            os._exit(int(fastest.used != "torch"))
        finally:
            os._exit(2)
    torch.set_num_threads(threads)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="Windows has no forks")
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded")
def test_a_process_that_has_only_listed_the_devices_counts_as_one_that_uses_them():
    found_devices._process.cache_clear()
    found_devices.default_device()
    child = os.fork()
    if child == 0:
        os._exit(int(not found_devices.is_forked()))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
