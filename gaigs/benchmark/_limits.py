"""What a machine's arithmetic allows: its matrix products, and the OpenCL kernels with every operand at hand."""

from pathlib import Path

import numpy as np
import torch

from gaigs.benchmark import clock
from gaigs.rasterizer import ALPHA_MAX, ALPHA_MIN, OPAQUE, STEEPEST

EDGE = {"cpu": 512, "cuda": 8192}
"""Edge of the matrices whose product is timed, by device."""

WAYS = "forward", "backward"


def operations(way: str, channels: int, attenuation: bool) -> int:
    """Additions and multiplications that one pair of a splat and a pixel takes, by the formulas.

    Forward: 22 for the footprint, of which 13 are for the exponential; 5 for opacity and transmittance; 2 a channel;
    and 20 where splats attenuate, for a power. Backward: as much again, as memory holds no pairs; 14 for the gradients
    of opacity and footprint, 4 a channel, 4 for attenuation.
    """
    forward = 27 + 2 * channels + 20 * attenuation
    return forward if way == "forward" else forward + 14 + 4 * channels + 4 * attenuation


OPERATIONS_OF_FIELDS = {"forward": 60, "backward": 120}
"""Of one pair of a splat and an element: 10 for phase and spread, 13 for an exponential, 30 for sine and cosine, 7 for
a complex product; and twice that on the way back."""


class Product:
    """A matrix product on a device: the most operations a second that this machine is known to reach."""

    def __init__(self, device: str, dtype: torch.dtype):
        edge = EDGE[device]
        self.left, self.right = torch.full((2, edge, edge), 0.01, dtype=dtype, device=device)
        self.operations, self.now = 2 * edge**3, clock(device)

    def measure(self) -> float:
        """Operations a second."""
        start = self.now()
        self.left @ self.right
        return self.operations / (self.now() - start)


class Ceiling:
    """The OpenCL kernels' arithmetic for a pair with all lanes live: no lists, no rows that miss, no tiles to load.

    Raises:
        ImportError, RuntimeError: There is no OpenCL driver that builds kernels.
    """

    def __init__(self, channels: int, attenuation: bool):
        import pyopencl as cl

        from gaigs.rasterizer import opencl

        self.queue = opencl.open_queue(None)
        macros = {"CHANNELS": channels, "ATTENUATION": int(attenuation), "TRANSMITTERS": 1, "SEPARABLE": 1}
        bounds = {"ALPHA_MIN": ALPHA_MIN, "ALPHA_MAX": ALPHA_MAX, "OPAQUE": OPAQUE, "STEEPEST": STEEPEST}
        macros |= {bound: opencl._literal(value) for bound, value in bounds.items()}
        options = ["-w", *(f"-D{macro}={value}" for macro, value in macros.items())]
        source = opencl._source() + Path(__file__).with_name("ceiling.cl").read_text()
        program = cl.Program(self.queue.context, source).build(options)
        self.kernels = {way: cl.Kernel(program, f"ceiling_{way}") for way in WAYS}
        self.items = 4 * self.queue.device.max_compute_units
        values = np.full(64 + self.items, 0.01, np.float32)
        self.memory = cl.Buffer(self.queue.context, cl.mem_flags.COPY_HOST_PTR, hostbuf=values)
        self.pairs = self.items * opencl.CHUNK * opencl.ROWS * opencl.COLUMNS

    def measure(self, way: str, chunks: int = 100) -> float:
        """Time of a pair [s]."""
        now = clock()
        start = now()
        self.kernels[way](self.queue, (self.items,), (1,), self.memory, np.int32(chunks)).wait()
        return (now() - start) / (self.pairs * chunks)
