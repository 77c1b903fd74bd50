"""What a model is asked: who sends, who hears, at which frequency; and a batch of such questions with their labels."""

import reprlib
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.directions import Directions
from gaigs.geometry import FAR, WITHIN

CARRIERS = 1e4, 3e11
"""All carriers lie from the first to the second [Hz]; another number is in another unit."""


UNITS = {"GHz": 1e9, "MHz": 1e6, "Hz": 1.0}


def unit_hint(number: float) -> str:
    """A question about the unit in which a number that is no carrier would be one; empty where there is none."""
    low, high = CARRIERS
    return next((f"; in {unit}?" for unit, size in UNITS.items() if low / size <= number <= high / size), "")


def check_carrier(name: str, frequency: float) -> None:
    """Raises a ``ValueError`` unless the option of that name is a carrier [Hz]."""
    low, high = CARRIERS
    if not low <= frequency <= high:
        expected = f"a carrier in Hz, from {low:g} to {high:g}"
        raise ValueError(f"{name} must be {expected}, got {frequency:.7g}{unit_hint(frequency)}")


def as_numbers(what: str, values: object, expected: str) -> Tensor:
    """Real numbers of any kind as a float tensor.

    Raises:
        ValueError: They are not real numbers.
    """
    try:
        tensor = torch.as_tensor(values)
        if tensor.is_complex() or tensor.dtype == torch.bool or np.ma.is_masked(values):
            raise TypeError(str(tensor.dtype))
    except (TypeError, ValueError, RuntimeError, OverflowError):  # whatever torch meets in words, or in ragged lists
        raise ValueError(f"{what} must be {expected} in real numbers, got {reprlib.repr(values)}") from None
    return tensor.to(torch.float32)


def as_positions(what: str, values: object) -> Float[Tensor, "*points 3"]:
    """Positions of any kind as a float32 tensor (..., 3) [m].

    Raises:
        ValueError: They are not (..., 3) real numbers, or one is not finite or too far away.
    """
    positions = as_numbers(what, values, "(..., 3) positions [m]")
    if not positions.ndim or positions.shape[-1] != 3:
        raise ValueError(f"{what} must be (..., 3) positions [m], got shape {tuple(positions.shape)}")
    points = positions.reshape(-1, 3)
    for holds, expected in ((points.isfinite(), "finite"), (points.abs() < FAR, WITHIN)):
        if not holds.all():
            row = int((~holds).any(1).nonzero()[0])
            raise ValueError(f"{what} must be {expected}, got {points[row].tolist()} in row {row}")
    return positions


@dataclass
class Query:
    """Links, each of one transmitter to one receiver. Two are alike only if all their fields are.

    Attributes:
        transmitters: Positions, world frame (b, 3) [m].
        receivers: Indices into the scene's receivers (b,).
        frequencies: Of the carrier (b,) [Hz], from 10 kHz to 300 GHz; None where it is unknown.

    Example:
        >>> query = gaigs.Query(torch.tensor([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]]), torch.tensor([0, 0]))
        >>> len(query), query[:1].transmitters
        (2, tensor([[1.0000, 2.0000, 1.5000]]))
    """

    transmitters: Float[Tensor, "b 3"]
    receivers: Int[Tensor, "b"]
    frequencies: Float[Tensor, "b"] | None = None

    def __len__(self) -> int:
        return len(self.transmitters)

    def __getitem__(self, index: slice | Int[Tensor, "k"]) -> "Query":
        """Some of the links."""
        frequencies = None if self.frequencies is None else self.frequencies[index]
        return Query(self.transmitters[index], self.receivers[index], frequencies)

    def to(self, device: torch.device | str) -> "Query":
        """The same query on another device."""
        frequencies = None if self.frequencies is None else self.frequencies.to(device)
        return Query(self.transmitters.to(device), self.receivers.to(device), frequencies)

    def parts(self, size: int) -> Iterator["Query"]:
        """The links in their order, so many at a time."""
        return (self[start : start + size] for start in range(0, len(self), size))

    def unique(self, with_receivers: bool) -> tuple["Query", Int[Tensor, "b"]]:
        """The different places and frequencies, or the different links.

        Args:
            with_receivers: Whether links to two receivers differ. Where they do not, each place has one of its
                receivers, whichever.

        Returns:
            One link of each kind, sorted by position, frequency and receiver; and which of them each link is.
        """
        columns = self.transmitters
        others = [self.frequencies] if self.frequencies is not None else []
        others += [self.receivers] if with_receivers else []
        if others:
            # Positions and frequencies are float32 or float64, which double holds exactly; so is an index.
            columns = torch.cat((columns.double(), *(other.double()[:, None] for other in others)), 1)
        _, which = columns.unique(dim=0, return_inverse=True)
        count = int(which.max()) + 1 if len(which) else 0
        numbers = torch.arange(len(which), device=which.device)
        first = numbers.new_full((count,), len(which)).scatter_reduce(0, which, numbers, "amin")
        return self[first], which


@dataclass
class Batch:
    """A query with the directions asked for and what was measured.

    Attributes:
        query: The links.
        directions: Those to predict, for all links the same; None where the label has none.
        labels: What was measured (b, ...), of the task's shape; None when predicting.
        shares: Weights of the mean over these links, and of that over their places, in the mean over all processes
            that train together; 1 where there is a single one.
    """

    query: Query
    directions: Directions | None = None
    labels: Tensor | None = None
    shares: tuple[float, float] = (1.0, 1.0)

    def __len__(self) -> int:
        return len(self.query)

    def to(self, device: torch.device | str) -> "Batch":
        """The same batch on another device."""
        directions = None if self.directions is None else self.directions.to(device)
        labels = None if self.labels is None else self.labels.to(device)
        return Batch(self.query.to(device), directions, labels, self.shares)
