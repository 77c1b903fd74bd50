"""RSSI as the power of propagation paths."""

from jaxtyping import Complex, Float
from torch import Tensor

from gaigs.core.geometry import Directions
from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.registry import register
from gaigs.splatting.pooling.mean_power import noise_amplitude
from gaigs.splatting.pooling.paths import LagPooling


@register("pooling", "path_rssi")
class PathRssi(LagPooling):
    """Mean power at the elements plus receiver noise, in dB relative to a direct path of 1 m.

    Args:
        scene: Scene whose receivers have planar arrays.
        floor_db: Power of the noise relative to the model's trend, between -300 and 0 [dB].

    Raises:
        ValueError: The floor is out of range, or an array is not planar.

    Source: GAI-GS, eq. (3), for the level; ``LagPooling`` for the power.
    """

    def __init__(self, scene: Scene, floor_db: float = -120.0):
        super().__init__(scene)
        self.floor = noise_amplitude(floor_db)

    def read(
        self, received: Complex[Tensor, "b l"], query: Query, directions: Directions | None = None
    ) -> Float[Tensor, " b"]:
        """Level relative to the model's trend [dB]."""
        power = received[:, received.shape[1] // 2].real  # lag 0
        return 10 * (power + self.floor**2).log10()
