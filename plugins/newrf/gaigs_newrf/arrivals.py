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
"""Largest number of points of the coarse search's lattice."""

OVERSAMPLING = 8
"""Grid points of the delay per resolution of the band."""

REFINEMENTS = 5
"""Refinements of a point, each to half the pitch of the one before."""

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
    """Points at whose distances the channels have most power, found one after another; float64.

    Each point is searched in what the points before leave of the channels. Paths whose delays the
    band does not resolve draw each other away, so that all points are refined in turn, each in what
    the others leave.

    Source: Fleury et al., Channel Parameter Estimation in Mobile Radio Environments Using the SAGE
    Algorithm, 1999.

    Args:
        channels: Channels of links with one end in common; their phases fall with the distance.
        places: Places of the other end [m].
        frequencies: Subcarriers [Hz].
        first: The end in common, which is the first point: it has the direct path [m].
        region: Corners of the box in which the other points are searched [m].
        count: Number of points.
    """
    residual = channels / channels.abs().square().sum((1, 2), keepdim=True).sqrt()
    # A quarter of the band's resolution.
    pitch = speed_of_light / (4 * (frequencies.max() - frequencies.min()).item())
    lattice, pitch = _lattice(region, pitch)
    far = torch.maximum(lattice.amax(0) - places, places - lattice.amin(0)).norm(dim=1).max().item()
    origins = [first]
    parts = [_part(residual, (places - first).norm(dim=1), frequencies)]
    while len(origins) < count:
        residual = residual - parts[-1]
        profile, step = _profile(residual, frequencies, far)
        start = _strongest(profile, step, places, lattice)
        origins.append(_refined(residual, places, frequencies, start, pitch))
        parts.append(_part(residual, (places - origins[-1]).norm(dim=1), frequencies))
    residual = residual - parts[-1]
    for _ in range(PASSES):
        for i in range(1, count):
            residual = residual + parts[i]
            origins[i] = _refined(residual, places, frequencies, origins[i], pitch)
            parts[i] = _part(residual, (places - origins[i]).norm(dim=1), frequencies)
            residual = residual - parts[i]
    return torch.stack(origins)


_CUBE = torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0], dtype=torch.float64)] * 3)


def _lattice(region: Float[Tensor, "2 3"], pitch: float) -> tuple[Float[Tensor, "p 3"], float]:
    """Points throughout a box, and their pitch [m], which grows to keep ``MOST_POINTS``."""
    edges = region[1] - region[0]
    pitch = max(pitch, (edges.prod().item() / MOST_POINTS) ** (1 / 3))
    axes = []
    for low, high in region.T.tolist():
        axes.append(torch.arange(low, high + pitch, pitch, dtype=torch.float64))
    return torch.cartesian_prod(*axes), pitch


def _waves(
    distances: Float[Tensor, "*batch"], frequencies: Float[Tensor, " s"]
) -> Complex[Tensor, "*batch s"]:
    """Waves exp(-j 2 pi f d / c) of distances d [m], with a power of 1 over the subcarriers."""
    phases = -2 * math.pi / speed_of_light * distances[..., None] * frequencies
    return torch.polar(torch.full_like(phases, len(frequencies) ** -0.5), phases)


def _part(
    channels: Complex[Tensor, "k e s"],
    distances: Float[Tensor, " k"],
    frequencies: Float[Tensor, " s"],
) -> Complex[Tensor, "k e s"]:
    """The part of each element's channel that has the delay of a distance [m]."""
    waves = _waves(distances, frequencies)  # (k, s)
    amplitudes = torch.einsum("kes,ks->ke", channels, waves.conj())
    return amplitudes[..., None] * waves[:, None]


def _refined(
    channels: Complex[Tensor, "k e s"],
    places: Float[Tensor, "k 3"],
    frequencies: Float[Tensor, " s"],
    point: Float[Tensor, "3"],
    pitch: float,
) -> Float[Tensor, "3"]:
    """The place within about a ``pitch`` [m] of a point at which the channels have most power."""
    step = pitch / 2
    for _ in range(REFINEMENTS):
        near = point + step * _CUBE  # (27, 3)
        point = near[_powers(channels, places, frequencies, near).argmax()]
        step = step / 2
    return point


def _profile(
    channels: Complex[Tensor, "k e s"], frequencies: Float[Tensor, " s"], far: float
) -> tuple[Tensor, float]:
    """Power of each link by distance up to ``far`` (k, d), and the step of distances [m]."""
    step = speed_of_light / (OVERSAMPLING * (frequencies.max() - frequencies.min()).item())
    distances = step * torch.arange(math.ceil(far / step) + 1, dtype=torch.float64)
    amplitudes = channels @ _waves(distances, frequencies).mH  # (k, e, d)
    return amplitudes.abs().square().sum(1), step


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
    """Power of all links together at their distances from each point."""
    waves = _waves(torch.cdist(points, places), frequencies)  # (p, k, s)
    amplitudes = torch.einsum("kes,pks->pke", channels, waves.conj())
    return amplitudes.abs().square().sum((1, 2))
