"""The rasterizer in OpenCL: float32 tensors on the CPU, any OpenCL device.

The kernels are in kernels/*.cl.
"""

import ctypes
import functools
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyopencl as cl
import pyopencl.tools
import torch
from torch import Tensor

from gaigs.registry import register
from gaigs.splatting.projection import Plane, Splats
from gaigs.splatting.rasterizer import ALPHA_MAX, ALPHA_MIN, OPAQUE, STEEPEST
from gaigs.splatting.rasterizer.devices import cause_of, find_fault, is_forked, name_of, open_queue


@dataclass(frozen=True)
class KernelLayout:
    """Sizes of tiles and lists, equal to constants of the kernels, and limits of a work-item."""

    # Edges of a tile [pixels].
    rows: int = 16
    columns: int = 8
    word: int = 32  # splats in a word of bits
    block: int = 16  # words in a block
    chunk: int = 32  # entries of a list between two checkpoints
    geometry: int = 8  # numbers in a splat's row of the geometry
    moments: int = 5  # numbers in an entry's row of the moments
    # Most transmitters of one work-item, where they share footprints; more would leave the nearest
    # cache.
    group: int = 8
    channels: int = 8  # channels composited at a time: the registers hold a row of each


LAYOUT = KernelLayout()


@register("rasterizer", "opencl")
class OpenCLRasterizer:
    """A rasterizer with tiles of 16 rows of 8 pixels. A work-item draws a tile, row by row.

    Splats are sorted by depth once. Each tile has a list of the splats whose ellipses reach it. If
    transmitters share covariances, they also share lists and footprints. The gradient is written by
    hand. A CPU device reads tensors without a copy. Two runs give the same bits.

    Args:
        device: Part of a name in ``devices``, e.g. "cpu" or "pocl". None: the environment variable
            GAIGS_OPENCL_DEVICE, otherwise the first CPU; the kernels are optimised for CPUs.

    Attributes:
        too_many: Number of splats that exceeds the 24 bits of a list entry.

    Raises:
        RuntimeError: No driver works, or the device cannot build kernels.
        ValueError: No device has this name.

    Source: tiles of Kerbl et al., 3D Gaussian Splatting, 2023, section 6; GAI-GS, "Projection and
    Render Module", eq. (13) and (14).
    """

    too_many = 2**24

    def __init__(self, device: str | None = None):
        self.device = device
        queue = open_queue(device)
        fault = find_fault(queue)
        if fault:
            raise RuntimeError(
                f"rasterizer 'opencl': {name_of(queue.device)} cannot build kernels ({fault}); "
                "use rasterizer=torch, or install a newer driver"
            )

    @property
    def used(self) -> str:
        """The device, for a run's metrics."""
        return f"opencl on {name_of(open_queue(self.device).device)}"

    def takes(
        self,
        splats: Splats,
        signal: Tensor,
        opacities: Tensor,
        attenuations: Tensor | None,
        plane: Plane,
    ) -> bool:
        """True if the kernels can draw these tensors, and OpenCL works in this process."""
        floats = [splats.means2d, splats.factors, splats.depths, signal, opacities]
        floats += [plane.u, plane.v]
        if attenuations is not None:
            floats.append(attenuations)
        suit = all(x.dtype == torch.float32 and x.device.type == "cpu" for x in floats)
        _, n, channels = signal.shape
        return not is_forked() and suit and channels >= 1 and n < self.too_many

    def __call__(
        self,
        splats: Splats,
        signal: Tensor,
        opacities: Tensor,
        attenuations: Tensor | None,
        plane: Plane,
    ) -> tuple[Tensor, Tensor]:
        self._check(splats, signal, opacities, attenuations, plane)
        queue = open_queue(self.device)
        images = []
        transmittances = []  # equal for all channels
        for some_channels in signal.split(LAYOUT.channels, 2):
            image, transmittance = _CompositeByKernels.apply(
                queue,
                splats,
                plane,
                torch.is_grad_enabled(),
                splats.means2d,
                splats.factors,
                some_channels,
                opacities,
                attenuations,
            )
            images.append(image)
            transmittances.append(transmittance)
        return torch.cat(images, 1) if len(images) > 1 else images[0], transmittances[0]

    def _check(
        self,
        splats: Splats,
        signal: Tensor,
        opacities: Tensor,
        attenuations: Tensor | None,
        plane: Plane,
    ) -> None:
        """Raises an error for wrong tensors, since kernels check nothing."""
        b, n, c = signal.shape
        height, width = plane.shape
        # Each tensor with its allowed shapes.
        tensors: dict[str, tuple[Tensor, list[tuple[int, ...]]]] = {
            "means2d": (splats.means2d, [(n, 2)]),
            "factors": (splats.factors, [(1, n, 3), (b, n, 3)]),
            "depths": (splats.depths, [(n,)]),
            "visible": (splats.visible, [(n,)]),
            "signal": (signal, [(b, n, c)]),
            "opacities": (opacities, [(b, n)]),
            "plane.u": (plane.u, [(1, width), (height, width)]),
            "plane.v": (plane.v, [(height, 1), (height, width)]),
        }
        if attenuations is not None:
            tensors["attenuations"] = attenuations, [(b, n)]
        for name, (tensor, shapes) in tensors.items():
            dtype = torch.bool if name == "visible" else torch.float32
            if tensor.dtype != dtype or tensor.device.type != "cpu":
                raise TypeError(
                    f"rasterizer 'opencl' takes {name} as {dtype} on the CPU, "
                    f"got {tensor.dtype} on {tensor.device}; use rasterizer=torch"
                )
            if tuple(tensor.shape) not in shapes:
                allowed = " or ".join(map(str, shapes))
                shape = tuple(tensor.shape)
                raise ValueError(
                    f"{name} must be {allowed} where signal is {(b, n, c)}, got {shape}"
                )
        if c < 1 or n >= self.too_many:
            raise ValueError(
                "rasterizer 'opencl' takes at least 1 channel and fewer than 2^24 splats, "
                f"got {c} and {n}; use rasterizer=torch"
            )


