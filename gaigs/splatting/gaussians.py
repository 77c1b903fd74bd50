"""Gaussians: parameters, initial lattice, .ply files; Gaussians of a query, and their tokens."""

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
    """n anisotropic Gaussians, each a virtual transmitter; parameters are raw, properties are
    activated.

    Each receiver gets an equal number of Gaussians on a Fibonacci lattice over a zone of the
    sphere, at random distances. ``count`` sets the angular detail: over the upper hemisphere
    neighbours are sqrt(2 pi / count) rad apart.

    Args:
        scene: Its receivers are the centres of the lattices.
        zone: Lowest and highest elevation of the lattice, in the receivers' frames [rad].
        channels: Signal channels of a Gaussian.
        count: Initial number of Gaussians for all receivers together; it grows to one a receiver.
        near, far: Range of the initial distances to their receiver [m].
        spread: Initial standard deviation, as a fraction of the distance to the next Gaussian of
            the lattice.
        opacity: Initial opacity, in (0, 1).
        signal: Standard deviation of the initial random signal.
        degree: Degree of the spherical harmonics of the signal over the direction from a Gaussian
            to the transmitter.

    Attributes:
        learning_rates: Default learning rate of each parameter, that of ``means`` in [m].
        degree: Highest degree in use, at first ``degree``; a lower one smooths the signal.

    Source: parametrisation of Kerbl et al., 3D Gaussian Splatting, 2023. By reciprocity the
    transmitter takes the camera's place: a receiver sees each Gaussian from one direction only,
    where harmonics would add nothing.
    """

    learning_rates: Mapping[str, float] = {
        "means": 5e-3, "quats": 1e-3, "log_scales": 5e-3, "opacity_logits": 1e-2, "signal": 3e-2
    }  # fmt: skip
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
        receivers = len(scene.receivers)
        if count < 1:
            raise ValueError(f"gaussians.count must be at least 1, got {count}")
        count = max(count, receivers)
        if not 0 < near <= far < FAR:
            raise ValueError(
                f"gaussians.near and far must satisfy 0 < near <= far < {FAR:g} m, got {near} and {far}"
            )
        if not (0 < spread <= 1e6 and 0 < opacity < 1 and 0 <= signal <= 1e6 and degree >= 0):
            raise ValueError(
                "gaussians.spread must lie in (0, 1e6], opacity in (0, 1), signal in [0, 1e6], and degree must be at "
                f"least 0, got {spread=}, {opacity=}, {signal=}, {degree=}"
            )
        self.degree = degree
        shares = [count // receivers + (i < count % receivers) for i in range(receivers)]
        means, scales = [], []
        low, high = zone
        for receiver, share in zip(scene.receivers, shares, strict=True):
            directions = fibonacci_lattice(share, low, high)
            distances = near + (far - near) * torch.rand(share)
            pitch = math.sqrt(2 * math.pi * (math.sin(high) - math.sin(low)) / share)
            means.append(receiver.pose.world(distances[:, None] * directions))
            scales.append(distances * pitch * spread)
        self.means = nn.Parameter(torch.cat(means))
        self.quats = nn.Parameter(torch.randn(count, 4))
        self.log_scales = nn.Parameter(torch.cat(scales).log()[:, None].repeat(1, 3))
        self.opacity_logits = nn.Parameter(torch.full((count,), opacity).logit())
        bands = torch.zeros(count, channels, (degree + 1) ** 2 - 1)
        self.signal = nn.Parameter(torch.cat((signal * torch.randn(count, channels, 1), bands), -1))

    def __len__(self) -> int:
        return len(self.means)

    @property
    def scales(self) -> Float[Tensor, "n 3"]:
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, " n"]:
        return self.opacity_logits.sigmoid()

    @property
    def unit_quats(self) -> Float[Tensor, "n 4"]:
        return unit_quaternions(self.quats)

    @property
    def covariances(self) -> Float[Tensor, "n 3 3"]:
        axes = semi_axes(self.quats, self.scales)
        return axes @ axes.mT

    @property
    def bands(self) -> Float[Tensor, "n c k"]:
        return self.signal[..., : (self.degree + 1) ** 2]

    def resize(self, count: int) -> None:
        """Changes the number of Gaussians; values are undefined."""
        for name in self.PARAMETERS:
            old = getattr(self, name)
            setattr(
                self, name, nn.Parameter(old.new_empty(count, *old.shape[1:]), old.requires_grad)
            )

    def _load_from_state_dict(self, state_dict, prefix, *args):
        """Takes the checkpoint's number of Gaussians, which density control has changed since the
        start.
        """
        if (means := state_dict.get(f"{prefix}means")) is not None and len(means) != len(self):
            self.resize(len(means))
        super()._load_from_state_dict(state_dict, prefix, *args)

    def save_ply(self, path: str | Path) -> None:
        """Writes the Gaussians as a .ply that 3-D Gaussian splatting viewers open.

        Positions [m], log scales, quaternions (w, x, y, z), opacity logits; the signal's first
        three channels are in f_dc_*, missing ones as 0. f_rest_* hold, channel by channel, the
        higher coefficients of these three and all coefficients of further channels.
        """
        write_ply(
            path, dict(self.named_parameters()), f"gaigs: {self.signal.shape[1]} signal channels"
        )


