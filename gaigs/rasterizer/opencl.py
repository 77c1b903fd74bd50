"""The rasterizer in OpenCL: CPU tensors, float32, any OpenCL device; the kernels stand in kernels/*.cl."""

import ctypes
import functools
import os
from pathlib import Path

import numpy as np
import pyopencl as cl
import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.projection import Plane, Splats
from gaigs.rasterizer import ALPHA_MAX, ALPHA_MIN
from gaigs.registry import register

ROWS, COLUMNS = 16, 8
"""A tile's; the kernels say the same."""

GROUP = 8
"""Transmitters that one work-item composites at most, where they share footprints; more would leave the nearest cache."""


@register("rasterizer", "opencl")
class OpenCLRasterizer:
    """Tiles of 16 x 8 pixels, one work-item each, their rows in vector registers; the gradient is written by hand.

    Splats are sorted by depth once, and listed once by the tiles that their ellipses reach, for all transmitters where
    these share covariances: then footprints too are computed once. Tensors are handed over without a copy on a CPU
    device. Two runs give the same bits. Contract and formulas: ``gaigs.rasterizer.Rasterizer``.

    Args:
        device: Part of a name that ``devices`` lists, e.g. "cpu" or "pocl"; None takes the environment variable
            GAIGS_OPENCL_DEVICE, and without it the first CPU, for which the kernels are made.

    Raises:
        RuntimeError: There is no OpenCL driver.
        ValueError: No device has such a name.
    """

    def __init__(self, device: str | None = None):
        self.device = device
        _queue(device)

    def __call__(
        self,
        splats: Splats,
        signal: Float[Tensor, "b n c"],
        opacities: Float[Tensor, "b n"],
        attenuations: Float[Tensor, "b n"] | None,
        plane: Plane,
    ) -> tuple[Float[Tensor, "b c rows columns"], Float[Tensor, "b rows columns"]]:
        """The map, and the transmittance left behind the last splat; see ``gaigs.rasterizer.Rasterizer``.

        Raises:
            TypeError: A tensor is not float32, or not on the CPU.
            ValueError: Shapes do not fit together, or there are more than 8 channels.
        """
        _check(splats, signal, opacities, attenuations, plane)
        return _Composite.apply(
            _queue(self.device),
            splats,
            plane,
            splats.means2d,
            splats.covariances2d,
            signal,
            opacities,
            attenuations,
        )


def devices() -> list[str]:
    """The OpenCL devices of this machine, as "platform: device".

    Raises:
        RuntimeError: There is no OpenCL driver.
    """
    return [_name(device) for device in _devices()]


def _name(device: cl.Device) -> str:
    kind = cl.device_type.to_string(device.type & ~cl.device_type.DEFAULT)
    return f"{device.platform.name}: {device.name} ({kind})"


def _devices() -> list[cl.Device]:
    try:
        found = [device for platform in cl.get_platforms() for device in platform.get_devices()]
    except cl.LogicError:  # the loader found no platform
        found = []
    if not found:
        raise RuntimeError("rasterizer 'opencl' needs an OpenCL driver: pip install 'pyopencl[pocl]'")
    return found


def _queue(name: str | None) -> cl.CommandQueue:
    return _open(name or os.environ.get("GAIGS_OPENCL_DEVICE"))


@functools.cache
def _open(name: str | None) -> cl.CommandQueue:
    found = _devices()
    if name is None:
        chosen = [device for device in found if device.type & cl.device_type.CPU] or found
    else:
        chosen = [device for device in found if name.lower() in _name(device).lower()]
    if not chosen:
        listed = "; ".join(_name(device) for device in found)
        raise ValueError(f"rasterizer 'opencl': no OpenCL device is called {name!r}; there are: {listed}")
    return cl.CommandQueue(cl.Context(chosen[:1]))


@functools.cache
def _kernels(queue: cl.CommandQueue, **macros: str | int) -> dict[str, cl.Kernel]:
    """The kernels of one shape family; OpenCL keeps what it compiled on disk."""
    folder = Path(__file__).parent / "kernels"
    source = "\n".join((folder / f"{name}.cl").read_text() for name in ("footprint", "bin", "composite"))
    options = [f"-D{macro}={value}" for macro, value in macros.items()]
    try:
        program = cl.Program(queue.context, source).build(["-w", *options])
    except cl.RuntimeError as error:
        raise RuntimeError(f"rasterizer 'opencl': {_name(queue.device)} cannot build the kernels; use rasterizer=torch") from error
    return {kernel.function_name: kernel for kernel in program.all_kernels()}


def _literal(value: float) -> str:
    return float(np.float32(value)).hex() + "f"


