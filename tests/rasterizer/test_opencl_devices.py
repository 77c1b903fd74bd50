"""OpenCL devices: which is taken, and what is said where there is none, or one that is broken."""

import logging
import re
from types import SimpleNamespace

import pytest

from gaigs.rasterizer.fastest import FastestRasterizer

opencl = pytest.importorskip("gaigs.rasterizer.opencl", exc_type=ImportError)
found_devices = pytest.importorskip("gaigs.rasterizer.devices", exc_type=ImportError)

LOG = """clBuildProgram failed: BUILD_PROGRAM_FAILURE - clBuildProgram failed: BUILD_PROGRAM_FAILURE

Build on <pyopencl.Device 'pthread-Zen 9' on 'Portable Computing Language' at 0x555f1b7df960>:

error: unknown target CPU 'generic'
Device pthread-Zen 9 failed to build the program

(options: -I site-packages/pyopencl/cl)"""
"""What PoCL says of a processor that its compiler does not know, as pyopencl passes it on."""


@pytest.fixture(autouse=True)
def afresh():
    """What a test breaks is forgotten behind it."""
    yield
    found_devices._open.cache_clear()
    found_devices.find_fault.cache_clear()


@pytest.mark.usefixtures("opencl_works")
def test_lists_a_device_and_takes_it_by_any_part_of_its_name(monkeypatch):
    name = found_devices.devices()[0]
    opencl.OpenCLRasterizer(device=name[3:-3].upper())
    monkeypatch.setenv("GAIGS_OPENCL_DEVICE", name)
    assert opencl.OpenCLRasterizer().used == f"opencl on {found_devices.default_device()}" == f"opencl on {name}"


def test_the_first_processor_is_the_default(monkeypatch):
    kind = found_devices.cl.device_type
    platform = lambda name: SimpleNamespace(name=name)
    device = lambda name, type: SimpleNamespace(name=name, type=type, platform=platform("Maker"))
    found = [device("one", kind.GPU), device("two", kind.CPU), device("three", kind.CPU)]
    monkeypatch.setattr(found_devices, "_devices", lambda: found)
    monkeypatch.delenv("GAIGS_OPENCL_DEVICE", raising=False)
    assert found_devices.devices() == ["Maker: one (GPU)", "Maker: two (CPU)", "Maker: three (CPU)"]
    assert found_devices.default_device() == "Maker: two (CPU)"
    monkeypatch.setenv("GAIGS_OPENCL_DEVICE", "gpu")
    assert found_devices.default_device() == "Maker: one (GPU)"
    monkeypatch.delenv("GAIGS_OPENCL_DEVICE")
    del found[1:]
    assert found_devices.default_device() == "Maker: one (GPU)"


def test_an_unknown_device_is_an_error_that_lists_those_there_are(monkeypatch):
    with pytest.raises(ValueError, match=r"no OpenCL device is called 'abacus'; there are: .*PU"):
        opencl.OpenCLRasterizer(device="abacus")
    monkeypatch.setenv("GAIGS_OPENCL_DEVICE", "slide rule")
    with pytest.raises(ValueError, match="'slide rule'"):
        opencl.OpenCLRasterizer()


def test_no_driver_is_an_error_that_says_what_to_install(monkeypatch):
    def find_no_platform():
        raise found_devices.cl.LogicError("clGetPlatformIDs failed: PLATFORM_NOT_FOUND_KHR")

    monkeypatch.setattr(found_devices.cl, "get_platforms", find_no_platform)
    with pytest.raises(RuntimeError, match=r"needs an OpenCL driver: pip install 'pyopencl\[pocl\]'"):
        found_devices.devices()


def broken(message):
    """What pyopencl raises is no RuntimeError of Python's."""

    def fail(*_):
        raise found_devices.cl.RuntimeError(message)

    return fail


def test_a_broken_driver_is_an_error_that_names_it(monkeypatch):
    good, bad = (
        found_devices.cl.get_platforms()[0],
        SimpleNamespace(name="Wreck", get_devices=broken("OUT_OF_HOST_MEMORY")),
    )
    names = found_devices.devices()
    monkeypatch.setattr(found_devices.cl, "get_platforms", lambda: [bad, good])
    assert set(found_devices.devices()) <= set(names), "beside one that works it hurts nobody"
    monkeypatch.setattr(found_devices.cl, "get_platforms", lambda: [bad])
    with pytest.raises(RuntimeError, match=r"needs an OpenCL driver.*; Wreck lists no devices \(OUT_OF_HOST_MEMORY\)"):
        opencl.OpenCLRasterizer(device="another")
    with pytest.raises(RuntimeError, match="Wreck"):
        found_devices.devices()


@pytest.mark.parametrize("what", ["Context", "CommandQueue"])
def test_a_device_that_cannot_be_opened_is_an_error_that_names_it(what, monkeypatch):
    found_devices._open.cache_clear()
    monkeypatch.setattr(found_devices.cl, what, broken("OUT_OF_RESOURCES"))
    with pytest.raises(RuntimeError, match=r"PU\) cannot be opened \(OUT_OF_RESOURCES\); .* or use rasterizer=torch"):
        opencl.OpenCLRasterizer()


# --- a driver that does not know the processor ---


@pytest.fixture
def builds(monkeypatch):
    """Programs that do not build; what they were to hold."""
    sources = []

    def fail(context, source):
        sources.append(source)
        return SimpleNamespace(build=broken(LOG))

    found_devices.find_fault.cache_clear()
    monkeypatch.setattr(found_devices.cl, "Program", fail)
    return sources


def test_it_is_an_error_that_says_what_is_the_matter_and_what_to_do(builds):
    message = (
        r"PU\) cannot build kernels \(error: unknown target CPU 'generic'\); use rasterizer=torch, or install a newer"
    )
    with pytest.raises(RuntimeError, match=message):
        opencl.OpenCLRasterizer()
    assert builds == [found_devices.PROBE]


def test_the_fastest_is_torch_then_and_says_so_and_a_device_is_asked_once(builds, caplog):
    with caplog.at_level(logging.INFO):
        rasterizers = [FastestRasterizer() for _ in range(3)]
    assert all(rasterizer.opencl is None for rasterizer in rasterizers)
    assert len(re.findall("rasterizer: torch, as opencl does not work here .*unknown target CPU", caplog.text)) == 3
    assert builds == [found_devices.PROBE]


@pytest.mark.parametrize(
    ("log", "cause"),
    [
        (LOG, "error: unknown target CPU 'generic'"),
        (
            "clBuildProgram failed\n\n<kernel>:3:5: error: no such type\n1 error generated.\n",
            "<kernel>:3:5: error: no such type",
        ),
        ("clBuildProgram failed\n\nthe linker crashed\n\n(options: -w)", "the linker crashed"),
        ("clBuildProgram failed: OUT_OF_HOST_MEMORY", "clBuildProgram failed: OUT_OF_HOST_MEMORY"),
    ],
)
def test_the_cause_is_the_line_that_says_it(log, cause):
    assert found_devices.cause_of(found_devices.cl.RuntimeError(log)) == cause
