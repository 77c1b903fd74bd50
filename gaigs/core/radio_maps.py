"""Radio maps: predictions of a scalar, such as RSSI, for transmitters all over a floor."""

import logging
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from gaigs.core import stages
from gaigs.core.geometry import ExtrapolationWarning
from gaigs.core.query import as_receivers
from gaigs.core.results import library, plot
from gaigs.core.scene import Scene
from gaigs.io.files import atomic_write

log = logging.getLogger(__name__)


@dataclass(frozen=True, repr=False)
class RadioMap:
    """Predictions of a scalar, such as RSSI, for transmitters on a horizontal plane.

    Attributes:
        values: A map for each receiver (receivers, rows, columns) [unit]; rows along y, columns
            along x.
        x: Coordinate of each column, world frame [m].
        y: Coordinate of each row, world frame [m].
        height: Height of the transmitters, world frame [m].
        receivers: Names of the receivers.
        quantity: Name of the predicted quantity.
        unit: Unit of a value; empty for a ratio.
        frequency: Carrier [Hz]; None if unknown.
        deviations: Standard deviations of the labels (receivers, rows, columns); None if the model
            has no intervals.
    """

    values: Float[ndarray, "receivers rows columns"]
    x: Float[ndarray, " columns"]
    y: Float[ndarray, " rows"]
    height: float
    receivers: tuple[str, ...]
    quantity: str = "RSSI"
    unit: str = "dBm"
    frequency: float | None = None
    deviations: Float[ndarray, "receivers rows columns"] | None = None

    def __repr__(self) -> str:
        rows, columns = self.values.shape[1:]
        name = f"{self.quantity} [{self.unit}]" if self.unit else self.quantity
        names = ", ".join(self.receivers[:5])
        if len(self.receivers) > 5:
            names += ", ..."
        x = f"x {self.x[0]:.2f} to {self.x[-1]:.2f}"
        y = f"y {self.y[0]:.2f} to {self.y[-1]:.2f}"
        grid = f"{rows} x {columns} points, {x} and {y}, z {self.height:.2f} m"
        return f"<radio map of {name}: {names}; {grid}>"

    def only(self, index: Int[ndarray, " k"]) -> "RadioMap":
        """The maps of the receivers with these numbers."""
        deviations = None if self.deviations is None else self.deviations[index]
        names = tuple(self.receivers[number] for number in index)
        return replace(self, values=self.values[index], receivers=names, deviations=deviations)

    plot = plot

    def to_xarray(self) -> Any:
        """An ``xarray.Dataset`` with ``value`` and, if it is known, ``std`` by receiver, y, x."""
        places = {"x": ("x", self.x, {"units": "m"}), "y": ("y", self.y, {"units": "m"})}
        scalars = {"z": ((), self.height, {"units": "m"})}
        if self.frequency is not None:
            scalars["frequency"] = ((), self.frequency, {"units": "Hz"})
        unit = {"long_name": self.quantity, "units": self.unit}
        variables = {"value": (("receiver", "y", "x"), self.values, unit)}
        if self.deviations is not None:
            variables["std"] = (("receiver", "y", "x"), self.deviations)
        names = {"receiver": ("receiver", [*self.receivers])}
        xarray = library("xarray", "to_xarray")
        return xarray.Dataset(variables, names | places | scalars)

    def save(self, path: str | Path) -> None:
        """Writes ``.npz`` with ``values_<unit>``, e.g. ``values_dbm``, and the other attributes.

        The name is ``values`` alone if the unit is not all letters.
        """
        arrays = {_key(self.unit): self.values, "x": self.x, "y": self.y, "height": self.height}
        arrays |= {"receivers": self.receivers, "quantity": self.quantity, "unit": self.unit}
        for name in ("frequency", "deviations"):
            value = getattr(self, name)
            if value is not None:
                arrays[name] = value
        # Given a name, numpy would append .npz; given a file, it writes there.
        with atomic_write(path) as part, open(part, "wb") as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> "RadioMap":
        """The inverse of ``save``; raises a ValueError for another or a damaged file."""
        try:
            with np.load(path) as file:
                unit = str(file["unit"])
                return cls(
                    values=file[_key(unit)],
                    x=file["x"],
                    y=file["y"],
                    height=float(file["height"]),
                    receivers=tuple(file["receivers"].tolist()),
                    quantity=str(file["quantity"]),
                    unit=unit,
                    frequency=float(file["frequency"]) if "frequency" in file.files else None,
                    deviations=file["deviations"] if "deviations" in file.files else None,
                )
        except FileNotFoundError:
            raise
        except Exception as error:  # numpy raises many types for a file of another format
            problem = f"{path} is damaged or not a file of RadioMap.save: {error}"
            raise ValueError(problem) from error


