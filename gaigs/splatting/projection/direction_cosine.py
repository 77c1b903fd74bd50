"""The plane of direction cosines."""

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.registry import register
from gaigs.splatting.projection import Projection


@register("projection", "direction_cosine")
class DirectionCosine(Projection):
    """(u, v) = (cos(el) cos(az), cos(el) sin(az)), the direction cosines l and m.

    The response of a planar array is shift-invariant in u and v. The map is smooth on the whole
    hemisphere, without seam and pole. As with a planar array, a direction below the array's plane
    coincides with its mirror image above. u and v depend on both angles, so a ``Plane`` has u and v
    for each pixel, not u for each column and v for each row.

    Source: Van Trees, Optimum Array Processing, 2002, chapter 4.
    """

    sees_below = False
    period = None

    def coordinates(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2"]:
        return (points / points.norm(dim=-1, keepdim=True))[..., :2]

    def jacobian(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 2 3"]:
        distances = points.norm(dim=-1)[..., None, None]  # (..., 1, 1) [m]
        unit = points[..., None, :] / distances  # (..., 1, 3)
        # A unit vector e at the distance r changes only by the part of a step that is across e:
        # its derivative is (I - e e') / r.
        identity = torch.eye(3, dtype=points.dtype, device=points.device)
        return (identity - unit.mT @ unit)[..., :2, :] / distances  # (..., 2, 3)
