"""The rasterizer in OpenCL: float32 tensors on the CPU, any OpenCL device; the kernels stand in
kernels/*.cl.
"""

import ctypes
import functools
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

ROWS, COLUMNS = 16, 8
"""Edges of a tile in pixels, as in the kernels."""

WORD, BLOCK, CHUNK, GEOMETRY, MOMENTS = 32, 16, 32, 8, 5
"""Splats a word of bits, words a block, entries a checkpoint, and lengths of rows in buffers, as in
the kernels.
"""

GROUP = 8
"""Most transmitters of one work-item, where they share footprints; more would leave the nearest
cache.
"""

CHANNELS = 8
"""Channels composited at a time: the registers hold a row of each."""

SPLATS = 2**24
"""Number of splats that is too large: an entry of a list has 24 bits for the splat."""


@register("rasterizer", "opencl")
class OpenCLRasterizer:
    """Tiles of 16 rows of 8 pixels, a work-item each, their rows in vector registers; the gradient
    is written by hand.

    Splats are sorted by depth once, and listed by the tiles that their ellipses reach: once for all
    transmitters where these share covariances, which then share footprints too. A CPU device reads
    tensors without a copy. Two runs give the same bits.

    Args:
        device: Part of a name that ``devices`` lists, e.g. "cpu" or "pocl". None: the environment
            variable GAIGS_OPENCL_DEVICE, and without it the first CPU, for which the kernels are
            made.
    """

    def __init__(self, device: str | None = None):
        self.device = device
        queue = open_queue(device)
        if fault := find_fault(queue):
            raise RuntimeError(
                f"rasterizer 'opencl': {name_of(queue.device)} cannot build kernels ({fault}); use rasterizer=torch, "
                "or install a newer driver"
            )

    @property
    def used(self) -> str:
        return f"opencl on {name_of(open_queue(self.device).device)}"

    def takes(
        self,
        splats: Splats,
        signal: Tensor,
        opacities: Tensor,
        attenuations: Tensor | None,
        plane: Plane,
    ) -> bool:
        """True if dtypes, devices and counts suit, and OpenCL works in this process."""
        floats = (
            splats.means2d,
            splats.factors,
            splats.depths,
            signal,
            opacities,
            attenuations,
            plane.u,
            plane.v,
        )
        suits = (x is None or (x.dtype == torch.float32 and x.device.type == "cpu") for x in floats)
        return not is_forked() and all(suits) and signal.shape[2] >= 1 and signal.shape[1] < SPLATS

    def __call__(
        self,
        splats: Splats,
        signal: Tensor,
        opacities: Tensor,
        attenuations: Tensor | None,
        plane: Plane,
    ) -> tuple[Tensor, Tensor]:
        _check(splats, signal, opacities, attenuations, plane)
        common = (
            open_queue(self.device),
            splats,
            plane,
            torch.is_grad_enabled(),
            splats.means2d,
            splats.factors,
        )
        chunks = [
            _CompositeByKernels.apply(*common, part, opacities, attenuations)
            for part in signal.split(CHANNELS, 2)
        ]
        images, transmittances = zip(*chunks, strict=True)
        return torch.cat(images, 1) if len(images) > 1 else images[0], transmittances[0]


@functools.cache
def _pool(queue: cl.CommandQueue) -> cl.tools.MemoryPool:
    """Buffers that live on from call to call: fresh memory would cost a page fault every 4 KiB."""
    return cl.tools.MemoryPool(cl.tools.ImmediateAllocator(queue))


def _source() -> str:
    """All kernels, in the order in which they use each other's functions."""
    folder = Path(__file__).parent / "kernels"
    return "\n".join(
        (folder / f"{name}.cl").read_text()
        for name in ("footprint", "bin", "composite", "gradient")
    )


