"""The scene's Gaussians: parameters, activations, placement, and .ply files."""

import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from plyfile import PlyData, PlyElement, PlyParseError
from torch import Tensor, nn

from gaigs.geometry import FAR, from_spherical, semi_axes, unit_quaternions
from gaigs.io.files import atomic_write
from gaigs.scene import Scene

LARGEST = 1e6
"""Of a Gaussian's spread and signal at the start: float32 holds squares and sums of them."""

SH_DC = 0.5 / math.sqrt(math.pi)
"""The constant spherical harmonic, by which .ply viewers multiply the first signal coefficient."""


class Gaussians(nn.Module):
    """n anisotropic Gaussians, each a virtual transmitter; parameters are stored raw, properties give them activated.

    They start in the directions that the map shows: for every receiver on a Fibonacci lattice over a zone of the
    sphere, at random distances, each wide enough to meet its neighbours. So the count follows from the angular detail
    wanted: ``count`` splats over the upper hemisphere lie sqrt(2 pi / count) rad apart. Of several receivers each has
    an equal share, and sees the others' too.

    Args:
        scene: Its receivers say where to put the Gaussians.
        zone: Lowest and highest elevation that anything is heard from, in the receivers' frames [rad].
        channels: Signal channels a Gaussian sends on; the pooling knows how many it needs.
        count: Gaussians at the start, of all receivers together.
        near, far: Range of the distances to their own receiver at the start [m].
        spread: Standard deviation at the start, as a fraction of the distance to the next Gaussian of the lattice.
        opacity: At the start, in (0, 1).
        signal: Standard deviation of the signal's random start.
        degree: Of the spherical harmonics over the direction in which a transmitter sees a Gaussian, by which the
            signal changes from one transmitter to another; those above 0 start at zero.

    Attributes:
        degree: Up to which the harmonics count, ``degree`` at the start; less leaves the signal smoother.

    Raises:
        ValueError: An option is out of range.

    Source: parametrisation of Kerbl et al., 3D Gaussian Splatting, 2023. The camera's place is by reciprocity the
    transmitter's: a receiver sees each Gaussian from one direction, in which harmonics would add nothing.
    """

    PARAMETERS = ("means", "quats", "log_scales", "opacity_logits", "signal")

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
        if count < receivers:
            raise ValueError(f"gaussians.count must be at least one a receiver ({receivers}), got {count}")
        if not 0 < near <= far < FAR:
            raise ValueError(f"gaussians.near and far must satisfy 0 < near <= far < {FAR:g} m, got {near} and {far}")
        if not 0 < spread <= LARGEST:
            raise ValueError(f"gaussians.spread must be positive and at most {LARGEST:g}, got {spread}")
        if not 0 < opacity < 1:
            raise ValueError(f"gaussians.opacity must lie between 0 and 1, got {opacity}")
        if not 0 <= signal <= LARGEST:
            raise ValueError(f"gaussians.signal must be at least 0 and at most {LARGEST:g}, got {signal}")
        if not degree >= 0:
            raise ValueError(f"gaussians.degree must be at least 0, got {degree}")
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
        """Standard deviations along the axes [m]."""
        return self.log_scales.exp()

    @property
    def opacities(self) -> Float[Tensor, "n"]:
        """In (0, 1)."""
        return self.opacity_logits.sigmoid()

    @property
    def unit_quats(self) -> Float[Tensor, "n 4"]:
        """Orientations as unit quaternions (w, x, y, z)."""
        return unit_quaternions(self.quats)

    @property
    def covariances(self) -> Float[Tensor, "n 3 3"]:
        """World frame [m²]."""
        axes = semi_axes(self.quats, self.scales)
        return axes @ axes.mT

    @property
    def bands(self) -> Float[Tensor, "n c k"]:
        """The signal's coefficients that count."""
        return self.signal[..., : (self.degree + 1) ** 2]

    def resize(self, count: int) -> None:
        """Makes room for another number of Gaussians; their values are undefined until they are loaded."""
        for name in self.PARAMETERS:
            old = getattr(self, name)
            setattr(self, name, nn.Parameter(old.new_empty(count, *old.shape[1:]), old.requires_grad))

    def _load_from_state_dict(self, state_dict, prefix, *args):
        """Takes the count of the checkpoint, which density control has changed since the configuration was written."""
        if (means := state_dict.get(f"{prefix}means")) is not None and len(means) != len(self):
            self.resize(len(means))
        super()._load_from_state_dict(state_dict, prefix, *args)

    def save_ply(self, path: str | Path) -> None:
        """Writes the Gaussians as a .ply that 3-D Gaussian splatting viewers open.

        Positions [m], log scales, quaternions (w, x, y, z), opacity logits; the signal's first three channels stand in
        f_dc_*, absent ones as 0. In f_rest_* come, one channel after the other, these three's higher coefficients and
        all that further ones have.
        """
        write_ply(path, dict(self.named_parameters()), f"gaigs: {self.signal.shape[1]} signal channels")

    def load_ply(self, path: str | Path) -> None:
        """Takes over the Gaussians of a .ply, whatever their number.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: The file is no splatting .ply or has fewer signal channels than these Gaussians.
        """
        try:
            vertices = PlyData.read(str(path))["vertex"].data
        except (PlyParseError, KeyError) as error:
            raise ValueError(f"{path} must be a whole .ply file with an element 'vertex': {error}") from error
        _, channels, bands = self.signal.shape
        wanted = {name: columns for name, columns in _ply_names(channels, bands).items() if name != "normals"}
        lacking = [column for columns in wanted.values() for column in columns if column not in vertices.dtype.names]
        if lacking:
            each = f" of {bands} coefficients" if bands > 1 else ""
            raise ValueError(
                f"{path} must hold Gaussian splats with {channels} signal channels{each}; it lacks {', '.join(lacking)}"
            )
        self.resize(len(vertices))
        with torch.no_grad():
            for name, columns in wanted.items():
                values = torch.from_numpy(np.stack([vertices[column] for column in columns], -1).astype(np.float32))
                parameter = getattr(self, name)
                values = _from_columns(values, channels) if name == "signal" else values.view_as(parameter)
                parameter.copy_(values)


