"""Materials of learnt planes: those of ITU-R P.2040 that reflect most alike."""

import math
from typing import NamedTuple

import torch
from scipy.constants import epsilon_0, speed_of_light

from gaigs.core.propagation import slab
from gaigs.core.query import Query
from gaigs.data.synthetic.image_source import TABULATED, conductivity
from gaigs.splatting.placement.mirrored.paths import Mirrored
from gaigs.splatting.placement.mirrored.reflections import polarised

HALF_SPACE = 1.0
"""Thickness [m] from which a slab reflects as a half-space: its losses hide the back."""


class Material(NamedTuple):
    """A material of ``TABULATED``, and the thickness of its slab [m]."""

    name: str
    thickness: float


@torch.no_grad()
def materials(placement: Mirrored, query: Query, frequency: float) -> dict[int, Material]:
    """Material and thickness of each plane that a query's paths meet, at a carrier [Hz].

    Reflections are compared at the bounces of these paths, weighted by the paths' powers.
    Permittivities alone would not do: a plane may reflect strongly by its permittivity or by its
    gain. A learnt reflection has the plane's gain and its share of the path's gain over that of the
    direct path. The thickness is the learnt one or, if a half-space reflects more alike,
    ``HALF_SPACE``. Where paths have phases of their own, magnitudes are compared.

    Source: ITU-R P.2040-3, table 3; outside 1 to 40 GHz its formulas are extrapolated.
    """
    sequences, normals = placement.sequences[placement.kept], placement.normals
    gains = placement.path_gains[placement.kept] - placement.path_gains[0]
    gains = (gains / (sequences >= 0).sum(1).clamp_min(1)).exp()
    compared = torch.abs if placement.path_phases is not None else torch.Tensor.clone
    half_space = torch.full((len(normals),), HALF_SPACE).to(normals)
    learnt = half_space if placement.log_thicknesses is None else placement.log_thicknesses.exp()
    permittivities = {
        name: complex(real, -conductivity(name, frequency) / (2 * math.pi * epsilon_0 * frequency))
        for name, (real, _, _) in TABULATED.items()
    }
    options = [
        (name, thicknesses) for name in permittivities for thicknesses in (half_space, learnt)
    ]
    errors, weights = normals.new_zeros(len(options), len(normals)), normals.new_zeros(len(normals))
    for part in query.parts(64):  # links at a time
        part = part.to(normals.device)
        powers = placement(None, part).gains.abs().square()
        _, _, folded = placement.folded(part)
        planes, path = folded.planes, folded.path[: len(folded.planes)]
        wanted = compared(placement.coefficients(part, folded) * gains[path])
        weights.index_add_(0, planes, powers[:, path].sum(0))
        for option, (name, thicknesses) in enumerate(options):
            te, tm = slab(
                permittivities[name],
                folded.cosines,
                thicknesses[planes] * (frequency / speed_of_light),
            )
            error = (compared(polarised(folded.normals, te, tm)) - wanted).abs().square()
            errors[option].index_add_(0, planes, (powers[:, path] * error).sum(0))
    chosen = errors.argmin(0).tolist()
    met = (weights > 0).nonzero()[:, 0].tolist()
    return {
        plane: Material(options[chosen[plane]][0], options[chosen[plane]][1][plane].item())
        for plane in met
    }
