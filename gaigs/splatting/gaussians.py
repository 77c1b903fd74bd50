"""Gaussians: parameters, initial lattice and .ply files; their values and tokens for a query."""

import itertools
import math
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float
from numpy.lib.recfunctions import unstructured_to_structured
from plyfile import PlyData, PlyElement
from torch import Tensor, nn

from gaigs.core.geometry import from_spherical, semi_axes, unit_quaternions
from gaigs.core.scene import Scene
from gaigs.io import FAR
from gaigs.io.files import atomic_write

SH_DC = 0.5 / math.sqrt(math.pi)
"""The constant spherical harmonic; .ply viewers multiply the first signal coefficient by it."""


class Gaussians(nn.Module):
    """n anisotropic Gaussians, each a virtual transmitter, as trainable parameters.

    Each receiver gets an equal number of Gaussians on a Fibonacci lattice over a zone of the
    sphere, at random distances. ``count`` sets the angular detail: over the upper hemisphere
    neighbours are sqrt(2 pi / count) rad apart.

    Args:
        scene: Its receivers are the centres of the lattices.
        zone: Lowest and highest elevation of the lattice, in the receivers' frames [rad].
        channels: Signal channels of a Gaussian.
        count: Initial number of Gaussians for all receivers together; at least one a receiver.
        near, far: Range of the initial distances to their receiver [m].
        spread: Initial standard deviation, as a fraction of the distance to the next Gaussian of
            the lattice.
        opacity: Initial opacity, in (0, 1).
        signal: Standard deviation of the initial random signal.
        degree: Degree of the spherical harmonics of the signal over the direction from a Gaussian
            to the transmitter.

    Attributes:
        learning_rates: Default learning rate of each parameter; the rate of ``means`` in [m].
        degree: Highest degree in use, at first ``degree``; a lower one smooths the signal.

    Raises:
        ValueError: An option is out of range.

    Source: parametrisation of Kerbl et al., 3D Gaussian Splatting, 2023. By reciprocity the
    transmitter takes the camera's place: a receiver sees each Gaussian from one direction only,
    where harmonics would add nothing.

    Example:
        >>> from gaigs.splatting.gaussians import Gaussians
        >>> scene = gaigs.links("synthetic", transmitters=20, order=0).scene
        >>> gaussians = Gaussians(scene, zone=(0.0, 1.5), channels=2, count=50)
        >>> gaussians.means.shape, gaussians.signal.shape
        (torch.Size([50, 3]), torch.Size([50, 2, 1]))
    """

    learning_rates: Mapping[str, float] = {
        "means": 5e-3,
        "quats": 1e-3,
        "log_scales": 5e-3,
        "opacity_logits": 1e-2,
        "signal": 3e-2,
    }
    PARAMETERS = tuple(learning_rates)

    def __init__(
        self,
        scene: Scene,
        zone: tuple[float, float],
        channels: int,
        count: int = 300,
        near: float = 3.0,
        far: float = 6.0,
        spread: float = 1.0,
        opacity: float = 0.1,
        signal: float = 1.0,
        degree: int = 0,
    ):
        super().__init__()
        if count < 1:
            raise ValueError(f"gaussians.count must be at least 1, got {count}")
        if not 0 < near <= far < FAR:
            raise ValueError(
                f"gaussians.near and far must satisfy 0 < near <= far < {FAR:g} m, "
                f"got {near} and {far}"
            )
        if not (0 < spread <= 1e6 and 0 < opacity < 1 and 0 <= signal <= 1e6 and degree >= 0):
            raise ValueError(
                "gaussians.spread must lie in (0, 1e6], opacity in (0, 1), signal in [0, 1e6], "
                f"and degree must be at least 0, got {spread=}, {opacity=}, {signal=}, {degree=}"
            )
        self.degree = degree
        receivers = len(scene.receivers)
        count = max(count, receivers)
        low, high = zone
        means = []
        scales = []
        for i, receiver in enumerate(scene.receivers):
            number = count // receivers + (i < count % receivers)  # equal to within one
            directions = fibonacci_lattice(number, low, high)  # (number, 3)
            distances = near + (far - near) * torch.rand(number)  # [m]
            means.append(receiver.pose.world(distances[:, None] * directions))
            # Angle between neighbours: the root of the zone's solid angle divided by their number.
            solid_angle = 2 * math.pi * (math.sin(high) - math.sin(low))
            pitch = math.sqrt(solid_angle / number)  # [rad]
            scales.append(distances * pitch * spread)
        self.means = nn.Parameter(torch.cat(means))  # (n, 3)
        self.quats = nn.Parameter(torch.randn(count, 4))
        self.log_scales = nn.Parameter(torch.cat(scales).log()[:, None].repeat(1, 3))  # (n, 3)
        self.opacity_logits = nn.Parameter(torch.full((count,), opacity).logit())
        constant = signal * torch.randn(count, channels, 1)
        # Harmonics above the constant start at zero: at first the signal is the same everywhere.
        bands = torch.zeros(count, channels, (degree + 1) ** 2 - 1)
        self.signal = nn.Parameter(torch.cat((constant, bands), -1))  # (n, c, k)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        """Standard deviations along the axes [m]."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, " n"]:
        """Opacities in (0, 1)."""
        return self.opacity_logits.sigmoid()

    @property
    def unit_quats(self) -> Float[Tensor, "n 4"]:
        """Quaternions (w, x, y, z) of length 1."""
        return unit_quaternions(self.quats)

    @property
    def covariances(self) -> Float[Tensor, "n 3 3"]:
        """Covariances in the world frame [m²]."""
        axes = semi_axes(self.quats, self.scales)
        return axes @ axes.mT

    @property
    def bands(self) -> Float[Tensor, "n c k"]:
        """The signal's k spherical-harmonic coefficients up to ``degree``, for c channels."""
        return self.signal[..., : (self.degree + 1) ** 2]

    def resize(self, count: int) -> None:
        """Changes the number of Gaussians; all parameters are then undefined."""
        for name in self.PARAMETERS:
            old = getattr(self, name)
            new = nn.Parameter(old.new_empty(count, *old.shape[1:]), old.requires_grad)
            setattr(self, name, new)

    def _load_from_state_dict(self, state_dict, prefix, *args):
        """Resizes to the checkpoint's number of Gaussians, which density control may change."""
        means = state_dict.get(f"{prefix}means")
        if means is not None and len(means) != len(self):
            self.resize(len(means))
        super()._load_from_state_dict(state_dict, prefix, *args)

    def save_ply(self, path: str | Path) -> None:
        """Writes the Gaussians as a .ply that 3-D Gaussian splatting viewers open.

        The file has positions [m], log scales, quaternions (w, x, y, z) and opacity logits. f_dc_*
        has the signal's first three channels, or 0 for a missing channel. f_rest_* has, channel by
        channel, the higher coefficients of these three and all coefficients of further channels.
        """
        comment = f"gaigs: {self.signal.shape[1]} signal channels"
        write_ply(path, dict(self.named_parameters()), comment)


