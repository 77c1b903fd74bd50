"""OpenCL devices: the default, names, missing and broken drivers."""

import logging
from types import SimpleNamespace
from unittest.mock import Mock

import pytest

from gaigs.splatting.rasterizer.fastest import FastestRasterizer

opencl = pytest.importorskip("gaigs.splatting.rasterizer.opencl", exc_type=ImportError)
found_devices = pytest.importorskip("gaigs.splatting.rasterizer.devices", exc_type=ImportError)

LOG = """clBuildProgram failed: BUILD_PROGRAM_FAILURE - clBuildProgram failed: BUILD_PROGRAM_FAILURE

Build on <pyopencl.Device 'pthread-Zen 9' on 'Portable Computing Language' at 0x555f1b7df960>:

error: unknown target CPU 'generic'
Device pthread-Zen 9 failed to build the program

(options: -I site-packages/pyopencl/cl)"""
"""Log of PoCL for a processor that its compiler does not know, as pyopencl shows it."""


@pytest.fixture(autouse=True)
def afresh():
    yield
    found_devices._open.cache_clear()
    found_devices.find_fault.cache_clear()


@pytest.mark.usefixtures("opencl_works")
def test_a_device_is_chosen_by_any_part_of_its_name(monkeypatch):
    name = found_devices.devices()[0]
    opencl.OpenCLRasterizer(device=name[3:-3].upper())
    monkeypatch.setenv("GAIGS_OPENCL_DEVICE", name)
    assert (
        opencl.OpenCLRasterizer().used
        == f"opencl on {found_devices.default_device()}"
        == f"opencl on {name}"
    )


def test_the_first_processor_is_the_default(monkeypatch):
    kind = found_devices.cl.device_type

    def device(name, type):
        made = Mock(spec=found_devices.cl.Device, type=type, platform=SimpleNamespace(name="Maker"))
        made.name = name
        return made

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


def test_an_unknown_device_is_an_error_that_lists_the_known_ones(monkeypatch):
    with pytest.raises(ValueError, match=r"no OpenCL device is called 'abacus'; there are: .*PU"):
        opencl.OpenCLRasterizer(device="abacus")
    monkeypatch.setenv("GAIGS_OPENCL_DEVICE", "slide rule")
    with pytest.raises(ValueError, match="'slide rule'"):
        opencl.OpenCLRasterizer()


def broken(message):
    """A function that raises pyopencl's error, which is no RuntimeError of Python's."""

    def fail(*_):
        raise found_devices.cl.RuntimeError(message)

    return fail


def test_a_broken_driver_is_an_error_that_names_it_only_if_no_other_works(monkeypatch):
    good, bad = (
        found_devices.cl.get_platforms()[0],
        SimpleNamespace(name="Wreck", get_devices=broken("OUT_OF_MEMORY")),
    )
    names = found_devices.devices()
    monkeypatch.setattr(found_devices.cl, "get_platforms", lambda: [bad, good])
    assert set(found_devices.devices()) <= set(names)
    monkeypatch.setattr(found_devices.cl, "get_platforms", lambda: [bad])
    with pytest.raises(
        RuntimeError, match=r"needs an OpenCL driver.*; Wreck lists no devices \(OUT_OF_MEMORY\)"
    ):
        opencl.OpenCLRasterizer(device="another")
    monkeypatch.setattr(found_devices.cl, "get_platforms", broken("PLATFORM_NOT_FOUND_KHR"))
    with pytest.raises(
        RuntimeError, match=r"needs an OpenCL driver: pip install 'pyopencl\[pocl\]'"
    ):
        found_devices.devices()


@pytest.mark.parametrize("function", ["Context", "CommandQueue"])
def test_a_device_that_cannot_be_opened_is_an_error_that_names_it(function, monkeypatch, caplog):
    found_devices._open.cache_clear()
    monkeypatch.setattr(found_devices.cl, function, broken("OUT_OF_RESOURCES"))
    with pytest.raises(
        RuntimeError,
        match=r"PU\) cannot be opened \(OUT_OF_RESOURCES\)\n.* or use rasterizer=torch",
    ):
        opencl.OpenCLRasterizer()
    with caplog.at_level(logging.INFO):
        assert FastestRasterizer().opencl is None
    assert "rasterizer: torch, as opencl does not work here" in caplog.text


def test_a_driver_that_does_not_know_the_processor_is_an_error_and_is_probed_once(monkeypatch):
    builds = []
    found_devices.find_fault.cache_clear()

    def program(context, source):
        return builds.append(source) or SimpleNamespace(build=broken(LOG))

    monkeypatch.setattr(found_devices.cl, "Program", program)
    for _ in range(2):
        with pytest.raises(
            RuntimeError, match=r"PU\) cannot build kernels \(error: unknown target CPU 'generic'\)"
        ):
            opencl.OpenCLRasterizer()
    assert len(builds) == 1


@pytest.mark.parametrize(
    ("log", "cause"),
    [
        (LOG, "error: unknown target CPU 'generic'"),
        (
            "clBuildProgram failed\n\n<kernel>:3:5: error: no type\n1 error.\n",
            "<kernel>:3:5: error: no type",
        ),
        ("clBuildProgram failed\n\nthe linker crashed\n\n(options: -w)", "the linker crashed"),
        ("clBuildProgram failed: OUT_OF_HOST_MEMORY", "clBuildProgram failed: OUT_OF_HOST_MEMORY"),
    ],
)
def test_the_cause_is_the_first_error_in_the_log(log, cause):
    assert found_devices.cause_of(found_devices.cl.RuntimeError(log)) == cause
