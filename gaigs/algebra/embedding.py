"""Points, planes and motions of space as multivectors, and back.

All but the last pair belong to the projective algebra G(3,0,1), in the component order of ``gaigs.algebra.Algebra``. A
plane is a vector, a point the trivector in which three planes meet; ``PROJECTIVE.sandwich`` moves both by a rotor, a
translator or a reflection. Multiples of a multivector are the same plane, point or motion; a mirrored point has a
factor of -1, which ``extract_point`` divides away.

Source: Brehmer et al., Geometric Algebra Transformer, 2023, table 1.
"""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from gaigs.algebra import PROJECTIVE

_INDEX = {blade: index for index, blade in enumerate(PROJECTIVE.blades)}


def _embed(**components: Tensor) -> Tensor:
    zero = torch.zeros_like(next(iter(components.values())))
    return torch.stack([components.get(blade, zero) for blade in PROJECTIVE.blades], -1)


def _extract(multivectors: Tensor, *blades: str) -> Tensor:
    return torch.stack([multivectors[..., _INDEX[blade]] for blade in blades], -1)


def embed_point(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 16"]:
    """Points [m] as trivectors e123 - x e023 + y e013 - z e012, where the planes of their coordinates meet."""
    x, y, z = points.unbind(-1)
    return _embed(e123=torch.ones_like(x), e023=-x, e013=y, e012=-z)


def extract_point(multivectors: Float[Tensor, "*batch 16"]) -> Float[Tensor, "*batch 3"]:
    """Points [m] of trivectors; not finite for directions, whose e123 is zero."""
    return extract_direction(multivectors) / _extract(multivectors, "e123")


def embed_direction(directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 16"]:
    """Directions of any length as points at infinity: trivectors without e123, unchanged by translations.

    A mirrored direction is negated, as the e123 of a mirrored point is.
    """
    x, y, z = directions.unbind(-1)
    return _embed(e023=-x, e013=y, e012=-z)


def extract_direction(multivectors: Float[Tensor, "*batch 16"]) -> Float[Tensor, "*batch 3"]:
    """Directions of points at infinity, with their length."""
    x, y, z = _extract(multivectors, "e023", "e013", "e012").unbind(-1)
    return torch.stack((-x, y, -z), -1)


def embed_plane(normals: Float[Tensor, "*batch 3"], offsets: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch 16"]:
    """Oriented planes {x: normal · x = offset} as vectors; the offset is in [m] where the normal is of unit length."""
    x, y, z = normals.unbind(-1)
    return _embed(e1=x, e2=y, e3=z, e0=-offsets)


def extract_plane(
    multivectors: Float[Tensor, "*batch 16"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
    """Normals and offsets of planes."""
    return _extract(multivectors, "e1", "e2", "e3"), -multivectors[..., _INDEX["e0"]]


def embed_reflection(
    normals: Float[Tensor, "*batch 3"], offsets: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch 16"]:
    """Mirrors at planes {x: normal · x = offset} as unit versors.

    Raises:
        ValueError: A normal is zero.
    """
    normals, offsets = _of_moderate_length(normals, offsets)
    length = normals.norm(dim=-1)
    if not (length > 0).all():
        raise ValueError("a mirror needs a normal, got one of length zero; check the planes")
    return embed_plane(normals / length[..., None], offsets / length)


def extract_reflection(
    multivectors: Float[Tensor, "*batch 16"],
) -> tuple[Float[Tensor, "*batch 3"], Float[Tensor, "*batch"]]:
    """Unit normals and offsets [m] of mirrors."""
    normals, offsets = _of_moderate_length(*extract_plane(multivectors))
    length = normals.norm(dim=-1)
    return normals / length[..., None], offsets / length


def _of_moderate_length(normals: Tensor, offsets: Tensor) -> tuple[Tensor, Tensor]:
    """Planes times a power of two, so that squares of their normals neither overflow nor vanish."""
    exponents = torch.frexp(normals.detach().abs().amax(-1)).exponent
    scale = torch.ldexp(torch.ones_like(offsets), -exponents.clamp(-126, 126))
    return normals * scale[..., None], offsets * scale


def embed_rotor(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 16"]:
    """Rotations about the origin, quaternions (w, x, y, z), as rotors w - x e23 + y e13 - z e12."""
    w, x, y, z = quats.unbind(-1)
    return _embed(**{"1": w}, e23=-x, e13=y, e12=-z)


def extract_rotor(multivectors: Float[Tensor, "*batch 16"]) -> Float[Tensor, "*batch 4"]:
    """Quaternions (w, x, y, z) of rotors."""
    w, x, y, z = _extract(multivectors, "1", "e23", "e13", "e12").unbind(-1)
    return torch.stack((w, -x, y, -z), -1)


def embed_translator(translations: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 16"]:
    """Translations [m] as versors 1 - (x e01 + y e02 + z e03) / 2."""
    x, y, z = (-translations / 2).unbind(-1)
    return _embed(**{"1": torch.ones_like(x)}, e01=x, e02=y, e03=z)


def extract_translator(multivectors: Float[Tensor, "*batch 16"]) -> Float[Tensor, "*batch 3"]:
    """Translations [m] of translators."""
    return -2 * _extract(multivectors, "e01", "e02", "e03") / _extract(multivectors, "1")


def embed_event(points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 16"]:
    """Points [m] as events at time zero, vectors x e1 + y e2 + z e3 of the space-time algebra G(3,1,0).

    Its motions are rotations, boosts and mirrors about the origin, without translations.
    """
    return functional.pad(points, (1, 12))


def extract_event(multivectors: Float[Tensor, "*batch 16"]) -> Float[Tensor, "*batch 3"]:
    """Points [m] of events of the space-time algebra at any time."""
    return multivectors[..., 1:4]
