"""Arguments of ``Model.predict``: checks, axes of the result, and warnings."""

import copy
import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.calibration.conformal import Calibration
from gaigs.calibration.estimate import Asked, Estimate
from gaigs.core.antenna import Receiver
from gaigs.core.geometry import Directions, Grid, Pose, Rays
from gaigs.core.query import (
    ROUNDING,
    Query,
    as_directions,
    as_positions,
    as_receivers,
    as_subcarriers,
)
from gaigs.core.scene import Scene
from gaigs.core.task import Axis


class Subcarriers(NamedTuple):
    """Requested subcarriers of a prediction."""

    # New frequencies [Hz], which the model computes; None: frequencies of the labels.
    exchanged: Float[Tensor, " s"] | None = None
    # Numbers of the requested subcarriers among those of the labels; None: all.
    columns: Int[Tensor, " s"] | None = None
    warning: str = ""  # sentence on the values, empty if there is nothing to say


class Request(NamedTuple):
    """A checked request of ``Model.predict``: links to predict, and axes of the result."""

    query: Query  # links; all receivers of the first position, then of the second, ...
    axes: tuple[int, ...]  # shape of the links in the answer, see ``Query.from_positions``
    receiver: object  # argument ``receiver`` of ``predict``; None: all receivers
    links_per_position: int
    directions: Directions | None  # directions to predict; None: the label's own
    subcarriers: Subcarriers  # subcarriers to predict
    # Sentences on positions, carriers and subcarriers far from the training links.
    warnings: list[str]

    @classmethod
    def of(
        cls,
        scene: Scene,
        transmitters: object,
        receiver: object,
        frequency: object,
        directions: Directions | None,
        subcarriers: Subcarriers,
    ) -> "Request":
        """Checks the arguments of ``Model.predict``, whose docstring lists the errors."""
        directions = as_directions(directions, scene.task.directions, scene.task.name)
        names = [known.name for known in scene.receivers]
        query, axes = Query.from_positions(
            transmitters, receiver, frequency, names, scene.frequencies
        )
        if isinstance(transmitters, Query):  # one link a row, and no warnings
            return cls(query, axes, transmitters.receivers, 1, directions, subcarriers, [])
        links_per_position = axes[-1] if receiver is None else 1
        warnings = [subcarriers.warning] if subcarriers.warning else []
        one_link_each = query[::links_per_position]
        warnings += extrapolations(one_link_each, scene)
        return cls(query, axes, receiver, links_per_position, directions, subcarriers, warnings)

    def asked(self, scene: Scene, name: str | None = None) -> Asked:
        """Names and coordinates of the result's axes, or of its part at receiver ``name``."""
        task = self._task(scene)
        known = [receiver.name for receiver in scene.receivers]
        receiver = self.receiver if name is None else name
        is_single = receiver is not None and not np.ndim(receiver)
        if task.is_channel and is_single:  # the result has only subcarriers in the receiver's band
            in_band = scene.receivers[int(as_receivers(receiver, known))].hears(task.frequencies)
            task = task if in_band.all() else task.at_frequencies(task.frequencies[in_band])
        if isinstance(self.directions, Grid):
            task = copy.copy(task)
            task.directions = self.directions
        axes = task.axes()
        if isinstance(self.directions, Rays):
            shape = self.directions.shape
            axes = {f"direction_{k}": Axis(np.arange(size)) for k, size in enumerate(shape)}
        grid = self.axes[:-1] if self.receiver is None else self.axes  # shape of the positions
        positions = self.query.transmitters[:: self.links_per_position].reshape(*grid, 3)
        has_receiver_axis = self.receiver is None and name is None
        if has_receiver_axis:
            names = np.array(known)
        elif name is not None:
            names = np.full(grid, name)
        else:
            names = np.array(known)[self.query.receivers.cpu()].reshape(grid)
        return Asked(positions, names, has_receiver_axis, axes, task.quantity, task.unit)

    def _task(self, scene: Scene) -> Any:
        """The task at the requested subcarriers."""
        task = scene.task
        if self.subcarriers.exchanged is not None:
            return task.at_frequencies(self.subcarriers.exchanged)
        if self.subcarriers.columns is not None:
            return task.at_frequencies(task.frequencies[self.subcarriers.columns])
        return task

    def estimates(self, fields: Sequence, scene: Scene) -> Any:
        """An ``Estimate``, or a dictionary of estimates by the names of the receivers.

        Args:
            fields: Fields of the estimate, as results of ``arranged``; None: unknown.
            scene: Scene of the model.
        """
        if not isinstance(fields[0], dict):
            return Estimate(*fields).about(self.asked(scene))
        estimates = {}
        for name in fields[0]:
            at_receiver = [None if field is None else field[name] for field in fields]
            estimates[name] = Estimate(*at_receiver).about(self.asked(scene, name))
        return estimates

    def to_xarray(self, answer: Any, scene: Scene) -> Any:
        """A result as a data set, or a dictionary of data sets by receiver."""

        def labelled(part: Any, name: str | None = None) -> Any:
            if not isinstance(part, Estimate):
                part = Estimate(part, None, None, None).about(self.asked(scene, name))
            return part.to_xarray()

        if not isinstance(answer, dict):
            return labelled(answer)
        return {name: labelled(part, name) for name, part in answer.items()}

    def arranged(self, values: Tensor, scene: Scene, axes: tuple[int, ...] | None = None) -> Any:
        """Reshapes values of links (b, ...) to the axes of the result, or to other axes.

        Channels in ``values`` are padded to the largest array and to all subcarriers. If receivers
        differ in these, the result has no padding: a request for all receivers returns a dictionary
        of tensors by name, a request for one receiver its tensor.
        """
        axes = self.axes if axes is None else axes
        receivers = scene.receivers
        values = values.reshape((*axes, *values.shape[1:]))
        if not lacks_numbers(scene):
            return values
        is_channel = values.ndim > len(axes)
        task = self._task(scene)

        def unpadded(part: Tensor, receiver: Receiver) -> Tensor:
            """Values (..., elements, subcarriers) that the receiver measures."""
            if not is_channel:
                return part
            of_elements = part[..., : len(receiver.array), :]
            return of_elements[..., receiver.hears(task.frequencies)]

        if self.receiver is None:
            parts = values.unbind(len(axes) - 1)
            pairs = zip(receivers, parts, strict=True)
            return {receiver.name: unpadded(part, receiver) for receiver, part in pairs}
        number = as_receivers(self.receiver, [receiver.name for receiver in receivers])
        return values if number.ndim else unpadded(values, receivers[int(number)])


