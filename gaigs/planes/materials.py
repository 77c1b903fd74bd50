"""Materials of ITU-R P.2040 whose reflections match learnt planes."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Float
from scipy.constants import epsilon_0, speed_of_light
from torch import Tensor

from gaigs.core.propagation import slab
from gaigs.core.query import Query
from gaigs.data.synthetic.image_source import TABULATED, conductivity
from gaigs.splatting.placement.mirrored.paths import Mirrored
from gaigs.splatting.placement.mirrored.reflections import polarised


class Material(NamedTuple):
    """A material of ``TABULATED``, and the thickness of its slab [m]."""

    name: str
    thickness: float


class SlabOption(NamedTuple):
    """A candidate material, with a thickness for each plane."""

    name: str
    permittivity: complex  # relative
    thicknesses: Float[Tensor, " w"]  # [m]


@torch.no_grad()
def materials(placement: Mirrored, query: Query, frequency: float) -> dict[int, Material]:
    """Material and thickness of each plane that a query's paths meet, at a carrier [Hz].

    Reflection coefficients of each material are compared with the learnt ones at the reflection
    points of these paths. The material with the smallest squared difference, weighted by the paths'
    powers, is chosen. A learnt coefficient includes the plane's gain, and a part of the path's gain
    over the direct path: the same part at each of its reflections. If phases of paths are learnt,
    only magnitudes are compared. The thickness is the learnt one, or 1 m if a half-space fits
    better.

    Source: ITU-R P.2040-3, table 3; outside 1 to 40 GHz its formulas are extrapolated.
    """
    sequences = placement.sequences[placement.kept]
    normals = placement.normals
    path_gains = placement.of_bands(placement.path_gains, query).mean(0)
    log_gains = path_gains[placement.kept] - path_gains[0]  # over the direct path
    reflections = (sequences >= 0).sum(1).clamp_min(1)
    gains = (log_gains / reflections).exp()  # of each reflection
    compared = torch.abs if placement.path_phases is not None else torch.Tensor.clone
    options = _list_slabs(placement, frequency)
    errors = normals.new_zeros(len(options), len(normals))
    weights = normals.new_zeros(len(normals))
    for links in query.parts(64):  # links at a time
        links = links.to(normals.device)
        powers = placement(None, links).gains.abs().square()
        _, _, folded = placement.folded(links)
        planes = folded.planes  # plane and path of each reflection
        path = folded.path[: len(planes)]
        learnt = compared(placement.coefficients(links, folded) * gains[path])
        weights.index_add_(0, planes, powers[:, path].sum(0))
        for number, option in enumerate(options):
            depths = option.thicknesses[planes] * (frequency / speed_of_light)  # [wavelengths]
            te, tm = slab(option.permittivity, folded.cosines, depths)
            error = (compared(polarised(folded.normals, te, tm)) - learnt).abs().square()
            errors[number].index_add_(0, planes, (powers[:, path] * error).sum(0))
    best = errors.argmin(0).tolist()  # number of the option for each plane
    chosen = {}
    for plane in (weights > 0).nonzero()[:, 0].tolist():
        option = options[best[plane]]
        chosen[plane] = Material(option.name, option.thicknesses[plane].item())
    return chosen


def _list_slabs(placement: Mirrored, frequency: float) -> list[SlabOption]:
    """Each material as a half-space and with the learnt thicknesses."""
    half_space = torch.full((len(placement.normals),), 1.0).to(placement.normals)
    learnt = half_space
    if placement.log_thicknesses is not None:
        learnt = placement.log_thicknesses.exp()
    options = []
    for name, (real, _, _) in TABULATED.items():
        # epsilon = epsilon' - j sigma / (2 pi f epsilon_0)
        loss = conductivity(name, frequency) / (2 * math.pi * epsilon_0 * frequency)
        permittivity = complex(real, -loss)
        options += [
            SlabOption(name, permittivity, half_space),
            SlabOption(name, permittivity, learnt),
        ]
    return options
