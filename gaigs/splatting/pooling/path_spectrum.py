"""The spatial spectrum as an array sees propagation paths."""

from jaxtyping import Complex, Float
from torch import Tensor

from gaigs.core.geometry import Directions
from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.registry import register
from gaigs.splatting.pooling.beamformer import Beamformer
from gaigs.splatting.pooling.paths import LagPooling


@register("pooling", "path_spectrum")
class PathSpectrum(LagPooling):
    """Beamforming with the covariance of the array's elements."""

    def __init__(self, scene: Scene):
        super().__init__(scene)
        self.beamformer = Beamformer("pooling 'path_spectrum'", scene)
        self.zone = self.beamformer.zone

    def read(
        self, received: Complex[Tensor, "b l"], query: Query, directions: Directions | None = None
    ) -> Float[Tensor, "b ..."]:
        return self.beamformer(received, query, directions)
