"""The fastest rasterizer for the given tensors."""

import logging

from torch import Tensor

from gaigs.registry import register, registry
from gaigs.splatting.projection import Plane, Splats

log = logging.getLogger(__name__)


@register("rasterizer", "fastest")
class FastestRasterizer:
    """``opencl`` for float32 on the CPU if a driver builds kernels, otherwise ``torch``.

    A forked process uses ``torch``. The two agree to 2e-6 of the image's maximum, so either can
    render a checkpoint.
    """

    used: str | None = None

    def __init__(self):
        self.torch = registry("rasterizer").build({"name": "torch"})
        try:
            self.opencl = registry("rasterizer").build({"name": "opencl"})
        except (ImportError, RuntimeError) as error:
            self.opencl = None
            log.info("rasterizer: torch, as opencl does not work here (%s)", error)
        else:
            log.info("rasterizer: opencl for float32 on the CPU, torch for all else")

    def __call__(
        self,
        splats: Splats,
        signal: Tensor,
        opacities: Tensor,
        attenuations: Tensor | None,
        plane: Plane,
    ) -> tuple[Tensor, Tensor]:
        arguments = splats, signal, opacities, attenuations, plane
        if self.opencl is not None and self.opencl.takes(*arguments):
            self.used = self.opencl.used
            return self.opencl(*arguments)
        self.used = self.torch.used
        return self.torch(*arguments)
