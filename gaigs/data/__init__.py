"""Measured and simulated links: who sent from where, who heard, and the label."""

import math
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from gaigs.geometry import Pose


@dataclass(frozen=True)
class Grid:
    """Directions of a spectrum's pixel centres, in the array's frame.

    Attributes:
        elevations: One a row [rad].
        azimuths: One a column [rad].
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
            ValueError: There is a single row, whose extent is unknown.
        """
        if len(self.elevations) < 2:
            raise ValueError("solid angles take at least 2 rows, got 1; use a finer grid")
        sines = self.elevations.double().sin()
        first, last = (3 * sines[:1] - sines[1:2]) / 2, (3 * sines[-1:] - sines[-2:-1]) / 2
        bounds = torch.cat((first, (sines[1:] + sines[:-1]) / 2, last)).clamp(-1, 1)
        shares = bounds.diff().abs()[:, None].expand(self.shape)
        return (shares / shares.sum()).float()

    def thin(self, rows: slice, columns: slice) -> "Grid":
        """The grid of some of the rows and columns."""
        return Grid(self.elevations[rows], self.azimuths[columns])

    def to(self, device: torch.device) -> "Grid":
        """The same grid on another device."""
        return Grid(self.elevations.to(device), self.azimuths.to(device))


@dataclass(frozen=True)
class Receiver:
    """An antenna array or gateway: its name in the files and its pose in the room."""

    name: str
    pose: Pose


@dataclass(frozen=True)
class Scene:
    """What a model must know of a data set to be built; a checkpoint stores it, so that it loads without the data.

    Attributes:
        receivers: Who hears.
        lower, upper: Corners of the box that holds the training transmitters, world frame (3,) [m].
        spacing: Median distance from a training transmitter to the next one elsewhere [m].
        grid: Directions of the label's pixels; None where the label is no spectrum.
        normalisation: How the labels were scaled, in words of docs/data.md.
    """

    receivers: tuple[Receiver, ...]
    lower: Float[Tensor, "3"]
    upper: Float[Tensor, "3"]
    spacing: float
    grid: Grid | None
    normalisation: str

    def state(self) -> dict:
        """The scene in plain tensors, lists and strings, for a checkpoint."""
        return {
            "receivers": [[r.name, r.pose.position, r.pose.rotation] for r in self.receivers],
            "lower": self.lower,
            "upper": self.upper,
            "spacing": self.spacing,
            "grid": None if self.grid is None else [self.grid.elevations, self.grid.azimuths],
            "normalisation": self.normalisation,
        }

    @classmethod
    def from_state(cls, state: dict) -> "Scene":
        """The inverse of ``state``."""
        receivers = tuple(Receiver(name, Pose(position, rotation)) for name, position, rotation in state["receivers"])
        grid = None if state["grid"] is None else Grid(*state["grid"])
        return cls(receivers, state["lower"], state["upper"], state["spacing"], grid, state["normalisation"])


@dataclass(frozen=True)
class Split:
    """Which links train, validate and test; ``name`` says by which protocol, with its numbers."""

    name: str
    train: Int[Tensor, "train"]
    validation: Int[Tensor, "validation"]
    test: Int[Tensor, "test"]

    def parts(self) -> dict[str, Int[Tensor, "k"]]:
        """The three by name."""
        return {"train": self.train, "validation": self.validation, "test": self.test}


@dataclass(frozen=True)
class Links:
    """A data set: n links, each from one transmitter position to one receiver.

    Attributes:
        transmitters: Positions, world frame (n, 3) [m], float32.
        receivers: Who hears.
        receiver_index: The receiver of each link (n,).
        labels: Indexed by an integer tensor (k,) it gives float32 labels: (k, rows, columns) spectra in [0, 1], or
            (k,) RSSI [dBm].
            A tensor, or anything that reads its labels when asked.
        split: Train, validation and test links.
        grid: Directions of the label's pixels; None where the label is no spectrum.
        normalisation: How the labels were scaled, e.g. "min-max of each spectrum's amplitude".
        edges: Line segments of the room to draw in figures (k, 2, 3) [m]; empty where unknown.
        remarks: What was read, and what was left out and why, in a sentence.
    """

    transmitters: Float[Tensor, "n 3"]
    receivers: tuple[Receiver, ...]
    receiver_index: Int[Tensor, "n"]
    labels: Tensor
    split: Split
    grid: Grid | None
    normalisation: str
    edges: Float[Tensor, "k 2 3"] = field(default_factory=lambda: torch.zeros(0, 2, 3))
    remarks: str = ""

    def known(self, receiver: int) -> Int[Tensor, "k"]:
        """The links to a receiver that are not held out for the test; look-ups use them all."""
        index = torch.cat((self.split.train, self.split.validation))
        return index[self.receiver_index[index] == receiver]

    @property
    def scene(self) -> Scene:
        """What a model is built from.

        Raises:
            ValueError: All training transmitters stand at one point.
        """
        train = self.transmitters[self.split.train].unique(dim=0)
        if len(train) < 2:
            raise ValueError(f"training takes transmitters at two points or more, got {len(train)}; check the split")
        distances, _ = cKDTree(train.double().numpy()).query(train.double().numpy(), k=2)
        spacing = float(np.median(distances[:, 1]))
        return Scene(self.receivers, train.amin(0), train.amax(0), spacing, self.grid, self.normalisation)