def _check(splats: Splats, signal: Tensor, opacities: Tensor, attenuations: Tensor | None, plane: Plane) -> None:
    """Kernels trust what they are given."""
    b, n, c = signal.shape
    rows, columns = plane.shape
    tensors = {
        "means2d": (splats.means2d, [(n, 2)]),
        "covariances2d": (splats.covariances2d, [(1, n, 2, 2), (b, n, 2, 2)]),
        "depths": (splats.depths, [(n,)]),
        "signal": (signal, [(b, n, c)]),
        "opacities": (opacities, [(b, n)]),
        "plane.u": (plane.u, [(1, columns), (rows, columns)]),
        "plane.v": (plane.v, [(rows, 1), (rows, columns)]),
    }
    if attenuations is not None:
        tensors["attenuations"] = (attenuations, [(b, n)])
    for name, (tensor, shapes) in tensors.items():
        if tensor.dtype != torch.float32 or tensor.device.type != "cpu":
            raise TypeError(
                f"rasterizer 'opencl' takes float32 tensors on the CPU, got {name} as {tensor.dtype} on {tensor.device}; "
                "use rasterizer=torch"
            )
        if tuple(tensor.shape) not in shapes:
            raise ValueError(f"{name} must be {' or '.join(map(str, shapes))} as signal is {(b, n, c)}, got {tuple(tensor.shape)}")
    if not 1 <= c <= 8:
        raise ValueError(f"rasterizer 'opencl' takes 1 to 8 channels, got {c}; use rasterizer=torch")


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(ctx, queue, splats, plane, means, covariances, signal, opacities, attenuations):
        ctx.render = _Render(queue, splats, signal, opacities, attenuations, plane)
        image, left = ctx.render.forward()
        ctx.save_for_backward(image, left)
        return image, left

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, image_gradient, left_gradient):
        return None, None, None, *ctx.render.backward(*ctx.saved_tensors, image_gradient, left_gradient)


class _Sizes(ctypes.Structure):
    """The kernels' ``sizes_t``."""

    _fields_ = [
        (name, ctypes.c_int32)
        for name in ("transmitters", "sets", "groups", "group", "splats", "seen", "words", "height", "width", "down", "across", "entries")
    ]


