"""Queries, which list links; and batches, queries with directions and labels."""

import math
import reprlib
from collections.abc import Iterator, KeysView, Sequence, ValuesView
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Shaped
from torch import Tensor

from gaigs.core.geometry import Directions, Grid, Rays
from gaigs.io import FAR, WITHIN

CARRIERS = 1e4, 3e11
"""Lowest and highest carrier [Hz]; another number is in another unit."""

ROUNDING = 1e-6
"""Relative difference below which two carriers are equal; float32 rounds by less."""


def unit_hint(number: float) -> str:
    """Question for the end of an error message, such as ``; in MHz?``; empty if no unit fits.

    A unit fits if ``number`` in this unit is within ``CARRIERS``.
    """
    low, high = CARRIERS
    for unit, size in {"GHz": 1e9, "MHz": 1e6, "Hz": 1.0}.items():
        if low / size <= number <= high / size:
            return f"; in {unit}?"
    return ""


def check_carrier(name: str, frequencies: float | Tensor) -> None:
    """Raises a ``ValueError`` unless all values of the option ``name`` are carriers [Hz]."""
    low, high = CARRIERS
    values = torch.as_tensor(frequencies, dtype=torch.float64).flatten()
    wrong = values[~((values >= low) & (values <= high))]  # NaN, too
    if len(wrong):
        first = wrong[0].item()
        expected = f"a carrier in Hz, from {low:g} to {high:g}"
        raise ValueError(f"{name} must be {expected}, got {first:.7g}{unit_hint(first)}")


def evenly(index: Int[Tensor, " k"], most: int) -> Int[Tensor, " j"]:
    """At most ``most`` indices of ``index``, at even steps."""
    if len(index) <= most:
        return index
    return index[torch.linspace(0, len(index) - 1, most).round().long()]


def drawn(index: Int[Tensor, " k"], most: int = 10_000) -> Int[Tensor, " j"]:
    """At most ``most`` of the links in ``index``, drawn at random, in their order.

    Every n-th link could belong to a few receivers only. The default suffices for mean errors: the
    mean of 10,000 errors of 3 dB is known to 0.02 dB.
    """
    if len(index) <= most:
        return index
    order = torch.randperm(len(index), generator=torch.Generator().manual_seed(0))
    return index[order[:most].sort().values]


def thin_labels(labels: Shaped[Tensor, " k *shape"], most: int = 1024) -> Shaped[Tensor, "k m"]:
    """At most ``most`` values of each label, evenly spread over its rows and columns."""
    numbers = labels[..., None].flatten(1)  # (k, rows x columns)
    columns = labels.shape[-1] if labels.ndim > 1 else 1
    index = evenly(torch.arange(numbers.shape[1]), most)
    # Numbers at a step that divides the number of columns would come from few columns. With one
    # number less the step is another.
    while len((index % columns).unique()) < min(columns, most) / 8:
        most -= 1
        index = evenly(torch.arange(numbers.shape[1]), most)
    return numbers[:, index]


def as_tensor(name: str, values: object, expected: str) -> Tensor:
    """An array-like as a tensor of the same dtype; a ``ValueError`` for anything else.

    Args:
        name: Name of the option in errors.
        values: Tensor, array, number, column of a table, or nested lists of these.
        expected: What the option takes, for errors.
    """
    if isinstance(values, Tensor):
        if values.is_meta or values.layout is not torch.strided:
            kind = "meta" if values.is_meta else str(values.layout).removeprefix("torch.")
            raise ValueError(
                f"{name} must be {expected}, got a {kind} tensor; give a dense tensor with values"
            )
        # A training cannot use tensors of inference mode.
        return values.clone() if values.is_inference() else values
    if isinstance(values, list | tuple) and any(isinstance(value, Tensor) for value in values):
        parts = [as_tensor(name, value, expected) for value in values]
        if len({part.shape for part in parts}) == 1:
            return torch.stack(parts)
    try:
        if np.ma.is_masked(values):
            raise TypeError("masked")
        array: Any = np.array(values)  # a copy, since torch warns of arrays that are read-only
        if array.dtype == object and array.ndim:  # such as a column of pandas with missing values
            missing = [value is None or type(value).__name__ == "NAType" for value in array.flat]
            array[np.reshape(missing, array.shape)] = np.nan
            array = np.array(array.tolist())  # with a dtype of numbers, if all are numbers
        # Torch takes no negative strides and no other byte order.
        return torch.from_numpy(
            np.ascontiguousarray(array, array.dtype.newbyteorder("=")).reshape(array.shape)
        )
    except (TypeError, ValueError, RuntimeError, OverflowError):  # of words and ragged lists
        raise ValueError(f"{name} must be {expected}, got {reprlib.repr(values)}") from None