def fibonacci_lattice(count: int, low: float, high: float) -> Float[Tensor, "count 3"]:
    """``count`` unit vectors, evenly over the sphere between elevations ``low`` and ``high`` [rad].

    Source: Swinbank and Purser, Fibonacci grids, 2006.
    """
    i = torch.arange(count, dtype=torch.float64) + 0.5
    # Equal steps in height are equal areas on the sphere. Azimuths in steps of the golden angle
    # keep neighbours apart.
    heights = math.sin(low) + (math.sin(high) - math.sin(low)) * i / count
    golden_angle = math.pi * (1 + math.sqrt(5))
    azimuths = torch.remainder(golden_angle * i, 2 * math.pi)
    return from_spherical(azimuths, torch.asin(heights)).float()


def write_ply(path: str | Path, values: Mapping[str, Tensor], comment: str) -> None:
    """Writes raw parameters in the format of ``Gaussians.save_ply``.

    Args:
        path: The file.
        values: Parameters by the names in ``Gaussians.PARAMETERS``.
        comment: A line of the file's header.
    """
    parameters = {name: value.detach().cpu().float() for name, value in values.items()}
    signal = parameters["signal"]  # (n, c, k)
    n, channels, _ = signal.shape
    signal = nn.functional.pad(signal, (0, 0, 0, max(0, 3 - channels)))  # at least 3 channels
    colours = signal[:, :3, 0]  # (n, 3)
    harmonics = signal[:, :3, 1:].flatten(1)
    others = signal[:, 3:].flatten(1)
    parameters["signal"] = torch.cat((colours, harmonics, others), 1)
    parameters["normals"] = torch.zeros(n, 3)  # viewers expect them, and ignore the values
    rest = parameters["signal"].shape[1] - 3
    properties = {  # in the order that viewers expect
        "means": ["x", "y", "z"],
        "normals": ["nx", "ny", "nz"],
        "signal": [f"f_dc_{i}" for i in range(3)] + [f"f_rest_{i}" for i in range(rest)],
        "opacity_logits": ["opacity"],
        "log_scales": [f"scale_{i}" for i in range(3)],
        "quats": [f"rot_{i}" for i in range(4)],
    }
    columns = torch.cat([parameters[name].reshape(n, -1) for name in properties], 1)
    names = [*itertools.chain.from_iterable(properties.values())]  # of the columns
    vertices = unstructured_to_structured(columns.numpy(), names=names)
    element = PlyElement.describe(vertices, "vertex")
    with atomic_write(path) as part:
        PlyData([element], comments=[comment]).write(str(part))


class Placed(NamedTuple):
    """The Gaussians of each query before a deformation.

    Attributes:
        means: Centres, world frame (1 or b, n, 3) [m]; 1 if they do not depend on the query.
        lengths: Length of each Gaussian's path from transmitter to receiver (b, n) [m]; None if
            unknown.
        quats, scales, opacities, signal: As in ``Gaussians``; scales (1 or b, n, 3) [m], signal (n,
            c, 1) or (b, n, c, 1). None: the values of ``Gaussians``.
        gains: Complex factor of the signal, phase included (b, n). None: 1.
        coherences: Share of each path's field with a known phase, in [0, 1] (n,). The rest adds as
            power. None: 1.
        bandwidth: Band over which powers are averaged, a scalar [Hz]; None: one carrier.
    """

    means: Float[Tensor, "b n 3"]
    lengths: Float[Tensor, "b n"] | None = None
    quats: Float[Tensor, "n 4"] | None = None
    scales: Float[Tensor, "b n 3"] | None = None
    opacities: Float[Tensor, " n"] | None = None
    signal: Float[Tensor, "*b n c 1"] | None = None
    gains: Complex[Tensor, "b n"] | None = None
    coherences: Float[Tensor, " n"] | None = None
    bandwidth: Float[Tensor, ""] | None = None


class Tokens(NamedTuple):
    """Embeddings that a tokenizer gives to a deformation. Absent ones have a last axis of length 0.

    Attributes:
        scene: CLS for each query.
        gaussians: Embedded positions E(P_x) for each Gaussian, or for each query and Gaussian.
        transmitters: Embedded positions E(P_TX) for each query.

    Source: GAI-GS, "Multi-view Tokenizer", eq. (10).
    """

    scene: Float[Tensor, "b d_scene"]
    gaussians: Float[Tensor, "*b n d_x"]
    transmitters: Float[Tensor, "b d_tx"]