def fibonacci_lattice(count: int, low: float, high: float) -> Float[Tensor, "count 3"]:
    """Unit vectors evenly over a zone between two elevations [rad]; Swinbank and Purser, Fibonacci
    grids, 2006.
    """
    i = torch.arange(count, dtype=torch.float64) + 0.5
    heights = math.sin(low) + (math.sin(high) - math.sin(low)) * i / count
    golden = math.pi * (1 + math.sqrt(5))
    return from_spherical(torch.remainder(golden * i, 2 * math.pi), torch.asin(heights)).float()


def write_ply(path: str | Path, values: Mapping[str, Tensor], comment: str) -> None:
    """Writes raw parameters, by the names in ``Gaussians.PARAMETERS``, in the format of
    ``Gaussians.save_ply``.
    """
    n, channels, _ = values["signal"].shape
    parameters = {name: value.detach().cpu().float() for name, value in values.items()} | {
        "normals": torch.zeros(n, 3)
    }
    shown = nn.functional.pad(parameters["signal"], (0, 0, 0, max(0, 3 - channels)))
    parameters["signal"] = torch.cat(
        (shown[:, :3, 0], shown[:, :3, 1:].flatten(1), shown[:, 3:].flatten(1)), 1
    )
    rest = parameters["signal"].shape[1] - 3
    properties = {  # in the order that viewers expect
        "means": ["x", "y", "z"],
        "normals": ["nx", "ny", "nz"],
        "signal": [f"f_dc_{i}" for i in range(3)] + [f"f_rest_{i}" for i in range(rest)],
        "opacity_logits": ["opacity"],
        "log_scales": [f"scale_{i}" for i in range(3)],
        "quats": [f"rot_{i}" for i in range(4)],
    }
    rows = torch.cat([parameters[name].reshape(n, -1) for name in properties], 1).numpy()
    vertices = unstructured_to_structured(
        rows, names=[name for names in properties.values() for name in names]
    )
    with atomic_write(path) as part:
        PlyData([PlyElement.describe(vertices, "vertex")], comments=[comment]).write(str(part))


class Placed(NamedTuple):
    """The Gaussians of each query, before a deformation. Fields that do not depend on the query
    have b = 1.

    Attributes:
        means: Centres, world frame (1 or b, n, 3) [m].
        lengths: Length of each Gaussian's path from transmitter to receiver (b, n) [m]; None:
            unknown.
        quats, scales, opacities, signal: As of ``Gaussians``; scales (1 or b, n, 3) [m], signal (n,
            c, 1) or (b, n, c, 1). None: those of the free Gaussians.
        gains: Complex factor of the signal, phase included (b, n). None: 1.
        coherences: Share of each path's field, in [0, 1] (n,), with a known phase; the rest adds as
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
    """Input of a deformation; any width may be 0.

    Attributes:
        scene: CLS for each query.
        gaussians: E(P_x) for each Gaussian, or for each query and Gaussian.
        transmitters: E(P_TX) for each query.

    Source: GAI-GS, "Multi-view Tokenizer".
    """

    scene: Float[Tensor, "b d_scene"]
    gaussians: Float[Tensor, "*b n d_x"]
    transmitters: Float[Tensor, "b d_tx"]
