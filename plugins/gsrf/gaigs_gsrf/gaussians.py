"""Complex-valued Gaussians: their start, and their radiance by direction."""

import math
from collections.abc import Mapping

import torch
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light
from torch import Tensor, nn

from gaigs.core.geometry import spherical_harmonics, to_spherical
from gaigs.core.scene import Scene
from gaigs.splatting.gaussians import Gaussians
from gaigs.splatting.projection import NEAR


class ComplexGaussians(Gaussians):
    """Gaussians with complex coefficients of a Fourier-Legendre series, and a phase.

    They start on a cubic grid over the box that holds transmitters and receivers, and a margin
    around it. Points in whose directions no receiver listens are left out. Their standard deviation
    at the start is the mean distance between them on the sphere of footprints.

    Args:
        scene: Its receivers and transmitters say where to put the Gaussians, its carrier how
            densely.
        zone: Lowest and highest elevation from which anything is received, in the receivers' frames
            [rad].
        channels: Number of real channels: all real parts of complex ones, then all imaginary parts.
        degree: L of the series.
        radius: Radius of the sphere of footprints [m].
        count: Largest number of points of the grid, whose pitch grows to keep it.
        pitch: Pitch of the grid [wavelengths]; where the carrier is unknown, ``count`` decides.
        margin: Margin around the box, as a share of its longest edge.
        opacity: Opacity at the start, in (0, 1).
        signal: Standard deviation of the coefficients' random start.

    Attributes:
        signal: Coefficients c_lm at number l² + l + m, (n, channels, (L + 1)²).
        phases: Phase that a wave through a Gaussian's middle gains (n,) [rad].

    Raises:
        ValueError: An option is out of range, or no receiver sees a point of the grid.

    Source: GSRF (NeurIPS 2025), "Fourier-Legendre radiance field".
    """

    learning_rates: Mapping[str, float] = {
        **Gaussians.learning_rates,
        "signal": 1e-2,
        "phases": 1e-2,
    }
    PARAMETERS = tuple(learning_rates)

    def __init__(
        self,
        scene: Scene,
        zone: tuple[float, float],
        channels: int,
        degree: int,
        radius: float,
        count: int,
        pitch: float,
        margin: float,
        opacity: float,
        signal: float,
    ):
        for option, value in (("pitch", pitch), ("margin", margin)):
            if not 0 < value < math.inf:
                raise ValueError(f"model.{option} must be positive, got {value}")
        if degree < 0:
            raise ValueError(f"model.degree must be at least 0, got {degree}")
        if count < 1:
            raise ValueError(f"model.count must be at least 1, got {count}")
        if not zone[0] < zone[1]:
            raise ValueError(
                f"model 'gsrf' needs labels of two elevations or more, got them from {zone[0]:.6g} "
                f"to {zone[1]:.6g} rad; take another model"
            )
        means = heard(cubic_grid(scene, count, pitch, margin), scene, zone)
        if len(means) < len(scene.receivers):
            raise ValueError(
                f"the grid of Gaussians must have a point for each of the {len(scene.receivers)} "
                f"receivers, got {len(means)} that are heard; raise model.count, or lower "
                "model.pitch or model.margin"
            )
        options = {
            "near": 1.0,
            "far": 1.0,
            "spread": 1.0,
            "opacity": opacity,
            "signal": signal,
            "degree": degree,
        }
        super().__init__(scene, zone, channels, len(means), **options)
        solid_angle = 2 * math.pi * (math.sin(zone[1]) - math.sin(zone[0]))
        with torch.no_grad():
            self.means.copy_(means)
            self.log_scales.fill_(math.log(radius * math.sqrt(solid_angle / len(means))))
            self.signal.normal_(std=signal)
        self.phases = nn.Parameter(torch.zeros(len(means)))

    def radiance(self, transmitters: Float[Tensor, "b 3"]) -> Complex[Tensor, "b n s"]:
        """Radiance of each Gaussian towards the transmitters, on s complex channels.

        psi_i = sum_{l <= L, |m| <= l} c_ilm Y_lm at the direction from the Gaussian to the
        transmitter.
        """
        offsets = transmitters[:, None] - self.means  # (b, n, 3)
        lengths = offsets.norm(dim=-1, keepdim=True)
        # A transmitter within a Gaussian's centre has no direction; upwards is used.
        upwards = offsets.new_tensor([0.0, 0.0, 1.0])
        directions = torch.where(lengths < NEAR, upwards, offsets / lengths.clamp(min=NEAR))
        coefficients = torch.complex(*self.signal.unflatten(1, (2, -1)).unbind(1))
        return torch.einsum("bnk,nsk->bns", fourier_legendre(directions, self.degree), coefficients)


