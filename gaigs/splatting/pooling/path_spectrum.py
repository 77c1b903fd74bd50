"""The spatial spectrum of an array from propagation paths."""

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
    """The conventional beamformer on the covariance of the array's elements.

    Args:
        scene: Scene with the directions of the task and the receivers' planar arrays.

    Raises:
        ValueError: The labels are not spectra scaled to [0, 1], or an array is a point or not
            planar.

    Source: ``LagPooling`` for the covariance, ``Beamformer`` for the spectrum.
    """

    def take_receivers(self, scene: Scene, known: Tensor | None = None) -> None:
        super().take_receivers(scene, known)
        self.beamformer = Beamformer("pooling 'path_spectrum'", scene)
        self.zone = self.beamformer.zone

    def read(
        self, received: Complex[Tensor, "b l"], query: Query, directions: Directions | None = None
    ) -> Float[Tensor, "b ..."]:
        return self.beamformer(received, query, directions)