@functools.cache
def _pool(queue: cl.CommandQueue) -> cl.tools.MemoryPool:
    """A pool of buffers that all calls reuse, since new memory costs a page fault every 4 KiB."""
    return cl.tools.MemoryPool(cl.tools.ImmediateAllocator(queue))


def _source() -> str:
    """All kernels, ordered so that functions precede their use."""
    folder = Path(__file__).parent / "kernels"
    names = ("footprint", "bin", "composite", "gradient")
    return "\n".join((folder / f"{name}.cl").read_text() for name in names)


@functools.cache
def _kernels(queue: cl.CommandQueue, **macros: str | int) -> dict[str, cl.Kernel]:
    """The kernels compiled with these macros; PoCL caches the compiled program on disk."""
    # -w: no warning about a CPU without registers of the vectors' width.
    options = ["-w", *(f"-D{macro}={value}" for macro, value in macros.items())]
    try:
        program = cl.Program(queue.context, _source()).build(options)
    except cl.Error as error:
        device = name_of(queue.device)
        raise RuntimeError(
            f"rasterizer 'opencl': {device} cannot build the kernels ({cause_of(error)}); "
            "use rasterizer=torch"
        ) from error
    return {kernel.function_name: kernel for kernel in program.all_kernels()}


class _CompositeByKernels(torch.autograd.Function):
    """The autograd function of ``_Render``.

    Autograd needs the tensors of the splats as arguments of ``forward``, although ``_Render`` has
    them.
    """

    @staticmethod
    def forward(
        ctx, queue, splats, plane, grad_enabled, means, factors, signal, opacities, attenuations
    ):
        ctx.render = _Render(queue, splats, signal, opacities, attenuations, plane)
        return ctx.render.forward(grad_enabled and any(ctx.needs_input_grad))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, image_gradient, transmittance_gradient):
        return None, None, None, None, *ctx.render.backward(image_gradient, transmittance_gradient)


class _Sizes(ctypes.Structure):
    """The fields of the kernels' struct ``sizes_t``."""

    _fields_ = [
        ("transmitters", ctypes.c_int32),
        ("sets", ctypes.c_int32),  # of lists
        ("groups", ctypes.c_int32),
        ("group", ctypes.c_int32),  # transmitters in a group, which share a work-item
        ("splats", ctypes.c_int32),
        ("words", ctypes.c_int32),  # of splats, the last one filled up
        ("height", ctypes.c_int32),  # of the image [pixels]
        ("width", ctypes.c_int32),
        ("down", ctypes.c_int32),  # of the image [tiles]
        ("across", ctypes.c_int32),
        ("entries", ctypes.c_int32),  # of all lists
    ]