def fourier_legendre(
    vectors: Float[Tensor, "*batch 3"], degree: int
) -> Complex[Tensor, "*batch k"]:
    """Y_lm = N_lm P_l^|m|(cos theta) exp(j m az), times (-1)^|m| for m < 0, in the order of l and
    m.

    N_lm = sqrt((2l + 1) / 4 pi (l - |m|)! / (l + |m|)!). They come from the real harmonics, whose
    recurrence has no factorials and no pole: these are sqrt(2) N P cos(m az) for m > 0 and
    sqrt(2) N P sin(|m| az) for m < 0.

    Args:
        vectors: Unit vectors.
        degree: The highest l.

    Source: GSRF (NeurIPS 2025).
    """
    harmonics = spherical_harmonics(vectors, degree)
    # Number of the harmonic with m = 0 of the same l, for each harmonic (k,).
    middles = []
    for n in range(degree + 1):
        middles += [n**2 + n] * (2 * n + 1)
    middle = torch.tensor(middles, device=vectors.device)
    orders = torch.arange(len(middle), device=vectors.device) - middle  # m
    real = harmonics[..., middle + orders.abs()]
    imaginary = harmonics[..., middle - orders.abs()]
    # 1 for m = 0, else sqrt(1/2), with the sign of (-1)^|m| for m < 0.
    size = vectors.new_tensor([1.0, math.sqrt(0.5), -math.sqrt(0.5)])
    size = size[torch.where((orders < 0) & (orders % 2 == 1), 2, orders.sign().abs())]
    return torch.complex(size * real, size * orders.sign() * imaginary)


def cubic_grid(scene: Scene, count: int, pitch: float, margin: float) -> Float[Tensor, "n 3"]:
    """Points of a cubic grid over the box of training transmitters and receivers, and a margin
    around it.

    Args:
        scene: Box, receivers and carrier.
        count: Largest number of points; the pitch grows to keep it.
        pitch: Least distance of points [wavelengths]; 0 where the carrier is unknown.
        margin: Margin as a share of the box's longest edge.
    """
    lower, upper = (corner.double() for corner in scene.box)
    edges = (upper - lower) + 2 * margin * (upper - lower).max()
    task = scene.task
    frequencies = task.frequencies if task.dtype.is_complex else scene.frequencies
    step = (edges.prod() / count) ** (1 / 3)
    if len(frequencies):
        step = torch.maximum(step, pitch * speed_of_light / frequencies.double().mean())
    steps = (edges / step).floor()
    while (steps + 1).prod() > count:
        step = 1.02 * step
        steps = (edges / step).floor()
    axes = []
    for middle, size in zip((lower + upper) / 2, steps.tolist(), strict=True):
        axes.append(middle + step * (torch.arange(size + 1) - size / 2))
    return torch.cartesian_prod(*axes).float()


def heard(
    points: Float[Tensor, "n 3"], scene: Scene, zone: tuple[float, float]
) -> Float[Tensor, "k 3"]:
    """The points that a receiver sees between two elevations of its frame [rad]."""
    seen = torch.zeros(len(points), dtype=torch.bool)
    for receiver in scene.receivers:
        _, elevations, _ = to_spherical(receiver.pose.local(points))
        seen |= (elevations >= zone[0]) & (elevations <= zone[1])
    return points[seen]