@functools.cache
def _kernels(queue: cl.CommandQueue, **macros: str | int) -> dict[str, cl.Kernel]:
    """The kernels of one shape family; PoCL caches the compiled program on disk."""
    # -w: no warning about a CPU without registers of the vectors' width.
    options = ["-w", *(f"-D{macro}={value}" for macro, value in macros.items())]
    try:
        program = cl.Program(queue.context, _source()).build(options)
    except cl.Error as error:
        device = name_of(queue.device)
        raise RuntimeError(
            f"rasterizer 'opencl': {device} cannot build the kernels ({cause_of(error)}); use rasterizer=torch"
        ) from error
    return {kernel.function_name: kernel for kernel in program.all_kernels()}


def _check(
    splats: Splats, signal: Tensor, opacities: Tensor, attenuations: Tensor | None, plane: Plane
) -> None:
    """Raises where tensors do not fit: kernels check nothing."""
    b, n, c = signal.shape
    height, width = plane.shape
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
                f"rasterizer 'opencl' takes {name} as {dtype} on the CPU, got {tensor.dtype} on {tensor.device}; "
                "use rasterizer=torch"
            )
        if tuple(tensor.shape) not in shapes:
            allowed = " or ".join(map(str, shapes))
            raise ValueError(
                f"{name} must be {allowed} where signal is {(b, n, c)}, got {tuple(tensor.shape)}"
            )
    if c < 1 or n >= SPLATS:
        allowed = "at least 1 channel and fewer than 2^24 splats"
        raise ValueError(
            f"rasterizer 'opencl' takes {allowed}, got {c} and {n}; use rasterizer=torch"
        )


class _CompositeByKernels(torch.autograd.Function):
    """Autograd differentiates by the arguments; ``_Render`` finds the same tensors in the splats."""

    @staticmethod
    def forward(
        ctx, queue, splats, plane, grad_enabled, means, factors, signal, opacities, attenuations
    ):
        ctx.render = _Render(queue, splats, signal, opacities, attenuations, plane)
        return ctx.render.forward(grad_enabled and any(ctx.needs_input_grad))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, image_gradient, left_gradient):
        return None, None, None, None, *ctx.render.backward(image_gradient, left_gradient)


class _Sizes(ctypes.Structure):
    """The kernels' ``sizes_t``."""

    _fields_ = [
        (name, ctypes.c_int32)
        for name in "transmitters sets groups group splats words height width down across entries".split()
    ]