class _Render:
    """One call: splats in depth order, the tiles' lists of splats, and the kernels over both.

    If covariances are shared, one set of lists serves all transmitters; otherwise each transmitter
    has its own set. A work-item composites a group of transmitters at once.
    """

    def __init__(self, queue, splats, signal, opacities, attenuations, plane):
        self.queue = queue
        self.channels = signal.shape[2]
        self.attenuates = attenuations is not None
        self.sizes = _measure(splats, signal, plane)
        sizes = self.sizes
        self.tiles = sizes.down * sizes.across
        self.lists = sizes.sets * self.tiles  # one for each tile and set
        self.groups_per_list = sizes.groups if sizes.sets == 1 else 1
        # Transmitters that a work-item has room for, a constant of the kernels.
        self.group_capacity = 1 if sizes.group == 1 else LAYOUT.group
        # Opacity, attenuation and signal of one transmitter.
        self.appearance_size = 1 + self.attenuates + self.channels
        # Numbers that an entry of a list adds to the gradients.
        self.partials = LAYOUT.moments + self.group_capacity * self.appearance_size
        self.is_separable = plane.u.shape[0] == plane.v.shape[1] == 1
        self.kernels = _kernels(queue, **self._macros(plane.period))
        self.order = self._share(_front_to_back(splats.depths))
        self._list_splats(splats, signal, opacities, attenuations, plane)
        # Largest magnitude of each transmitter's signal: where the rest of a list cannot change a
        # pixel, the kernel ends early.
        self.loudest = self._share(np.abs(signal.detach().numpy()).max((1, 2), initial=0))

    def _macros(self, period: float | None) -> dict[str, str | int]:
        """Constants of the kernels for the compiler; ``period`` is as in ``Plane``."""
        macros: dict[str, str | int] = {
            "CHANNELS": self.channels,
            "ATTENUATION": int(self.attenuates),
            "TRANSMITTERS": self.group_capacity,
            "SEPARABLE": int(self.is_separable),
            "ALPHA_MIN": _literal(ALPHA_MIN),
            "ALPHA_MAX": _literal(ALPHA_MAX),
            "OPAQUE": _literal(OPAQUE),
            "STEEPEST": _literal(STEEPEST),
        }
        if period is not None:
            rounding = period - float(np.float32(period))
            macros |= {"PERIOD": _literal(period), "PERIOD_REST": _literal(rounding)}
        return macros

    def _list_splats(self, splats, signal, opacities, attenuations, plane):
        """Lists the splats that reach each tile, front to back.

        Sets ``scene``, buffers that ``forward`` and ``backward`` read, and ``bounds``, where the
        entries of each block of splats begin in each list.
        """
        sizes = self.sizes
        u, v, spans, edges = _tiling(self.queue, _content(plane.u), _content(plane.v), plane.period)
        # Splats fill whole words. A splat has a row of geometry in each set, and of appearance
        # for each transmitter.
        rows = sizes.words * LAYOUT.word
        geometry = self._empty(sizes.sets * rows * LAYOUT.geometry)
        appearance = self._empty(rows * sizes.transmitters * self.appearance_size)
        spans_of_tiles = sizes.across + sizes.down if self.is_separable else 2 * self.tiles
        # A bit for each splat and span of tiles: 1 if the splat's bounding box meets the span.
        hits = self._empty(sizes.sets * sizes.words * spans_of_tiles)
        shapes = splats.means2d, splats.factors, splats.visible
        tensors = *shapes, signal, opacities, attenuations
        inputs = [self._share(tensor) for tensor in tensors]  # they outlive the kernels
        outputs = (geometry, appearance, hits)
        self._run("prepare", sizes.sets * sizes.words, self.order, *inputs, spans, *outputs)

        # Upper bounds of the lists' lengths place the lists in one buffer.
        counts = np.empty(self.lists, np.int32)
        shared_counts = self._share(counts)
        self._run("count", self.lists, hits, shared_counts)
        self._finish(shared_counts)
        offsets = self._share(np.cumsum(counts, dtype=np.int32) - counts)
        sizes.entries = counts.sum()
        self.blocks = math.ceil(sizes.words / LAYOUT.block)
        blocks = self._empty(self.lists * (self.blocks + 1))
        entries = self._empty(sizes.entries)
        tests = (hits, spans, edges, geometry)
        self._run("list", self.lists, *tests, offsets, blocks, entries, shared_counts)
        self.scene = u, v, offsets, shared_counts, entries, geometry, appearance
        self.bounds = blocks

    def forward(self, differentiate):
        """Draws the map and the transmittance.

        Args:
            differentiate: True to store checkpoints for the backward pass.
        """
        sizes = self.sizes
        shape = (sizes.transmitters, self.channels, sizes.height, sizes.width)
        image = torch.empty(shape, dtype=torch.float32)
        transmittance = torch.empty(shape[:1] + shape[2:], dtype=torch.float32)
        outputs = self._share(image), self._share(transmittance)
        items = sizes.groups * self.tiles  # work-items
        ends = self._empty(items)  # entries of its list that each work-item has drawn
        checkpoints, bounds = None, None
        if differentiate:
            # A checkpoint for each chunk of a list, whose last chunk may be incomplete. It has the
            # transmittances of the tile's pixels, and the first and last row still drawn.
            count = self.groups_per_list * (sizes.entries // LAYOUT.chunk + self.lists)
            pixels = LAYOUT.rows * LAYOUT.columns
            checkpoints = self._empty(count * self.group_capacity * pixels)
            bounds = self._empty(count * 2)
        self.path = ends, checkpoints, bounds
        self._run("forward", items, *self.scene, self.loudest, *outputs, *self.path)
        self._finish(*outputs)
        return image, transmittance

    def backward(self, image_gradient, transmittance_gradient):
        """Gradients of centres, factors, signal, opacities and attenuations."""
        sizes = self.sizes
        images = self._share(image_gradient), self._share(transmittance_gradient)
        partials = self._empty(self.groups_per_list * sizes.entries * self.partials)
        items = sizes.groups * self.tiles
        self._run("backward", items, *self.scene, *self.path, *images, partials)
        b, n = sizes.transmitters, sizes.splats
        shapes = [(n, 2), (sizes.sets, n, 3), (b, n, self.channels), (b, n)]
        gradients = [torch.empty(shape, dtype=torch.float32) for shape in shapes]
        gradients.append(torch.empty((b, n), dtype=torch.float32) if self.attenuates else None)
        outputs = [self._share(gradient) for gradient in gradients]
        ends, *_ = self.path
        *_, entries, geometry, appearance = self.scene
        inverse = self.order, self.bounds, ends, entries, geometry, appearance
        self._run("gather", self.blocks, *inverse, partials, *outputs)
        self._finish(*outputs)
        return gradients

    def _run(self, kernel, items, *buffers):
        """Queues a kernel by its name, on ``items`` work-items."""
        if items:  # OpenCL cannot run 0 items
            self.kernels[kernel](self.queue, (items,), (1,), self.sizes, *buffers)

    def _share(self, values):
        """A device buffer over the host's memory of ``values``; a null pointer without values."""
        if isinstance(values, Tensor):
            values = values.detach().numpy()
        if values is None or not values.size:
            return None
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR
        return cl.Buffer(self.queue.context, flags, hostbuf=np.ascontiguousarray(values))

    def _empty(self, size):
        """A device buffer of ``size`` four-byte values, at least one, since none may be empty."""
        return _pool(self.queue).allocate(4 * max(1, int(size)))

    def _finish(self, *buffers):
        """Waits until the kernels' results are in the host's memory."""
        for buffer in filter(None, buffers):
            shape = (buffer.size,)
            cl.enqueue_map_buffer(self.queue, buffer, cl.map_flags.READ, 0, shape, np.uint8)
        self.queue.finish()  # no kernel outlives the host's memory, even without outputs


def _measure(splats: Splats, signal: Tensor, plane: Plane) -> _Sizes:
    """Sizes of a call, without the number of list entries, which is counted later."""
    b, n, _ = signal.shape
    height, width = plane.shape
    sets = len(splats.factors)
    # Transmitters with lists of their own have a work-item of their own.
    groups = b if sets > 1 else max(1, math.ceil(b / LAYOUT.group))
    return _Sizes(
        transmitters=b,
        sets=sets,
        groups=groups,
        group=math.ceil(b / groups),
        splats=n,
        words=math.ceil(n / LAYOUT.word),
        height=height,
        width=width,
        down=math.ceil(height / LAYOUT.rows),
        across=math.ceil(width / LAYOUT.columns),
    )


def _literal(value: float) -> str:
    """A float32 in the syntax of the kernels' compiler."""
    return float(np.float32(value)).hex() + "f"


def _content(tensor: Tensor) -> tuple[bytes, tuple[int, ...]]:
    """A tensor's bytes and shape, as the cache key of ``_tiling``."""
    return tensor.detach().numpy().tobytes(), tuple(tensor.shape)


def _front_to_back(depths: Tensor) -> np.ndarray:
    """Indices sorted by depth, ties by index."""
    bits = np.ascontiguousarray(depths.detach().numpy()).view(np.int32)
    # The bits of floats, read as integers, have the order of the floats. For negative floats all
    # bits but the sign are inverted.
    bits = bits ^ (bits >> 31 & 0x7FFFFFFF)
    # Sorting integers of depth (high half) and index (low half) is faster than an argsort.
    keys = (bits.astype(np.int64) << 32) + np.arange(len(bits))
    keys.sort()
    return (keys & 0xFFFFFFFF).astype(np.int32)


# A training that thins has a plane for each row and column it may start from.
@functools.lru_cache(maxsize=64)
def _tiling(
    queue: cl.CommandQueue,
    u_content: tuple[bytes, tuple],
    v_content: tuple[bytes, tuple],
    period: float | None,
) -> list[cl.Buffer | None]:
    """The pixels of a plane in whole tiles, as buffers for the kernels.

    A span is the range of u, or of v, within a tile. On a separable plane u depends on the column
    only, and v on the row only, so tiles above each other share the span of u, and tiles side by
    side share the span of v.

    Args:
        queue: Command queue of the device.
        u_content, v_content: Bytes and shapes of u and v.
        period: As in ``Plane``.

    Returns:
        Buffers of u and v, filled up by repetition; a separable plane has one u for each column and
        one v for each row. Then spans (centre, half size) of u and of v. Then the lowest and
        highest v of the rows in each span of v. An empty buffer is None.
    """
    u, v = (
        np.frombuffer(data, np.float32).reshape(shape) for data, shape in (u_content, v_content)
    )
    height, width = len(v), u.shape[1]
    down = math.ceil(height / LAYOUT.rows)
    across = math.ceil(width / LAYOUT.columns)
    # Rows and columns of the pixels; the last one repeats.
    y = np.minimum(np.arange(down * LAYOUT.rows), height - 1)
    x = np.minimum(np.arange(across * LAYOUT.columns), width - 1)
    # Axes of the tiles: (down, rows of a tile, across, columns of a tile).
    if len(u) == v.shape[1] == 1:
        u = u[:, x]
        v = v[y]
        u_tiles = u.reshape(1, 1, across, LAYOUT.columns)
        v_tiles = v.reshape(down, LAYOUT.rows, 1, 1)
    else:
        u = np.broadcast_to(u, (height, width))[np.ix_(y, x)]
        v = np.broadcast_to(v, (height, width))[np.ix_(y, x)]
        u_tiles = u.reshape(down, LAYOUT.rows, across, LAYOUT.columns)
        v_tiles = v.reshape(down, LAYOUT.rows, across, LAYOUT.columns)
    # Spans are enlarged, so that rounding drops no splat.
    slack = 1e-6 * (np.abs(u).max(initial=0) + np.abs(v).max(initial=0) + (period or 0))
    row_low = v_tiles.min(3)  # (down, rows, spans in a row of tiles)
    row_high = v_tiles.max(3)
    edges = np.stack((row_low - slack, row_high + slack), 1).transpose(0, 3, 1, 2)
    low = np.concatenate((u_tiles.min((1, 3)).ravel(), row_low.min(1).ravel()))
    high = np.concatenate((u_tiles.max((1, 3)).ravel(), row_high.max(1).ravel()))
    spans = np.stack((0.5 * (low + high), 0.5 * (high - low) + slack), -1)
    flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
    buffers = []
    for values in (u, v, spans, edges):
        array = np.ascontiguousarray(values, np.float32)
        buffer = cl.Buffer(queue.context, flags, hostbuf=array) if array.size else None
        buffers.append(buffer)
    return buffers
