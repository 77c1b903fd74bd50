"""Directions of a label's pixels or of a map: a grid, or any list of rays."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.geometry import from_spherical


@dataclass
class Rays:
    """Any list of directions, in the array's frame.

    Attributes:
        elevations: One a ray [rad].
        azimuths: One a ray [rad].

    Example:
        >>> gaigs.Rays(elevations=torch.tensor([0.0, 0.5]), azimuths=torch.tensor([0.0, 3.0])).vectors().shape
        torch.Size([2, 3])
    """

    elevations: Float[Tensor, "k"]
    azimuths: Float[Tensor, "k"]

    @property
    def shape(self) -> tuple[int]:
        return (len(self.elevations),)

    def flatten(self) -> "Rays":
        """The same, as a list of rays."""
        return self

    def vectors(self) -> Float[Tensor, "k 3"]:
        """Unit vectors in the array's frame."""
        return from_spherical(self.azimuths, self.elevations)

    def __getitem__(self, index: slice | Int[Tensor, "j"]) -> "Rays":
        return Rays(self.elevations[index], self.azimuths[index])

    def to(self, where: torch.device | str | torch.dtype | Tensor) -> "Rays":
        """The same directions on another device or in another dtype."""
        return Rays(self.elevations.to(where), self.azimuths.to(where))


@dataclass
class Grid:
    """Directions of a spectrum's pixel centres, in the array's frame.

    Attributes:
        elevations: One a row [rad].
        azimuths: One a column [rad].

    Example:
        >>> gaigs.Grid.degrees().shape, gaigs.Grid.degrees(elevations=range(-30, 31, 10), azimuths=range(8)).shape
        ((90, 360), (7, 8))
    """

    elevations: Float[Tensor, "rows"]
    azimuths: Float[Tensor, "columns"]

    @classmethod
    def degrees(cls, elevations=range(1, 91), azimuths=range(360)) -> "Grid":
        """A grid of whole degrees; the default is that of the NeRF² spectra, 90 x 360."""
        as_radians = lambda values: torch.deg2rad(torch.tensor([float(v) for v in values]))
        return cls(as_radians(elevations), as_radians(azimuths))

    @classmethod
    def sphere(cls, rows: int, columns: int) -> "Grid":
        """The full sphere in pixels of equal solid angle: the sines of the rows' elevations are evenly spaced.

        Raises:
            ValueError: There are fewer than 2 rows or 3 columns.
        """
        if rows < 2 or columns < 3:
            raise ValueError(f"a grid over the sphere takes at least 2 rows and 3 columns, got {rows} x {columns}")
        sines = (2 * torch.arange(rows, dtype=torch.float64) + 1 - rows) / rows
        azimuths = 2 * math.pi / columns * (torch.arange(columns, dtype=torch.float64) + 0.5)
        return cls(sines.asin().float(), azimuths.float())

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.elevations), len(self.azimuths)

    @property
    def pitch(self) -> float:
        """Distance between neighbouring rows, their mean [rad]."""
        rows = self.shape[0]
        return ((self.elevations[-1] - self.elevations[0]) / max(rows - 1, 1)).abs().item()

    @property
    def solid_angles(self) -> Float[Tensor, "rows columns"]:
        """Shares of the pixels in the grid's; rows meet where the sine of the elevation is halfway between theirs.

        Raises:
            ValueError: There are fewer than 2 rows: the extent of a single one is unknown.
        """
        if len(self.elevations) < 2:
            raise ValueError(f"solid angles take at least 2 rows, got {len(self.elevations)}; use a finer grid")
        sines = self.elevations.double().sin()
        first, last = (3 * sines[:1] - sines[1:2]) / 2, (3 * sines[-1:] - sines[-2:-1]) / 2
        bounds = torch.cat((first, (sines[1:] + sines[:-1]) / 2, last)).clamp(-1, 1)
        shares = bounds.diff().abs()[:, None].expand(self.shape)
        return (shares / shares.sum()).float()

    def thin(self, rows: slice, columns: slice) -> "Grid":
        """The grid of some of the rows and columns."""
        return Grid(self.elevations[rows], self.azimuths[columns])

    def flatten(self) -> Rays:
        """The pixels row by row, as a list of rays."""
        elevations, azimuths = torch.meshgrid(self.elevations, self.azimuths, indexing="ij")
        return Rays(elevations.flatten(), azimuths.flatten())

    def vectors(self) -> Float[Tensor, "rows columns 3"]:
        """Unit vectors in the array's frame."""
        return self.flatten().vectors().unflatten(0, self.shape)

    def to(self, where: torch.device | str | torch.dtype | Tensor) -> "Grid":
        """The same directions on another device or in another dtype."""
        return Grid(self.elevations.to(where), self.azimuths.to(where))


Directions = Grid | Rays
"""What a label or a map has a value for each of."""