def _key(unit: str) -> str:
    """Name of the values in a file, such as ``values_dbm``."""
    return f"values_{unit.lower()}" if unit.isascii() and unit.isalpha() else "values"


@stages.with_progress
def radio_map(
    model,
    pitch: float | None = None,
    height: float | None = None,
    margin: float = 0.5,
    receivers: object = None,
    frequency: float | None = None,
    *,
    progress: bool = True,
) -> RadioMap:
    """Predictions on a plane over the widened box of training transmitters and all receivers.

    Args:
        model: A fitted or loaded model of a task with scalar labels, such as RSSI.
        pitch: Distance between neighbouring points [m]. Coordinates are multiples of it, so maps of
            one pitch share points. None: 0.1, or more for a side above 12.8 m; for a slow model it
            is doubled until the map takes 20 s.
        height: Height of the transmitters [m]; None: half-way between lowest and highest training
            transmitter, or the floor with most training places.
        margin: Widening of the box on each side [m].
        receivers: Names or indices, or one of them; None: all receivers.
        frequency: Carrier [Hz]; None: the training links' carrier, or the middle one of several.
        progress: False hides progress bars.

    Warns:
        ExtrapolationWarning: The frequency is outside the training links' band; or a place is
            outside the training transmitters' box by more than the diagonal of the box of
            transmitters and receivers.

    Raises:
        TypeError: The model is not a ``gaigs.Model``.
        ValueError: The model predicts something else, an option is out of range, or a receiver is
            unknown.

    Example:
        >>> model = gaigs.train("path_loss", gaigs.links("synthetic_rssi", transmitters=50))
        >>> floor = gaigs.radio_map(model, pitch=0.5, height=1.2)
        >>> floor.values.shape == (len(floor.receivers), len(floor.y), len(floor.x)), floor.unit
        (True, 'dBm')
    """
    scene = scalar_scene(model, "a radio map")
    known = [receiver.name for receiver in scene.receivers]
    chosen = np.arange(len(known))
    if receivers is not None:
        chosen = as_receivers(receivers, known).reshape(-1).numpy()
    if height is None:
        height = _usual_height(scene)
    lower, upper = _rectangle(scene, float(height), float(margin))
    for message in _doubts(scene, float(height), float(margin)):
        warnings.warn(message, ExtrapolationWarning, stacklevel=4)  # two decorators lie between
    if frequency is None:
        frequency = scene.middle_frequency
    predict = partial(_predict, model, chosen, frequency)
    if pitch is None:
        pitch = _affordable_pitch(predict, len(chosen), lower, upper, float(height))
    else:
        _check_pitch(pitch, lower, upper)
    x, y = _axes(lower, upper, float(pitch))
    heights = np.full((len(y), len(x)), float(height))
    places = np.stack((*np.meshgrid(x, y), heights), -1)  # (rows, columns, 3)
    maps = predict(places)  # (1 or 2, rows, columns, receivers)
    maps = np.ascontiguousarray(np.moveaxis(maps, -1, 1))  # (1 or 2, receivers, rows, columns)
    return RadioMap(
        values=maps[0],
        x=x,
        y=y,
        height=float(height),
        receivers=tuple(known[number] for number in chosen),
        quantity=scene.task.quantity,
        unit=scene.task.unit,
        frequency=frequency,
        deviations=maps[1] if len(maps) > 1 else None,
    )


def scalar_scene(model, owner: str) -> Scene:
    """The scene of a model with scalar labels; an error for any other object.

    ``owner`` names the model's use in the error.
    """
    if not hasattr(model, "scene"):
        raise TypeError(
            f"model must be one that gaigs.load gives, got {model!r:.200}; load the checkpoint "
            "first"
        )
    task = model.scene.task
    if not task.is_scalar:
        raise ValueError(
            f"{owner} takes a model of one real number a link, got one of task {task.name!r}, "
            f"whose labels are {tuple(task.shape)} of {task.dtype}; use model.predict"
        )
    return model.scene


def _usual_height(scene: Scene) -> float:
    """Height of transmitters for a map without a given one [m].

    If there are several floors, a line in the log names the other ones.
    """
    if len(scene.floors):
        others = ", ".join(f"{floor:.2f}" for floor in sorted(scene.floors[1:].tolist()))
        log.info(
            "radio map at z = %.2f m, the floor with most training places; others are at %s m: "
            "set height",
            scene.height,
            others,
        )
    return scene.height