def as_new_receiver(receiver: Any, scene: Scene, transmitters: Any) -> Receiver | None:
    """The new receiver in an argument of ``Model.predict``; None for names and indices.

    A new receiver is given by a ``Receiver``, a ``Pose``, or a position [m]. A pose or position
    gets the array of the scene's receivers. A position requires an array without orientation. Three
    whole numbers are a position, but with three transmitters they are an index for each.
    """
    if isinstance(receiver, Receiver) or receiver is None:
        return receiver
    pose = receiver if isinstance(receiver, Pose) else None
    if pose is None:
        kind, shape = _kind_of(receiver)
        _, places = _kind_of(getattr(transmitters, "transmitters", transmitters))
        is_index = kind in "iu" and places[:-1] == (3,)
        if shape != (3,) or kind not in "iuf" or is_index:
            return None
        pose = Pose.at(as_positions("receiver", receiver).cpu())
    array = scene.receivers[0].array
    for known in scene.receivers:
        is_alike = known.array.pattern == array.pattern
        if not is_alike or not torch.equal(known.array.elements, array.elements):
            raise ValueError(
                "receiver must be a gaigs.Receiver with its array, as the arrays of the model's "
                "receivers differ"
            )
    if pose is not receiver and not array.is_point:
        raise ValueError(
            "receiver must be a gaigs.Pose or Receiver, as its array has an orientation, got a "
            f"position {pose.position.tolist()}"
        )
    return Receiver("new", pose, array)


def is_same(one: Receiver, other: Receiver) -> bool:
    """True if two receivers have the same pose and array."""
    pairs = (
        (one.pose.position, other.pose.position),
        (one.pose.rotation, other.pose.rotation),
        (one.array.elements, other.array.elements),
    )
    for a, b in pairs:
        if a.shape != b.shape or not torch.allclose(a.to(b), b):
            return False
    return one.array.pattern == other.array.pattern


def _kind_of(values: Any) -> tuple[str, tuple[int, ...]]:
    """Numpy's letter for the dtype of an array-like, and its shape; ``O`` and () for ragged lists.

    The letters ``i``, ``u`` and ``f`` stand for numbers.
    """
    try:
        array = np.asarray(values.detach().cpu() if isinstance(values, Tensor) else values)
    except ValueError:  # ragged lists
        return "O", ()
    return array.dtype.kind, array.shape


def lacks_numbers(scene: Scene) -> bool:
    """True for channels if a receiver has fewer elements or subcarriers than the labels."""
    if not scene.task.is_channel:
        return False
    return any(
        len(receiver.array) < scene.task.elements
        or not receiver.hears(scene.task.frequencies).all()
        for receiver in scene.receivers
    )