def as_numbers(name: str, values: object, expected: str) -> Tensor:
    """A real array-like as a float32 tensor; a ``ValueError`` for anything else."""
    expected = f"{expected} in real numbers"
    tensor = as_tensor(name, values, expected)
    if tensor.is_complex() or tensor.dtype == torch.bool:
        raise ValueError(f"{name} must be {expected}, got {reprlib.repr(values)}")
    return tensor.to(torch.float32)


def as_positions(name: str, values: object) -> Float[Tensor, "*points 3"]:
    """Positions of any type as a float32 tensor [m], checked for shape and range."""
    positions = as_numbers(name, values, "(..., 3) positions [m]")
    if positions.shape == (0,):  # an empty list
        positions = positions.reshape(0, 3)
    if not positions.ndim or positions.shape[-1] != 3:
        raise ValueError(
            f"{name} must be (..., 3) positions [m], got shape {tuple(positions.shape)}"
        )
    points = positions.reshape(-1, 3)
    for holds, expected in ((points.isfinite(), "finite"), (points.abs() < FAR, WITHIN)):
        if not holds.all():
            row = int((~holds).any(1).nonzero()[0])
            raise ValueError(f"{name} must be {expected}, got {points[row].tolist()} in row {row}")
    return positions


def as_receivers(values: Any, names: Sequence[str]) -> Int[Tensor, "*points"]:
    """Indices of receivers, from names or indices; a ``ValueError`` for an unknown receiver.

    ``names`` are the names of all receivers in the order of their indices.
    """
    expected = f"one of {', '.join(f'{i} = {name}' for i, name in enumerate(names))}"
    if isinstance(values, KeysView | ValuesView) or hasattr(values, "to_numpy"):
        values = [*values]
    elif isinstance(values, np.ndarray) and values.dtype.kind in "UO":
        values = values.tolist()
    if _is_text(values):
        words = np.array(values)
        numbers = {name: number for number, name in enumerate(names)}
        for word in words.ravel().tolist():
            if word not in numbers:
                raise ValueError(f"receiver must be {expected}, got {word!r}")
        values = np.array([numbers[word] for word in words.ravel().tolist()]).reshape(words.shape)
    indices = as_tensor("receiver", values, expected)
    if indices.dtype not in (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8):
        given = f"{tuple(indices.shape)} of {indices.dtype}" if indices.ndim else repr(values)
        raise ValueError(f"receiver must be {expected}, got {given}")
    indices = indices.long()
    wrong = indices[(indices < 0) | (indices >= len(names))]
    if len(wrong):
        raise ValueError(f"receiver must be {expected}, got {wrong[0]}")
    return indices


def _is_text(values: object) -> bool:
    """True for a word, or words in lists in lists."""
    return isinstance(values, str) or (
        isinstance(values, list | tuple) and len(values) > 0 and all(map(_is_text, values))
    )


def as_frequencies(values: object, known: Float[Tensor, " f"]) -> Float[Tensor, "*points"] | None:
    """Carriers of a user's request [Hz], checked; for None the training links' only carrier.

    Args:
        values: Requested carriers.
        known: Distinct carriers of the training links, ascending [Hz]; empty if unknown.

    Returns:
        None if no carrier is requested and none is known.
    """
    if values is None:
        if len(known) > 1:
            span = f"{known[0]:.7g} to {known[-1]:.7g} Hz"
            raise ValueError(
                f"the training links have {len(known)} carriers, {span}; choose one with "
                "frequency=..."
            )
        return known[0] if len(known) else None
    frequencies = as_numbers("a frequency", values, "a carrier in Hz")
    check_carrier("a frequency", frequencies)
    if len(known) < 2 and not (
        len(known) and torch.isclose(frequencies, known[0], rtol=ROUNDING).all()
    ):
        carrier = f"one carrier, {known[0]:.7g} Hz" if len(known) else "no known carrier"
        raise ValueError(
            f"the training links have {carrier}, so no other can be predicted; leave frequency out"
        )
    return frequencies


