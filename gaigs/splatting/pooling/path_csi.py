"""Complex channels as the sum of propagation paths at each element."""

import math

from jaxtyping import Complex
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.geometry import Directions
from gaigs.core.query import Query
from gaigs.core.scene import Scene, direct_waves
from gaigs.registry import register
from gaigs.splatting.pooling.channels import ChannelPooling
from gaigs.splatting.pooling.paths import PathPooling, ReceivedPaths, element_fields


@register("pooling", "path_csi")
class PathCsi(ChannelPooling, PathPooling):
    """Channels h(e, f) = g lambda / (4 pi) y(e, f), with a gain g and the paths' field y [1/m].

    Source: GAI-GS, eq. (2), for the sum; Friis for lambda / (4 pi); ``element_fields`` for y.
    """

    def __init__(self, scene: Scene):
        super().__init__(scene, "path_csi")

    def sum_paths(self, paths: ReceivedPaths) -> Complex[Tensor, "b e s"]:
        """Field at each element and subcarrier [1/m]."""
        offsets = self.frequencies.to(paths.carriers)[None] - paths.carriers[:, None]  # (b, s) [Hz]
        return element_fields(paths, offsets)

    def read(
        self, received: Complex[Tensor, "b e s"], query: Query, directions: Directions | None = None
    ) -> Complex[Tensor, "b most s"]:
        """Channels from the paths' fields ``received`` [1/m], padded to the largest array."""
        frequencies = self.frequencies.to(received.real)
        # g lambda / (4 pi): free space at 1 m has the amplitude lambda / (4 pi).
        gains = self.strength.to(frequencies) * speed_of_light / (4 * math.pi * frequencies)  # (s,)
        value = received * gains
        if self.sign == 0:  # no common clock: the phase of the direct path is taken off
            direct = direct_waves(self.scene, query, frequencies, 1, at_elements=False)  # (b, 1, s)
            value = value * direct.sgn().to(value)
        # Paths have the sign -1; the data may have the other one.
        return self.received(query, value.conj() if self.array_sign > 0 else value)