def as_known_subcarriers(frequencies: object, scene: Scene, any_frequency: bool) -> Subcarriers:
    """The requested subcarriers, checked, with a warning if they are far from the labels' band.

    Without ``any_frequency`` the model returns the nearest subcarriers of the labels.
    """
    if frequencies is None:
        return Subcarriers()
    if not scene.task.is_channel:
        raise ValueError(
            f"labels of task {scene.task.name!r} have no subcarriers; leave frequencies out"
        )
    asked = as_subcarriers(frequencies)
    apart, columns = (scene.task.frequencies - asked[:, None]).abs().min(1)  # nearest ones (s,)
    if (apart <= 1e-9 * asked).all():  # equal up to rounding
        return Subcarriers(columns=columns)
    if not any_frequency:
        warning = (
            "values are those of the nearest subcarriers with labels, "
            f"up to {apart.max():.7g} Hz away"
        )
        return Subcarriers(columns=columns, warning=warning)
    low, high = scene.task.frequencies.aminmax()
    beyond = max(low - asked.min(), asked.max() - high).item()
    warning = ""
    if beyond > high - low:
        warning = (
            f"subcarriers are up to {beyond:.4g} Hz beyond those with labels, which span "
            f"{high - low:.4g} Hz: phases may be off"
        )
    return Subcarriers(exchanged=asked, warning=warning)


def check_interval(
    interval: float,
    calibrations: tuple[Calibration | None, Calibration | None],
    scene: Scene,
    frequencies: object,
    any_frequency: bool,
) -> None:
    """Raises the ``ValueError`` of ``Model.predict`` for an impossible interval.

    ``calibrations`` are of the trained model and of its copy at the requested receiver.
    """
    if not 0 < interval < 1:
        raise ValueError(
            f"interval must be a probability between 0 and 1 such as 0.9, got {interval!r}"
        )
    if calibrations[1] is None and calibrations[0] is not None:
        raise ValueError(
            "the model has no intervals at receivers without links, which three receivers or more "
            "with held-out links calibrate\n"
            "leave interval out, or train with more receivers; an older checkpoint also lacks them"
        )
    if calibrations[1] is None:
        raise ValueError(
            "the model has no intervals: no held-out links have measured its errors\n"
            "train it with split.validation above 0, on two places, runs or blocks or more, "
            "without data.band_train"
        )
    subcarriers = as_known_subcarriers(frequencies, scene, any_frequency)
    if subcarriers.warning or subcarriers.exchanged is not None:
        raise ValueError(
            "intervals are those of the labels' own subcarriers; leave frequencies out"
        )


def usual_batch_size(shape: tuple[int, ...], numbers: int = 2**17, most: int = 1024) -> int:
    """Number of links whose labels of a ``shape`` have ``numbers`` values together.

    The result is from 16 to ``most``.
    """
    return min(most, max(16, numbers // math.prod(shape)))


def extrapolations(query: Query, scene: Scene) -> list[str]:
    """Warnings for positions far from the training box, and for carriers beyond the band."""
    messages = []
    lower, upper = (corner.to(scene.lower) for corner in scene.box)
    positions = scene.positions(lower)
    in_box = positions.clamp(lower, upper)  # (receivers, 3), the nearest points of the box
    beyond = (positions - in_box).norm(dim=-1).amax()
    if beyond > scene.extent:
        messages.append(
            f"a receiver is {beyond:.3g} m outside the box of the training links, which is "
            f"{scene.extent:.3g} m across: nothing was measured near there"
        )
    points = query.transmitters
    in_box = points.clamp(scene.lower.to(points), scene.upper.to(points))  # (b, 3)
    distances = (points - in_box).norm(dim=-1)  # (b,)
    if count := int((distances > scene.extent).sum()):
        messages.append(
            f"{count} of {len(points)} positions are up to {distances.amax():.3g} m outside the "
            "box of the training transmitters, which with the receivers is "
            f"{scene.extent:.3g} m across: nothing was measured near there"
        )
    if query.frequencies is None or not scene.has_band:
        return messages
    asked = query.frequencies.double()
    low, high = scene.frequencies.double()[[0, -1]].tolist()
    outside = asked[(asked < low * (1 - ROUNDING)) | (asked > high * (1 + ROUNDING))]
    if len(outside):
        ends = f"{outside.amin():.7g}", f"{outside.amax():.7g}"
        span = " to ".join(dict.fromkeys(ends))
        messages.append(
            f"{len(outside)} of {len(asked)} positions are asked at {span} Hz, outside the "
            f"training links' band of {low:.7g} to {high:.7g} Hz: nothing was measured there"
        )
    return messages