def as_subcarriers(values: object) -> Float[Tensor, " s"]:
    """Distinct subcarriers of a request [Hz], one or several, checked, in float64."""
    expected = "different subcarriers (s,) in Hz"
    as_numbers("frequencies", values, expected)  # only the check: float32 would merge subcarriers
    exact = as_tensor("frequencies", values, expected).detach().cpu()
    subcarriers = exact.double().reshape(-1) if exact.ndim < 2 else exact
    if (
        subcarriers.ndim != 1
        or not len(subcarriers)
        or len(subcarriers.unique()) < len(subcarriers)
    ):
        raise ValueError(
            f"frequencies must be {expected}, got shape {tuple(exact.shape)}: "
            f"{reprlib.repr(values)}"
        )
    check_carrier("frequencies", subcarriers)
    return subcarriers


def as_directions(directions: Directions | None, own: Grid | None, task: str) -> Directions | None:
    """Directions of a user's request, checked, in float32; for None the label's directions.

    Args:
        directions: Requested directions.
        own: The label's directions; None if labels of this task have none.
        task: Name of the task, for errors.
    """
    if directions is None:
        return own
    if own is None:
        raise ValueError(f"labels of task {task!r} have no directions; leave directions out")
    angles = {}
    # Azimuths are periodic: a few turns are accepted, a circle in degrees is more. 1e-4 allows for
    # rounded angles.
    for name, most in (("elevations", math.pi / 2), ("azimuths", 20 * math.pi)):
        expected = f"a list of angles from {-most:.4f} to {most:.4f} rad"
        angles[name] = values = as_numbers(name, getattr(directions, name, None), expected)
        if values.ndim != 1:
            raise ValueError(f"{name} must be {expected}, got shape {tuple(values.shape)}")
        if len(wrong := values[~(values.abs() <= most + 1e-4)]):
            raise ValueError(
                f"{name} must be {expected}, got {wrong[0]:g}; Grid.degrees takes degrees"
            )
    if isinstance(directions, Grid):
        return Grid(**angles)
    rows, columns = map(len, angles.values())
    if rows != columns:
        raise ValueError(
            f"rays must have as many elevations as azimuths, got {rows} and {columns}; Grid has "
            "rows"
        )
    return Rays(**angles)