class _Render:
    """One call: splats in depth order, the tiles' lists of them, and the kernels over both.

    Lists come in sets: one for all transmitters where covariances are shared, else one a
    transmitter. A work-item composites a group of transmitters at once.
    """

    def __init__(self, queue, splats, signal, opacities, attenuations, plane):
        self.queue = queue
        b, n, self.channels = signal.shape
        height, width = plane.shape
        sets = len(splats.factors)
        groups = b if sets > 1 else max(1, -(-b // GROUP))
        group = -(-b // groups)
        down, across, words = -(-height // ROWS), -(-width // COLUMNS), -(-n // WORD)
        self.sizes = _Sizes(b, sets, groups, group, n, words, height, width, down, across)
        self.tiles, self.lists = down * across, sets * down * across
        self.groups_per_list = groups if sets == 1 else 1
        self.attenuates = attenuations is not None
        appearance_size = (
            1 + self.attenuates + self.channels
        )  # opacity, attenuation, signal: of one transmitter
        self.group_capacity = 1 if group == 1 else GROUP
        self.partials = MOMENTS + self.group_capacity * appearance_size
        separable = plane.u.shape[0] == plane.v.shape[1] == 1
        macros = {
            "CHANNELS": self.channels,
            "ATTENUATION": int(self.attenuates),
            "TRANSMITTERS": self.group_capacity,
        }
        bounds = {
            "ALPHA_MIN": ALPHA_MIN,
            "ALPHA_MAX": ALPHA_MAX,
            "OPAQUE": OPAQUE,
            "STEEPEST": STEEPEST,
        }
        macros |= {"SEPARABLE": int(separable)} | {
            name: _literal(value) for name, value in bounds.items()
        }
        if plane.period is not None:
            rest = plane.period - float(np.float32(plane.period))
            macros |= {"PERIOD": _literal(plane.period), "PERIOD_REST": _literal(rest)}
        self.kernels = _kernels(queue, **macros)

        order = self._share(_front_to_back(splats.depths))
        coordinates = [
            (part.detach().numpy().tobytes(), tuple(part.shape)) for part in (plane.u, plane.v)
        ]
        u, v, spans, edges = _tiling(queue, *coordinates, plane.period)
        geometry = self._empty(sets * words * WORD * GEOMETRY)
        appearance = self._empty(words * WORD * b * appearance_size)
        hits = self._empty(sets * words * (across + down if separable else 2 * self.tiles))
        tensors = splats.means2d, splats.factors, splats.visible, signal, opacities, attenuations
        inputs = [
            self._share(tensor) for tensor in tensors
        ]  # named, so that they outlive the kernels
        self._run("prepare", sets * words, order, *inputs, spans, geometry, appearance, hits)

        counts = np.empty(self.lists, np.int32)
        shared_counts = self._share(counts)
        self._run("count", self.lists, hits, shared_counts)
        self._finish(shared_counts)
        offsets = self._share(np.cumsum(counts, dtype=np.int32) - counts)
        self.sizes.entries = counts.sum()
        self.blocks = -(-words // BLOCK)
        blocks, entries = (
            self._empty(self.lists * (self.blocks + 1)),
            self._empty(self.sizes.entries),
        )
        self._run(
            "list",
            self.lists,
            hits,
            spans,
            edges,
            geometry,
            offsets,
            blocks,
            entries,
            shared_counts,
        )
        self.scene = u, v, offsets, shared_counts, entries, geometry, appearance
        self.order, self.bounds = order, blocks
        self.loudest = self._share(np.abs(signal.detach().numpy()).max((1, 2), initial=0))

    def forward(self, differentiate):
        """The map and the transmittance; to ``differentiate``, checkpoints for the way back are
        kept.
        """
        sizes = self.sizes
        image = torch.empty(
            sizes.transmitters, self.channels, sizes.height, sizes.width, dtype=torch.float32
        )
        left = torch.empty(sizes.transmitters, sizes.height, sizes.width, dtype=torch.float32)
        outputs = self._share(image), self._share(left)
        ends, checkpoints, bounds = self._empty(sizes.groups * self.tiles), None, None
        if differentiate:
            size = self.groups_per_list * (sizes.entries // CHUNK + self.lists)
            checkpoints = self._empty(size * self.group_capacity * ROWS * COLUMNS)
            bounds = self._empty(size * 2)
        self._run(
            "forward",
            sizes.groups * self.tiles,
            *self.scene,
            self.loudest,
            *outputs,
            ends,
            checkpoints,
            bounds,
        )
        self.path = ends, checkpoints, bounds
        self._finish(*outputs)
        return image, left

    def backward(self, image_gradient, left_gradient):
        sizes = self.sizes
        b, n = sizes.transmitters, sizes.splats
        images = self._share(image_gradient), self._share(left_gradient)
        partials = self._empty(self.groups_per_list * sizes.entries * self.partials)
        self._run("backward", sizes.groups * self.tiles, *self.scene, *self.path, *images, partials)
        shapes = (
            (n, 2),
            (sizes.sets, n, 3),
            (b, n, self.channels),
            (b, n),
            (b, n) if self.attenuates else None,
        )
        gradients = [
            None if shape is None else torch.empty(shape, dtype=torch.float32) for shape in shapes
        ]
        outputs = [self._share(gradient) for gradient in gradients]
        *_, entries, geometry, appearance = self.scene
        inverse = self.order, self.bounds, self.path[0], entries, geometry, appearance
        self._run("gather", self.blocks, *inverse, partials, *outputs)
        self._finish(*outputs)
        return gradients

    def _run(self, kernel, items, *buffers):
        if items:  # OpenCL cannot run 0 items
            self.kernels[kernel](self.queue, (items,), (1,), self.sizes, *buffers)

    def _share(self, values):
        """The host's memory as the device sees it; the null pointer for no values."""
        if isinstance(values, Tensor):
            values = values.detach().numpy()
        if values is None or not values.size:
            return None
        flags = cl.mem_flags.READ_WRITE | cl.mem_flags.USE_HOST_PTR
        return cl.Buffer(self.queue.context, flags, hostbuf=np.ascontiguousarray(values))

    def _empty(self, size):
        """Four-byte values that stay on the device; no buffer of OpenCL is empty."""
        return _pool(self.queue).allocate(4 * max(1, int(size)))

    def _finish(self, *buffers):
        """Waits until the kernels' results are in the host's memory."""
        for buffer in filter(None, buffers):
            cl.enqueue_map_buffer(
                self.queue, buffer, cl.map_flags.READ, 0, (buffer.size,), np.uint8
            )
        self.queue.finish()  # no kernel outlives the host's memory, even without outputs


def _literal(value: float) -> str:
    return float(np.float32(value)).hex() + "f"


def _front_to_back(depths: Tensor) -> np.ndarray:
    """Indices by depth, ties by index: sorted as integers, whose low half is the index."""
    bits = np.ascontiguousarray(depths.detach().numpy()).view(np.int32)
    bits = bits ^ (
        bits >> 31 & 0x7FFFFFFF
    )  # integers in the order of the floats, negative ones too
    keys = (bits.astype(np.int64) << 32) + np.arange(len(bits))
    keys.sort()
    return (keys & 0xFFFFFFFF).astype(np.int32)


@functools.lru_cache(
    maxsize=64
)  # a training that thins has a plane for each row and column it may start from
def _tiling(
    queue: cl.CommandQueue,
    of_u: tuple[bytes, tuple],
    of_v: tuple[bytes, tuple],
    period: float | None,
) -> list[cl.Buffer | None]:
    """A plane in whole tiles, as the kernels read it, from the bytes and shapes of u and v.

    Returns u and v, filled up by repetition, one a column and one a row where the plane is
    separable; spans (centre, half size) of u, then of v; and edges, the least v of the rows of each
    span of v and then their largest.
    """
    u, v = (np.frombuffer(data, np.float32).reshape(shape) for data, shape in (of_u, of_v))
    height, width = len(v), u.shape[1]
    down, across = -(-height // ROWS), -(-width // COLUMNS)
    y, x = (
        np.minimum(np.arange(down * ROWS), height - 1),
        np.minimum(np.arange(across * COLUMNS), width - 1),
    )
    if len(u) == v.shape[1] == 1:
        u, v = u[:, x], v[y]
        u_tiles, v_tiles = u.reshape(1, 1, across, COLUMNS), v.reshape(down, ROWS, 1, 1)
    else:
        u, v = (np.broadcast_to(coordinate, (height, width))[np.ix_(y, x)] for coordinate in (u, v))
        u_tiles, v_tiles = (
            coordinate.reshape(down, ROWS, across, COLUMNS) for coordinate in (u, v)
        )
    slack = 1e-6 * (
        np.abs(u).max(initial=0) + np.abs(v).max(initial=0) + (period or 0)
    )  # for rounding
    columns = u_tiles.min((1, 3)).ravel(), u_tiles.max((1, 3)).ravel()
    rows = v_tiles.min(3), v_tiles.max(3)  # (down, ROWS, spans in a row of tiles)
    edges = np.stack((rows[0] - slack, rows[1] + slack), 1).transpose(0, 3, 1, 2)
    low, high = map(
        np.concatenate, zip(columns, (rows[0].min(1).ravel(), rows[1].max(1).ravel()), strict=True)
    )
    spans = np.stack((0.5 * (low + high), 0.5 * (high - low) + slack), -1)
    flags = cl.mem_flags.READ_ONLY | cl.mem_flags.COPY_HOST_PTR
    arrays = (np.ascontiguousarray(array, np.float32) for array in (u, v, spans, edges))
    return [
        cl.Buffer(queue.context, flags, hostbuf=array) if array.size else None for array in arrays
    ]
