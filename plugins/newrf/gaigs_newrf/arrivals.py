"""Apparent origins of waves, found from the delays in the training channels.

A wave that the room's walls mirror arrives as if from an image of the one who sent it, and that
image stands still while the other end moves. So the delays of one path, measured at many places,
are the distances to a single point.
"""

import math

import torch
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light
from torch import Tensor

MOST_POINTS = 200_000
"""Of the coarse search's lattice."""

OVERSAMPLING = 8
"""Grid points of the delay per resolution of the band."""

REFINEMENTS = 5
"""Of a found point, each to half the pitch of the one before."""

PASSES = 4
"""Rounds in which each point is searched again, near its place, in the residual of all others."""


def find_origins(
    channels: Complex[Tensor, "k e s"],
    places: Float[Tensor, "k 3"],
    frequencies: Float[Tensor, " s"],
    first: Float[Tensor, "3"],
    region: Float[Tensor, "2 3"],
    count: int,
) -> Float[Tensor, "count 3"]:
    """Points at whose distances the channels have most power, one after another; float64.

    Each next one is searched in the residual of those before at every element. Paths whose delays
    the band does not keep apart draw each other away, so all are refined in turn, each in the
    residual of the others.

    Source: Fleury et al., Channel Parameter Estimation in Mobile Radio Environments Using the SAGE
    Algorithm, 1999.

    Args:
        channels: Of links with one end in common, whose phases fall with the distance.
        places: Of the other end [m].
        frequencies: Of the subcarriers [Hz].
        first: The end in common, which is the first of them: the direct path [m].
        region: Corners of the box in which the others are searched [m].
        count: How many.
    """
    rest = channels / channels.abs().square().sum((1, 2), keepdim=True).sqrt()
    lattice, pitch = _lattice(
        region, speed_of_light / (4 * (frequencies.max() - frequencies.min()).item())
    )
    far = torch.maximum(lattice.amax(0) - places, places - lattice.amin(0)).norm(dim=1).max().item()
    found, parts = [first], [_part(rest, (places - first).norm(dim=1), frequencies)]
    while len(found) < count:
        rest = rest - parts[-1]
        profile, step = _profile(rest, frequencies, far)
        found.append(
            _refined(rest, places, frequencies, _strongest(profile, step, places, lattice), pitch)
        )
        parts.append(_part(rest, (places - found[-1]).norm(dim=1), frequencies))
    rest = rest - parts[-1]
    for _ in range(PASSES):
        for i in range(1, count):
            rest = rest + parts[i]
            found[i] = _refined(rest, places, frequencies, found[i], pitch)
            parts[i] = _part(rest, (places - found[i]).norm(dim=1), frequencies)
            rest = rest - parts[i]
    return torch.stack(found)


_CUBE = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)] * 3)


def _lattice(region: Float[Tensor, "2 3"], pitch: float) -> tuple[Float[Tensor, "p 3"], float]:
    """Points throughout a box, and how far they are apart [m]: so far, or farther where they would
    be too many.
    """
    edges = region[1] - region[0]
    pitch = max(pitch, (edges.prod().item() / MOST_POINTS) ** (1 / 3))
    axes = [
        torch.arange(low, high + pitch, pitch, dtype=torch.float64)
        for low, high in region.T.tolist()
    ]
    return torch.cartesian_prod(*axes), pitch


def _waves(
    distances: Float[Tensor, "*batch"], frequencies: Float[Tensor, " s"]
) -> Complex[Tensor, "*batch s"]:
    """exp(-j 2 pi f d / c), of power 1 over the subcarriers."""
    phases = -2 * math.pi / speed_of_light * distances[..., None] * frequencies
    return torch.polar(torch.full_like(phases, len(frequencies) ** -0.5), phases)


def _part(
    channels: Complex[Tensor, "k e s"],
    distances: Float[Tensor, " k"],
    frequencies: Float[Tensor, " s"],
) -> Complex[Tensor, "k e s"]:
    """The part of each element's channel with that delay."""
    waves = _waves(distances, frequencies)
    return torch.einsum("kes,ks->ke", channels, waves.conj())[..., None] * waves[:, None]


def _refined(
    channels: Complex[Tensor, "k e s"],
    places: Float[Tensor, "k 3"],
    frequencies: Float[Tensor, " s"],
    point: Float[Tensor, "3"],
    pitch: float,
) -> Float[Tensor, "3"]:
    """Where near a point the channels have most power."""
    around = pitch / 2
    for _ in range(REFINEMENTS):
        near = point + around * _CUBE
        point, around = near[_powers(channels, places, frequencies, near).argmax()], around / 2
    return point


def _profile(
    channels: Complex[Tensor, "k e s"], frequencies: Float[Tensor, " s"], far: float
) -> tuple[Tensor, float]:
    """Power of each link by distance up to ``far`` (k, d), and the step of distances [m]."""
    step = speed_of_light / (OVERSAMPLING * (frequencies.max() - frequencies.min()).item())
    distances = step * torch.arange(math.ceil(far / step) + 1, dtype=torch.float64)
    return (channels @ _waves(distances, frequencies).mH).abs().square().sum(1), step


def _strongest(
    profile: Float[Tensor, "k d"],
    step: float,
    places: Float[Tensor, "k 3"],
    lattice: Float[Tensor, "p 3"],
) -> Float[Tensor, "3"]:
    """The lattice point at whose distances the links have most power."""
    powers = []
    for points in lattice.split(2**12):
        cells = (torch.cdist(points, places) / step).round().long()
        powers.append(profile.T.gather(0, cells).sum(1))
    return lattice[torch.cat(powers).argmax()]


def _powers(
    channels: Complex[Tensor, "k e s"],
    places: Float[Tensor, "k 3"],
    frequencies: Float[Tensor, " s"],
    points: Float[Tensor, "p 3"],
) -> Float[Tensor, " p"]:
    """Power that all links have at their distances to each point."""
    waves = _waves(torch.cdist(points, places), frequencies)
    return torch.einsum("kes,pks->pke", channels, waves.conj()).abs().square().sum((1, 2))
