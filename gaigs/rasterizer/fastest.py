"""The fastest rasterizer that takes the tensors."""

import logging

from jaxtyping import Float
from torch import Tensor

from gaigs.projection import Plane, Splats
from gaigs.registry import register, registry

log = logging.getLogger(__name__)


@register("rasterizer", "fastest")
class FastestRasterizer:
    """``opencl`` for float32 on the CPU where a driver builds kernels, else ``torch``; the log says which.

    The two agree to 2e-6 of the image's maximum, so a checkpoint may be rendered by either.

    Attributes:
        used: Rasterizer of the last call, for a run's metrics; None before the first.
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
        signal: Float[Tensor, "b n c"],
        opacities: Float[Tensor, "b n"],
        attenuations: Float[Tensor, "b n"] | None,
        plane: Plane,
    ) -> tuple[Float[Tensor, "b c rows columns"], Float[Tensor, "b rows columns"]]:
        """The map, and the transmittance left behind the last splat; see ``gaigs.rasterizer.Rasterizer``."""
        arguments = splats, signal, opacities, attenuations, plane
        if self.opencl is not None and self.opencl.takes(*arguments):
            self.used = self.opencl.used
            return self.opencl(*arguments)
        self.used = self.torch.used
        return self.torch(*arguments)
