"""The spatial spectrum as an array sees a map."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.geometry import Directions
from gaigs.core.query import Query
from gaigs.core.scene import Scene
from gaigs.registry import register
from gaigs.splatting.pooling import Pooling, sphere
from gaigs.splatting.pooling.beamformer import Beamformer


@register("pooling", "array_response")
class ArrayResponsePooling(Pooling):
    """Beamforming with the field at each element: the complex map over the solid angle, times the
    element's pattern.

    Args:
        grid: Rows and columns of the map over the full sphere, ``Grid.sphere``.
    """

    def __init__(self, scene: Scene, grid: Sequence[int] = (24, 48)):
        super().__init__()
        self.beamformer = Beamformer("pooling 'array_response'", scene)
        self.zone = self.beamformer.zone
        self.grid = sphere("pooling.grid", grid)

    def forward(
        self,
        image: Float[Tensor, "b 2 rows columns"],
        query: Query,
        directions: Directions | None = None,
    ) -> Float[Tensor, "b ..."]:
        waves = torch.complex(*image.flatten(2).unbind(1))
        array = self.beamformer.array(query)
        vectors = self.grid.flatten().vectors().to(image)
        weights = self.grid.solid_angles.flatten().to(image) * array.gain(vectors)
        lags = waves.new_zeros(len(query), len(array.lags[2]))
        for carrier, own in self.beamformer.by_carrier(query):
            phases = 2 * math.pi * carrier / speed_of_light * (vectors @ array.elements.to(image).T)
            fields = waves[own] @ torch.polar(weights[:, None].expand_as(phases), phases)
            lags = lags.index_add(0, own, array.by_lag(fields[:, :, None] * fields[:, None].conj()))
        return self.beamformer(lags, query, directions)
