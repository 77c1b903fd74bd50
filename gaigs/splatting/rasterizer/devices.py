"""OpenCL devices: the list, the default, and a check that kernels build."""

import functools
import os

import pyopencl as cl


def devices() -> list[str]:
    """The OpenCL devices, each as "platform: device (kind)"; a ``RuntimeError`` without any."""
    return [name_of(device) for device in _devices()]


def default_device() -> str:
    """The default device, one of ``devices``."""
    return name_of(_choose(os.environ.get("GAIGS_OPENCL_DEVICE")))


@functools.cache
def _process() -> int:
    """Number of the process that first used OpenCL, which is the first one to call this."""
    return os.getpid()


def is_forked() -> bool:
    """True in a fork of a process with OpenCL, where the driver's threads are missing."""
    return _process() != os.getpid()


def _devices() -> list:
    """The devices of all drivers; a broken driver is an error only if no other has a device."""
    _process()  # records the process, since drivers start threads here
    devices = []
    causes = []
    try:
        for platform in cl.get_platforms():
            try:
                devices += platform.get_devices()
            except cl.Error as error:
                causes.append(f"; {platform.name} lists no devices ({error})")
    except cl.Error as error:  # with no platform, too
        causes.append(f" ({error})")
    if not devices:
        raise RuntimeError(
            "rasterizer 'opencl' needs an OpenCL driver: pip install 'pyopencl[pocl]', "
            f"or use rasterizer=torch{''.join(causes)}"
        )
    return devices


def name_of(device) -> str:
    """The name of a device in ``devices``."""
    kinds = []
    for kind in ("CPU", "GPU", "ACCELERATOR"):
        if device.type & getattr(cl.device_type, kind):
            kinds.append(kind)
    return f"{device.platform.name}: {device.name} ({' '.join(kinds)})"


def open_queue(name: str | None) -> cl.CommandQueue:
    """The command queue of a device, cached.

    Args:
        name: As for ``OpenCLRasterizer``.
    """
    if is_forked():
        raise RuntimeError(
            "rasterizer 'opencl' does not work in a process forked from one that has used it\n"
            "start processes by multiprocessing.get_context('spawn'), or use rasterizer=torch"
        )
    return _open(name or os.environ.get("GAIGS_OPENCL_DEVICE"))


@functools.cache
def _open(name: str | None) -> cl.CommandQueue:
    device = _choose(name)
    try:
        return cl.CommandQueue(cl.Context([device]))
    except cl.Error as error:
        raise RuntimeError(
            f"rasterizer 'opencl': {name_of(device)} cannot be opened ({error})\n"
            "choose another device with GAIGS_OPENCL_DEVICE, or use rasterizer=torch"
        ) from error


def _choose(name: str | None):
    """The first device with ``name`` in its name; for None the first CPU, or the first device."""
    devices = _devices()
    if name:
        chosen = [device for device in devices if name.lower() in name_of(device).lower()]
    else:
        chosen = [device for device in devices if device.type & cl.device_type.CPU] or devices
    if not chosen:
        listed = "; ".join(map(name_of, devices))
        raise ValueError(
            f"rasterizer 'opencl': no OpenCL device is called {name!r}; there are: {listed}"
        )
    return chosen[0]


@functools.cache
def find_fault(queue: cl.CommandQueue) -> str | None:
    """The driver's reason why a device cannot build kernels, or None.

    One such reason is a processor unknown to the driver's compiler.
    """
    try:
        cl.Program(queue.context, "kernel void probe(global int *value) { value[0] = 1; }").build()
    except cl.Error as error:
        return cause_of(error)
    return None


def cause_of(error: cl.Error) -> str:
    """The first error in a kernel build's log, or the log's last line."""
    lines = [line.strip() for line in str(error).splitlines()]
    # Lines in brackets are pyopencl's notes on options and source.
    lines = [line for line in lines if line and not line.startswith("(")]
    return next((line for line in lines if "error:" in line), lines[-1])
