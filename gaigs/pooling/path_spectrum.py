"""The spatial spectrum as an array sees propagation paths."""

from jaxtyping import Complex, Float
from torch import Tensor

from gaigs.geometry import Directions
from gaigs.pooling.beamformer import Beamformer
from gaigs.pooling.paths import LagPooling
from gaigs.query import Query
from gaigs.registry import register
from gaigs.scene import Scene


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