@dataclass
class Query:
    """A list of links, each from one transmitter to one receiver.

    Attributes:
        transmitters: Positions, world frame (b, 3) [m].
        receivers: Indices into the scene's receivers (b,).
        frequencies: Carriers (b,) [Hz], from 10 kHz to 300 GHz; None if unknown.

    Example:
        >>> places = torch.tensor([[1.0, 2.0, 1.5], [2.0, 1.0, 1.5]])
        >>> query = gaigs.Query(places, torch.tensor([0, 0]))
        >>> len(query), query[:1].transmitters
        (2, tensor([[1.0000, 2.0000, 1.5000]]))
    """

    transmitters: Float[Tensor, "b 3"]
    receivers: Int[Tensor, " b"]
    frequencies: Float[Tensor, " b"] | None = None

    @classmethod
    def from_positions(
        cls,
        positions: object,
        receiver: object,
        frequency: object,
        names: Sequence[str],
        known: Float[Tensor, " f"],
    ) -> tuple["Query", tuple[int, ...]]:
        """Links from transmitters at a user's positions; every number is checked here.

        Args:
            positions: Positions (..., 3) [m], of any type that converts to a float tensor; or a
                ``Query``.
            receiver: Name or index of the receiver, or a list with one for each position; None:
                all receivers.
            frequency: Carrier, one for all or one for each position [Hz]; None: the known one.
            names: Names of the scene's receivers.
            known: Distinct carriers of the training links, ascending [Hz]; empty if unknown.

        Returns:
            The links in the order of ``positions.reshape(-1, 3)``, and the shape of the result: the
            leading axes of the positions, and a last axis for all receivers if none is given.
        """
        if isinstance(positions, Query):
            if frequency is not None or receiver is not None:
                raise ValueError(
                    "a query has its own receivers and frequencies; leave receiver and frequency "
                    "out"
                )
            receiver = positions.receivers
            frequency = positions.frequencies
            positions = positions.transmitters
        points = as_positions("transmitters", positions)
        shape = points.shape[:-1]

        def spread(name: str, values: Tensor) -> Tensor:
            """One value for each position, from one for all or one for each."""
            if values.ndim and values.shape != shape:
                expected = f"one, or one for each of the {tuple(shape)} positions"
                raise ValueError(f"{name} must be {expected}, got {tuple(values.shape)}")
            return values.expand(shape).reshape(-1)

        points = points.reshape(-1, 3)
        indices = as_receivers(0 if receiver is None else receiver, names)
        receivers = spread("receivers", indices).to(points.device)
        frequencies = as_frequencies(frequency, known.cpu().float())
        if frequencies is not None:
            frequencies = spread("frequencies", frequencies)
        query = cls(points, receivers, frequencies)
        if receiver is not None:
            return query, shape
        # All receivers for each position in turn.
        query = query[torch.arange(len(points)).repeat_interleave(len(names))]
        query.receivers = torch.arange(len(names), device=points.device).repeat(len(points))
        return query, (*shape, len(names))

    def __len__(self) -> int:
        return len(self.transmitters)

    def __getitem__(self, index: slice | Int[Tensor, " k"] | Bool[Tensor, " b"]) -> "Query":
        frequencies = None if self.frequencies is None else self.frequencies[index]
        return Query(self.transmitters[index], self.receivers[index], frequencies)

    def to(self, device: torch.device | str) -> "Query":
        frequencies = None if self.frequencies is None else self.frequencies.to(device)
        return Query(self.transmitters.to(device), self.receivers.to(device), frequencies)

    def parts(self, size: int) -> Iterator["Query"]:
        """The links in order, at most ``size`` at a time; an empty query is one part."""
        return (self[start : start + size] for start in range(0, max(len(self), 1), size))

    @property
    def place_keys(self) -> Int[Tensor, " b"]:
        """A number for each transmitter's position; equal positions have equal numbers."""
        # + 0.0 makes -0 the same as 0.
        places = (self.transmitters.detach().cpu().float() + 0.0).contiguous()
        x, y, z = places.view(torch.int32).long().unbind(1)
        # A hash of the bits; past 64 bits it wraps.
        return (x * 1_000_003 + y) * 1_000_003 + z

    @property
    def votes(self) -> Float[Tensor, " b"]:
        """Weights such that repeated readings of a place, receiver and carrier count as one."""
        _, number = self.unique(with_receivers=True)
        repetitions = number.bincount().double()
        return repetitions.reciprocal()[number]

    def unique(self, with_receivers: bool) -> tuple["Query", Int[Tensor, " b"]]:
        """The distinct links, and the number of each link among them.

        Distinct links are sorted by position, frequency and receiver. Without ``with_receivers``
        links that differ only in the receiver are equal.
        """
        tensors = [*self.transmitters.unbind(1)]
        if self.frequencies is not None:
            tensors.append(self.frequencies)
        if with_receivers:
            tensors.append(self.receivers)
        # Double holds float32, float64 and indices exactly. With a thousand links this takes a
        # tenth of the time of torch.unique.
        columns = [tensor.detach().double().cpu().numpy() for tensor in tensors]
        order = np.lexsort(columns[::-1])  # the last column has the highest rank in numpy
        # True for a link that differs from the one before it in this order.
        is_new = np.ones(len(order), dtype=bool)
        is_new[1:] = np.any([column[order[1:]] != column[order[:-1]] for column in columns], axis=0)
        numbers = np.empty_like(order)
        numbers[order] = is_new.cumsum() - 1
        device = self.transmitters.device
        first = torch.from_numpy(order[is_new]).to(device)
        return self[first], torch.from_numpy(numbers).to(device)


@dataclass
class Batch:
    """A query with directions and labels.

    Attributes:
        directions: Directions to predict, the same for all links; None if labels have none.
        labels: Measured values (b, ...), of the task's shape; None when predicting.
        shares: Weights of this batch's mean over links and of its mean over places. They make the
            average over training processes equal to the mean over all links, or all places.
    """

    query: Query
    directions: Directions | None = None
    labels: Tensor | None = None
    shares: tuple[float, float] = (1.0, 1.0)

    def __len__(self) -> int:
        return len(self.query)

    def to(self, device: torch.device | str) -> "Batch":
        directions = None if self.directions is None else self.directions.to(device)
        labels = None if self.labels is None else self.labels.to(device)
        return Batch(self.query.to(device), directions, labels, self.shares)