def _rectangle(scene: Scene, height: float, margin: float) -> tuple[ndarray, ndarray]:
    """Lower and upper corner (2,) [m] of the training transmitters and receivers, widened."""
    if not np.isfinite(height) or not 0 <= margin < np.inf:
        raise ValueError(
            f"height must be finite and margin at least 0 [m], got height {height} and margin "
            f"{margin}"
        )
    receivers = [receiver.pose.position.numpy() for receiver in scene.receivers]
    ends = scene.lower.double().numpy(), scene.upper.double().numpy()
    corners = np.stack((*ends, *receivers))[:, :2]
    return corners.min(0) - margin, corners.max(0) + margin


def _doubts(scene: Scene, height: float, margin: float) -> list[str]:
    """Warnings for options that put transmitters far outside the training box."""
    below_or_above = max(scene.lower[2].item() - height, height - scene.upper[2].item())
    messages = []
    for name, distance, most in (
        ("height", below_or_above, scene.extent),
        ("margin", margin, 20 * scene.extent),
    ):
        if distance > most:
            messages.append(
                f"{name} puts transmitters {distance:.4g} m outside the box of the training "
                f"transmitters, which with the receivers is {scene.extent:.3g} m across; is it in "
                "m?"
            )
    return messages


def _check_pitch(pitch: float, lower: ndarray, upper: ndarray) -> None:
    """Raises a ``ValueError`` if the map would have one point or more than 1e8."""
    longest = float((upper - lower).max())
    if 0 < pitch <= longest and math.prod(((upper - lower) / pitch).tolist()) <= 1e8:
        return
    raise ValueError(
        f"pitch must be above 0, at most {longest:.3g} m, the longer side of the map, and give at "
        f"most 1e+08 points, got {pitch} m; is it in m?"
    )


def _predict(
    model,
    receivers: Int[ndarray, " k"],
    frequency: float | None,
    points: Float[ndarray, "*points 3"],
) -> Float[ndarray, "m *points k"]:
    """Values at points [m] for receivers by number, and deviations if the model has intervals.

    The first axis has the values, and then the deviations.
    """
    shape = (*points.shape[:-1], len(receivers))
    places = np.broadcast_to(points[..., None, :], (*shape, 3))  # (..., k, 3)
    index = np.broadcast_to(receivers, shape)  # (..., k)
    # An interval brings the standard deviation, whatever its level.
    has_intervals = model.calibration is not None and model.calibration.gives(0.5)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", r"\d+ of \d+ positions are up to", ExtrapolationWarning)
        # All receivers of a place are in one batch, so a model computes the place's features once.
        prediction = model.predict(
            torch.from_numpy(places.astype(np.float32)),
            torch.from_numpy(index.copy()),
            frequency=frequency,
            batch_size=128 * len(receivers),
            interval=0.5 if has_intervals else None,
        )
    parts = prediction[:2] if has_intervals else (prediction,)
    return torch.stack([part.cpu() for part in parts]).numpy()


def _affordable_pitch(
    predict: Callable[[ndarray], ndarray],
    receivers: int,
    lower: ndarray,
    upper: ndarray,
    height: float,
    seconds: float = 20.0,
    points: int = 128,
    fewest: int = 200,
    predictions: int = 150_000,
) -> float:
    """A pitch [m] with which the map takes about ``seconds``, or has at most ``fewest`` points.

    The longer side has about ``points`` points, unless the model is slow or maps of all receivers
    would need more than ``predictions``.

    Args:
        predict: Function from places (..., 3) [m] to predictions for all receivers of the map.
        receivers: Number of these receivers.
        lower, upper: Corners of the map (2,) [m].
        height: Height of the transmitters [m].
        seconds, points, fewest, predictions: Limits, as described above.
    """
    pitch = max(0.1, float((upper - lower).max()) / points)
    # Predictions along the diagonal are timed.
    line = np.linspace(lower, upper, points)
    places = np.column_stack((line, np.full(points, height)))
    # The whole map repeats the warnings.
    with warnings.catch_warnings(action="ignore", category=ExtrapolationWarning):
        predict(places[:1])  # the first prediction compiles and loads
        start = time.perf_counter()
        predict(places)
        elapsed = time.perf_counter() - start
    # Half of the time left at most: figures follow.
    most = points * min(seconds, stages.left() / 2) / elapsed
    most = min(most, predictions / receivers)
    while math.prod(map(len, _axes(lower, upper, pitch))) > max(most, fewest):
        pitch *= 2
    return pitch


def _axes(lower: ndarray, upper: ndarray, pitch: float) -> list[ndarray]:
    """Multiples of a pitch along x and along y that cover a rectangle."""
    axes = []
    for start, end in zip(lower, upper, strict=True):
        # The last multiple is beyond the end; numpy's range leaves out its own end.
        axes.append(pitch * np.arange(np.floor(start / pitch), np.floor(end / pitch) + 2))
    return axes
