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
        strengths: 1; of a diffracted path its whole gain, which does not change with the materials
            (p,).
        kinds: Interaction, 0, ``REFLECTED`` or ``PASSED`` (p, d).
        surfaces: Number of the surface's material (p, d).
        cosines: Of the angles of incidence (p, d).
        turns: From the components that a field has after one of them to those before the next (p, d
            + 1, 2, 2).
    """

    images: Float[Tensor, "*p 3"]
    strengths: Complex[Tensor, "*p"]
    kinds: Int[Tensor, "*p d"]
    surfaces: Int[Tensor, "*p d"]
    cosines: Float[Tensor, "*p d"]
    turns: Float[Tensor, "*p d1 2 2"]


def padded(links: Sequence[Traced], receiver: Float[Tensor, "3"]) -> Traced:
    """The paths of several links (b, p), float64; those that a link has fewer of have the strength
    0.

    Args:
        links: At least one.
        receiver: Position [m].
    """
    images, strengths, kinds, surfaces, cosines, turns = (
        pad_sequence(list(parts), batch_first=True) for parts in zip(*links, strict=True)
    )
    # Not at the receiver, from where no direction would lead to them.
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
        permittivities: Complex and relative, for the time dependence exp(+j omega t) (m,).
        thicknesses: [m] (m,).
        frequency: [Hz].
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
            cosines: Of the angles of incidence.

        Source: ITU-R P.2040-3, section 2.2.2.2, a slab in air.
        """
        permittivities = self.permittivities[surfaces]
        single = torch.stack(fresnel(permittivities, cosines))
        root = torch.sqrt(permittivities - (1 - cosines.square()))
        once = torch.exp(
            -2j * math.pi * self.frequency / speed_of_light * self.thicknesses[surfaces] * root
        )
        several = 1 - single.square() * once.square()  # between the slab's faces
        return single * (1 - once.square()) / several, (1 - single.square()) * once / several


def gains(paths: Traced, slabs: Slabs) -> Complex[Tensor, "b p"]:
    """Of the vertical field along each path, without the spreading of free space; that has 1."""
    field = paths.turns[..., 0, :, 1].to(torch.complex128)
    for step in range(paths.kinds.shape[-1]):
        kind = paths.kinds[..., step]
        cosines = torch.where(kind > 0, paths.cosines[..., step], 1).clamp(min=GRAZING)
        reflected, passed = slabs.coefficients(paths.surfaces[..., step], cosines)
        factors = torch.where(kind == PASSED, passed, torch.where(kind == REFLECTED, reflected, 1))
        changed = field * factors.movedim(0, -1)
        field = (paths.turns[..., step + 1, :, :] * changed[..., None, :]).sum(-1)
    return paths.strengths * field[..., 1]
