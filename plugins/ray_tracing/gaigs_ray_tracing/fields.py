"""Fields along traced paths, as a function of the materials of the surfaces."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float, Int
from scipy.constants import speed_of_light
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from gaigs.core.propagation import fresnel

REFLECTED, PASSED = 1, 2
"""Kinds of interactions of a path; 0 is none."""

GRAZING = 1e-6
"""Smallest cosine of an angle of incidence: along a surface of air the coefficients would be 0 / 0.
"""


class Traced(NamedTuple):
    """Paths from transmitters to a receiver point: p of one link, or (b, p) of several.

    Up to d things happen to a path, from its transmitter on. A field has two components across the
    direction: at the transmitter and at the receiver along the horizontal and down the meridian; at
    each surface across (TE) and in (TM) the plane of incidence.

    Attributes:
        images: Where the transmitter seems to stand (p, 3) [m].
        strengths: 1; for a diffracted path its whole gain, which does not change with the materials
            (p,).
        kinds: Interaction, 0, ``REFLECTED`` or ``PASSED`` (p, d).
        surfaces: Number of the surface's material (p, d).
        cosines: Cosines of the angles of incidence (p, d).
        turns: Matrices from a field's components after one interaction to its components before the
            next (p, d + 1, 2, 2).
    """

    images: Float[Tensor, "*p 3"]
    strengths: Complex[Tensor, "*p"]
    kinds: Int[Tensor, "*p d"]
    surfaces: Int[Tensor, "*p d"]
    cosines: Float[Tensor, "*p d"]
    turns: Float[Tensor, "*p d1 2 2"]


def padded(links: Sequence[Traced], receiver: Float[Tensor, "3"]) -> Traced:
    """The paths of several links (b, p), float64; missing paths have the strength 0.

    Args:
        links: Paths of each link, of one link or more.
        receiver: Position of the receiver [m].
    """
    fields = [pad_sequence(list(parts), batch_first=True) for parts in zip(*links, strict=True)]
    images, strengths, kinds, surfaces, cosines, turns = fields
    # Missing images stand away from the receiver, so that they have a direction.
    images = torch.where((strengths != 0)[..., None], images.double(), receiver.double() + 1)
    return Traced(
        images,
        strengths.to(torch.complex128),
        kinds,
        surfaces.long(),
        cosines.double(),
        turns.double(),
    )


class Slabs(NamedTuple):
    """The surfaces' materials at one frequency.

    Attributes:
        permittivities: Complex relative permittivities, for the time dependence exp(+j omega t)
            (m,).
        thicknesses: Thickness of each slab [m] (m,).
        frequency: Carrier [Hz].
    """

    permittivities: Complex[Tensor, " m"]
    thicknesses: Float[Tensor, " m"]
    frequency: float

    def coefficients(
        self, surfaces: Int[Tensor, "*p"], cosines: Float[Tensor, "*p"]
    ) -> tuple[Complex[Tensor, " 2 *p"], Complex[Tensor, " 2 *p"]]:
        """Coefficients of reflection and of passage, each TE and TM.

        Args:
            surfaces: Numbers of materials.
            cosines: Cosines of the angles of incidence.

        Source: ITU-R P.2040-3, section 2.2.2.2, a slab in air.
        """
        permittivities = self.permittivities[surfaces]
        single = torch.stack(fresnel(permittivities, cosines))  # r of one face (2, *p)
        root = torch.sqrt(permittivities - (1 - cosines.square()))
        wavenumber = -2j * math.pi * self.frequency / speed_of_light
        once = torch.exp(wavenumber * self.thicknesses[surfaces] * root)  # q, one way through
        # All reflections between the faces: R = r (1 - q²) / (1 - r² q²), T = (1 - r²) q / (...).
        several = 1 - single.square() * once.square()
        reflected = single * (1 - once.square()) / several
        passed = (1 - single.square()) * once / several
        return reflected, passed


def gains(paths: Traced, slabs: Slabs) -> Complex[Tensor, "b p"]:
    """Gain of the vertical field along each path over free space of the same length."""
    field = paths.turns[..., 0, :, 1].to(torch.complex128)
    for step in range(paths.kinds.shape[-1]):
        kind = paths.kinds[..., step]
        cosines = torch.where(kind > 0, paths.cosines[..., step], 1).clamp(min=GRAZING)
        reflected, passed = slabs.coefficients(paths.surfaces[..., step], cosines)
        factors = torch.where(kind == PASSED, passed, torch.where(kind == REFLECTED, reflected, 1))
        changed = field * factors.movedim(0, -1)
        field = (paths.turns[..., step + 1, :, :] * changed[..., None, :]).sum(-1)
    return paths.strengths * field[..., 1]