class _Render:
    """One call: the splats in depth order, the tiles' lists of them, and the kernels over both.

    Lists come in sets: one for all transmitters where covariances are shared, else one a transmitter. Transmitters come
    in groups, which one work-item composites at once.
    """

    def __init__(self, queue, splats, signal, opacities, attenuations, plane):
        self.queue = queue
        order = _front_to_back(splats)
        b, n, self.channels = signal.shape
        sets, seen = len(splats.covariances2d), len(order)
        groups = b if sets > 1 else -(-b // GROUP)
        height, width = plane.shape
        down, across = -(-height // ROWS), -(-width // COLUMNS)
        self.sizes = _Sizes(b, sets, groups, -(-b // groups), n, seen, -(-seen // 32), height, width, down, across)
        self.attenuates = attenuations is not None
        if not seen:
            return
        separable = plane.u.shape[0] == plane.v.shape[1] == 1
        macros = {
            "CHANNELS": self.channels,
            "ATTENUATION": int(self.attenuates),
            "TRANSMITTERS": 1 if self.sizes.group == 1 else GROUP,
            "SEPARABLE": int(separable),
            "ALPHA_MIN": _literal(ALPHA_MIN),
            "ALPHA_MAX": _literal(ALPHA_MAX),
        }
        if plane.period is not None:
            macros["PERIOD"] = _literal(plane.period)
            macros["PERIOD_REST"] = _literal(plane.period - float(np.float32(plane.period)))
        self.kernels = _kernels(queue, **macros)
        looks = 1 + self.attenuates + self.channels  # opacity, attenuation, signal
        self.partials = 5 + macros["TRANSMITTERS"] * looks

        self.order = self._share(order)
        self.geometry, boxes = self._empty(sets * self.sizes.words * 32 * 8), self._empty(sets * self.sizes.words * 32 * 4)
        self.appearance = self._empty(self.sizes.words * 32 * b * looks)
        inputs = splats.means2d, splats.covariances2d, signal, opacities, attenuations
        self._run("prepare", sets * self.sizes.words, self.order, *map(self._share, inputs), self.geometry, boxes, self.appearance)

        lists = sets * down * across
        u, v, spans, rows = (self._share(array) for array in _tiles(plane, down, across, separable))
        bits, ranks = self._empty(lists * self.sizes.words), self._empty(lists * self.sizes.words)
        counts = np.empty(lists, np.int32)
        shared_counts = self._share(counts)
        self._run("mark", lists, boxes, spans, bits, shared_counts)
        self._finish(shared_counts)
        offsets = self._share(np.cumsum(counts, dtype=np.int32) - counts)
        self.sizes.entries = counts.sum()
        entries = self._empty(self.sizes.entries)
        self._run("list", lists, self.geometry, spans, rows, offsets, bits, ranks, entries, shared_counts)
        self.lists = u, v, offsets, shared_counts, entries, self.geometry, self.appearance
        self.inverse = self.order, bits, ranks, self.geometry, self.appearance
        self.loudest = self._share(signal.detach().abs().amax((1, 2)))

    def forward(self):
        sizes = self.sizes
        image = torch.zeros(sizes.transmitters, self.channels, sizes.height, sizes.width)
        left = torch.ones(sizes.transmitters, sizes.height, sizes.width)
        if sizes.seen:
            self.stops = self._empty(sizes.groups * sizes.down * sizes.across)
            outputs = self._share(image), self._share(left)
            self._run("forward", sizes.groups * sizes.down * sizes.across, *self.lists, self.loudest, *outputs, self.stops)
            self._finish(*outputs)
        return image, left

    def backward(self, image, left, image_gradient, left_gradient):
        sizes = self.sizes
        b, n = sizes.transmitters, sizes.splats
        shapes = (n, 2), (sizes.sets, n, 2, 2), (b, n, self.channels), (b, n), (b, n) if self.attenuates else None
        gradients = [None if shape is None else torch.zeros(shape) for shape in shapes]
        if sizes.seen:
            partials = self._empty((sizes.groups if sizes.sets == 1 else 1) * sizes.entries * self.partials)
            images = map(self._share, (image, left, image_gradient, left_gradient))
            self._run("backward", sizes.groups * sizes.down * sizes.across, *self.lists, *images, self.stops, partials)
            outputs = [self._share(gradient) for gradient in gradients]
            self._run("gather", sizes.words, *self.inverse, partials, *outputs)
            self._finish(*outputs)
        return gradients

    def _run(self, kernel, items, *buffers):
        self.kernels[kernel](self.queue, (items,), (1,), self.sizes, *buffers)

    def _share(self, values):
        """Memory of the host as the device sees it; on a CPU it is the same."""
        if values is None:
            return None
        values = values.detach().contiguous().numpy() if isinstance(values, Tensor) else np.ascontiguousarray(values)
        return cl.Buffer(self.queue.context, cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR, hostbuf=values)

    def _empty(self, size):
        """Four-byte values that stay on the device; no buffer is empty in OpenCL."""
        return cl.Buffer(self.queue.context, cl.mem_flags.READ_WRITE, 4 * max(1, size))

    def _finish(self, *buffers):
        """Waits until what kernels wrote to shared memory is there for the host."""
        for buffer in filter(None, buffers):
            cl.enqueue_map_buffer(self.queue, buffer, cl.map_flags.READ, 0, (buffer.size,), np.uint8)


def _front_to_back(splats: Splats) -> np.ndarray:
    """Indices of the visible splats by depth, ties by index: sorted as integers, whose low half is the index."""
    bits = splats.depths.detach().contiguous().numpy().view(np.int32)
    ordered = bits ^ (bits >> 31 & 0x7FFFFFFF)  # integers in the order of the floats, negative ones too
    keys = (ordered.astype(np.int64) << 32) + np.arange(len(bits))
    keys = keys[splats.visible.numpy()]
    keys.sort()
    return (keys & 0xFFFFFFFF).astype(np.int32)


def _tiles(plane: Plane, down: int, across: int, separable: bool) -> tuple[np.ndarray, ...]:
    """The plane's coordinates, filled up to whole tiles by repetition, and what the tiles span.

    Returns:
        u, v: One a column and one a row where the plane is separable, else full grids.
        spans: Centre and half size in u, then in v (down, across, 4).
        rows: Least and largest v of each row of each tile (down, across, 2, ROWS).
    """
    height, width = plane.shape
    y, x = np.arange(down * ROWS).clip(max=height - 1), np.arange(across * COLUMNS).clip(max=width - 1)
    u, v = plane.u.detach().numpy(), plane.v.detach().numpy()
    slack = 1e-6 * max(np.abs(u).max(), np.abs(v).max())  # a few roundings'
    if separable:
        u, v = u[:, x], v[y]
        u_tiles, v_tiles = u.reshape(1, 1, across, COLUMNS), v.reshape(down, ROWS, 1, 1)
    else:
        u, v = (np.broadcast_to(coordinate, (height, width))[y][:, x] for coordinate in (u, v))
        u_tiles, v_tiles = (coordinate.reshape(down, ROWS, across, COLUMNS) for coordinate in (u, v))
    rows = np.stack((v_tiles.min(3), v_tiles.max(3)), 1).transpose(0, 3, 1, 2)
    rows = np.broadcast_to(rows, (down, across, 2, ROWS)) + slack * np.float32([[-1], [1]])
    spans = np.empty((down, across, 4), np.float32)
    for axis, (low, high) in enumerate(((u_tiles.min((1, 3)), u_tiles.max((1, 3))), (rows[:, :, 0].min(2), rows[:, :, 1].max(2)))):
        spans[..., 2 * axis] = (low + high) / 2
        spans[..., 2 * axis + 1] = (high - low) / 2 + slack
    return u, v, spans, rows
