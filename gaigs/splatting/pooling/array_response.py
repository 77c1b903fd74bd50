"""The spatial spectrum of an array from a map."""

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
    """The conventional beamformer on the fields of a map at the array's elements.

    The field at an element is the integral of the complex map over the solid angle, weighted by the
    element's pattern.

    Args:
        scene: Scene with the directions of the task and the receivers' arrays.
        grid: Rows and columns of the map over the full sphere, ``Grid.sphere``.

    Raises:
        ValueError: The labels are not spectra scaled to [0, 1], or an array has a single element.

    Source: Van Trees, Optimum Array Processing, 2002, section 2.2, for the fields; ``Beamformer``
    for the rest.
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
        real, imaginary = image.flatten(2).unbind(1)  # (b, p) each, p pixels
        waves = torch.complex(real, imaginary)
        array = self.beamformer.array(query)
        vectors = self.grid.flatten().vectors().to(image)  # (p, 3)
        weights = self.grid.solid_angles.flatten().to(image) * array.gain(vectors)  # (p,)
        positions = array.elements.to(image)  # (e, 3) [m]
        steps, _, _ = array.lags
        lags = waves.new_zeros(len(query), len(steps))  # (b, l)
        for carrier, links in self.beamformer.by_carrier(query):
            # A wave from the direction u leads at an element x by 2 pi x . u / lambda [rad].
            phases = 2 * math.pi * carrier / speed_of_light * (vectors @ positions.T)  # (p, e)
            steering = torch.polar(weights[:, None].expand_as(phases), phases)  # (p, e)
            fields = waves[links] @ steering  # (b, e)
            covariances = fields[:, :, None] * fields[:, None].conj()  # (b, e, e)
            lags = lags.index_add(0, links, array.by_lag(covariances))
        return self.beamformer(lags, query, directions)
