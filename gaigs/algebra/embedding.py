"""Points and planes of the projective algebra G(3,0,1), and events of space-time, as multivectors.

``PROJECTIVE.sandwich`` moves points and planes by any product of planes. A multivector and its
multiples are the same point or plane. A reflected point has a factor of -1, which ``extract_point``
removes.

Source: Brehmer et al., Geometric Algebra Transformer, 2023, table 1.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from gaigs.algebra import PROJECTIVE


def _embed(**components: Tensor) -> Tensor:
    """Multivectors with the given components, and 0 elsewhere."""
    zero = torch.zeros_like(next(iter(components.values())))
    return torch.stack([components.get(blade, zero) for blade in PROJECTIVE.blades], -1)


def embed_point(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 16"]:
    """Points [m] as trivectors e123 - x e023 + y e013 - z e012.

    A point is the intersection of its three coordinate planes.

    Example:
        >>> from gaigs.algebra.embedding import embed_point, extract_point
        >>> extract_point(embed_point(torch.tensor([1.0, 2.0, 1.5])))
        tensor([1.0000, 2.0000, 1.5000])
    """
    x, y, z = points.unbind(-1)
    return _embed(e123=torch.ones_like(x), e023=-x, e013=y, e012=-z)


def extract_point(multivectors: Float[Tensor, "*batch 16"]) -> Float[Tensor, "*batch 3"]:
    """Points [m] of trivectors; not finite for directions, whose e123 is zero."""
    indices = [PROJECTIVE.blades.index(blade) for blade in ("e023", "e013", "e012", "e123")]
    e023, e013, e012, e123 = (multivectors[..., index] for index in indices)
    return torch.stack((-e023, e013, -e012), -1) / e123[..., None]


def embed_plane(
    normals: Float[Tensor, "*batch 3"], offsets: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 16"]:
    """Oriented planes {x: normal · x = offset} as vectors.

    Args:
        normals: Normals of any length.
        offsets: Offsets [m] for normals of unit length; scaled like the normals otherwise.
    """
    x, y, z = normals.unbind(-1)
    return _embed(e1=x, e2=y, e3=z, e0=-offsets)


def embed_event(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 16"]:
    """Points [m] as events at time zero, vectors x e1 + y e2 + z e3 of space-time, G(3,1,0).

    Motions of space-time are rotations, boosts and mirrors about the origin, without translations.
    """
    # Components e1, e2 and e3 follow component 1, and 12 others follow them.
    return functional.pad(points, (1, 12))