def fibonacci_lattice(count: int, low: float, high: float) -> Float[Tensor, "count 3"]:
    """Unit vectors spread evenly over a zone of the sphere.

    Args:
        low, high: Elevations that bound the zone [rad].

    Source: Swinbank and Purser, Fibonacci grids, 2006.
    """
    i = torch.arange(count, dtype=torch.float64) + 0.5
    heights = math.sin(low) + (math.sin(high) - math.sin(low)) * i / count
    golden = math.pi * (1 + math.sqrt(5))
    return from_spherical(torch.remainder(golden * i, 2 * math.pi), torch.asin(heights)).float()


def write_ply(path: str | Path, values: Mapping[str, Tensor], comment: str) -> None:
    """Writes any Gaussians as ``Gaussians.save_ply`` does.

    Args:
        path: Of the file.
        values: Raw parameters of n Gaussians, by the names in ``Gaussians.PARAMETERS``.
        comment: A line for the file's head.
    """
    n, channels, bands = values["signal"].shape
    columns = {}
    for name, properties in _ply_names(channels, bands).items():
        filled = torch.zeros(n, len(properties))
        if name != "normals":
            own = values[name].detach().cpu()
            filled[:] = _to_columns(own) if name == "signal" else own.reshape(n, -1)
        columns |= zip(properties, filled.numpy().T, strict=True)
    vertices = np.rec.fromarrays(list(columns.values()), names=list(columns))
    with atomic_write(path) as part:
        PlyData([PlyElement.describe(vertices, "vertex")], comments=[comment]).write(str(part))


def _to_columns(signal: Float[Tensor, "n c k"]) -> Float[Tensor, "n columns"]:
    """The signal as a .ply has it, absent ones of the first three channels as 0."""
    shown = nn.functional.pad(signal, (0, 0, 0, max(0, 3 - signal.shape[1])))
    return torch.cat((shown[:, :3, 0], shown[:, :3, 1:].flatten(1), shown[:, 3:].flatten(1)), 1)


def _from_columns(columns: Float[Tensor, "n columns"], channels: int) -> Float[Tensor, "n c k"]:
    """The inverse of ``_to_columns``."""
    bands = columns.shape[1] // max(3, channels)
    shown, further = columns[:, 3 : 3 * bands], columns[:, 3 * bands :]
    first = torch.cat((columns[:, :3, None], shown.unflatten(1, (3, bands - 1))), -1)
    return torch.cat((first, further.reshape(len(columns), -1, bands)), 1)[:, :channels]


def _ply_names(channels: int, bands: int) -> dict[str, list[str]]:
    """Properties of a splatting .ply for each parameter, in the order viewers expect."""
    rest = 3 * (bands - 1) + bands * max(0, channels - 3)
    return {
        "means": ["x", "y", "z"],
        "normals": ["nx", "ny", "nz"],
        "signal": [f"f_dc_{i}" for i in range(3)] + [f"f_rest_{i}" for i in range(rest)],
        "opacity_logits": ["opacity"],
        "log_scales": [f"scale_{i}" for i in range(3)],
        "quats": [f"rot_{i}" for i in range(4)],
    }
