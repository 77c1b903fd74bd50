"""Radio maps: predictions of one real number, e.g. RSSI, for transmitters anywhere on a floor."""

import logging
import math
import time
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray

from gaigs.core import stages
from gaigs.core.geometry import ExtrapolationWarning
from gaigs.core.query import as_receivers
from gaigs.io.files import atomic_write

log = logging.getLogger(__name__)

POINTS = 128
"""Approximate limit of points along the longer side of a map of no given pitch; points predicted at
a time.
"""

SECONDS, FEWEST = 60.0, 200
"""Approximate limit of the time of a map of no given pitch, unless it has fewer points than these.
"""


@dataclass(frozen=True, repr=False)
class RadioMap:
    """Predictions of one real number a link, e.g. RSSI, for transmitters on a horizontal plane.

    Attributes:
        values: One map a receiver (receivers, rows, columns) [unit]; rows along y, columns along x.
        x: One a column, world frame [m].
        y: One a row, world frame [m].
        height: Of the transmitters, world frame [m].
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
        name, corners = (
            f"{self.quantity} [{self.unit}]" if self.unit else self.quantity,
            (self.x, self.y),
        )
        spans = " and ".join(
            f"{axis} {p[0]:.2f} to {p[-1]:.2f}" for axis, p in zip("xy", corners, strict=True)
        )
        return (
            f"<radio map of {name}: "
            f"{', '.join(self.receivers[:5])}{', ...' * (len(self.receivers) > 5)}; "
            f"{rows} x {columns} points, {spans}, z {self.height:.2f} m>"
        )

    def only(self, index: Int[ndarray, " k"]) -> "RadioMap":
        """The maps of some receivers."""
        deviations = None if self.deviations is None else self.deviations[index]
        names = tuple(self.receivers[number] for number in index)
        return replace(self, values=self.values[index], receivers=names, deviations=deviations)

    def save(self, path: str | Path) -> None:
        """Writes ``.npz`` with ``values_<unit>``, e.g. ``values_dbm``, and all other attributes
        that are known.

        The values are ``values`` if the unit has other signs than letters.
        """
        arrays = {_key(self.unit): self.values, "x": self.x, "y": self.y, "height": self.height}
        arrays |= {"receivers": self.receivers, "quantity": self.quantity, "unit": self.unit}
        arrays |= {
            name: getattr(self, name)
            for name in ("frequency", "deviations")
            if getattr(self, name) is not None
        }
        with (
            atomic_write(path) as part,
            open(part, "wb") as file,
        ):  # given a name, numpy would append .npz
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> "RadioMap":
        """The inverse of ``save``; raises a ValueError for another or a damaged file."""
        try:
            with np.load(path) as file:
                quantity, unit = str(file["quantity"]), str(file["unit"])
                frequency = float(file["frequency"]) if "frequency" in file.files else None
                axes = (
                    file["x"],
                    file["y"],
                    float(file["height"]),
                    tuple(file["receivers"].tolist()),
                )
                deviations = file["deviations"] if "deviations" in file.files else None
                return cls(file[_key(unit)], *axes, quantity, unit, frequency, deviations)
        except FileNotFoundError:
            raise
        except Exception as error:  # numpy raises many types for a file of another format
            raise ValueError(
                f"{path} is damaged or not a file of RadioMap.save: {error}"
            ) from error


def _key(unit: str) -> str:
    return f"values_{unit.lower()}" if unit.isascii() and unit.isalpha() else "values"


def radio_map(
    model,
    pitch: float | None = None,
    height: float | None = None,
    margin: float = 0.5,
    receivers: object = None,
    frequency: float | None = None,
) -> RadioMap:
    """Predictions on a horizontal plane over the box of training transmitters and all receivers,
    widened.

    Args:
        model: A fitted or loaded model of a task whose label is one real number, e.g. RSSI.
        pitch: Distance between neighbouring points [m]. The points are its multiples, so maps of
            one pitch share them. None: 0.1, more in a room with a side above 12.8 m; doubled until
            the map of a slow model takes a minute.
        height: Height of the transmitters [m]; None: half-way between the lowest and the highest of
            training, and of several floors that with most training places.
        margin: Widening of the box on each side [m].
        receivers: Names or indices, or one of them; None: all receivers.
        frequency: Carrier [Hz]; None: that of the training links, of several the middle one.

    Warns:
        ExtrapolationWarning: The frequency is outside the training links' band, or height or margin
            go farther from the training transmitters' box than the diagonal of this box and the
            receivers.

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
    if not hasattr(model, "scene"):
        raise TypeError(
            f"model must be one that gaigs.load gives, got {model!r:.200}; load the checkpoint "
            "first"
        )
    scene = model.scene
    if not scene.task.is_scalar:
        raise ValueError(
            "a radio map takes a model of one real number a link, got one of task "
            f"{scene.task.name!r}, whose labels "
            f"are {tuple(scene.task.shape)} of {scene.task.dtype}; use model.predict"
        )
    known = [receiver.name for receiver in scene.receivers]
    heard = (
        np.arange(len(known))
        if receivers is None
        else as_receivers(receivers, known).reshape(-1).numpy()
    )
    names = tuple(known[number] for number in heard)
    lower, upper = scene.lower.double().numpy(), scene.upper.double().numpy()
    pitch, margin = None if pitch is None else float(pitch), float(margin)
    if height is None and len(scene.floors):
        others = ", ".join(f"{floor:.2f}" for floor in sorted(scene.floors[1:].tolist()))
        words = (
            "radio map at z = %.2f m, the floor with most training places; others are at %s m: set "
            "height"
        )
        log.info(words, scene.height, others)
    height = scene.height if height is None else float(height)
    if not np.isfinite(height) or not 0 <= margin < np.inf:
        raise ValueError(
            f"height must be finite and margin at least 0 [m], got height {height} and margin "
            f"{margin}"
        )
    corners = np.stack(
        (lower, upper, *(receiver.pose.position.numpy() for receiver in scene.receivers))
    )[:, :2]
    lower, upper = corners.min(0) - margin, corners.max(0) + margin
    longest = float((upper - lower).max())
    away = max(scene.lower[2].item() - height, height - scene.upper[2].item())
    for name, size, most in (("height", away, scene.extent), ("margin", margin, 20 * scene.extent)):
        if size > most:
            message = (
                f"{name} puts transmitters {size:.4g} m outside the box of the training "
                "transmitters, which with "
            )
            message += f"the receivers is {scene.extent:.3g} m across; is it in m?"
            warnings.warn(
                message, ExtrapolationWarning, stacklevel=3
            )  # behind the decorator of its public name
    if pitch is not None and not (
        0 < pitch <= longest and math.prod(((upper - lower) / pitch).tolist()) <= 1e8
    ):
        raise ValueError(
            f"pitch must be above 0, at most {longest:.3g} m, the longer side of the map, and give "
            "at most 1e+08 "
            f"points, got {pitch} m; is it in m?"
        )
    # All receivers of a point in one batch, so that a transmitter's excitation is computed once.
    frequency = scene.middle_frequency if frequency is None else frequency

    level = 0.5 if model.calibration is not None and model.calibration.gives(0.5) else None

    def predict(points: ndarray) -> ndarray:
        shape = (*points.shape[:-1], len(names))
        links = torch.from_numpy(
            np.broadcast_to(points[..., None, :], (*shape, 3)).astype(np.float32)
        )
        index = torch.from_numpy(np.broadcast_to(heard, shape).copy())
        with warnings.catch_warnings():
            warnings.filterwarnings(
                "ignore", r"\d+ of \d+ positions are up to", ExtrapolationWarning
            )
            found = model.predict(
                links, index, frequency=frequency, batch_size=POINTS * len(names), interval=level
            )
            return torch.stack([part.cpu() for part in (found[:2] if level else (found,))]).numpy()

    if pitch is None:
        pitch = max(0.1, longest / POINTS)
        some = np.column_stack((np.linspace(lower, upper, POINTS), np.full(POINTS, height)))
        with warnings.catch_warnings(
            action="ignore", category=ExtrapolationWarning
        ):  # the whole map says it again
            predict(some[:1])  # the first prediction compiles and loads
            start = time.perf_counter()
            predict(some)
        # Points in a minute, or in half of the time left: figures follow.
        most = POINTS * min(SECONDS, stages.left() / 2) / (time.perf_counter() - start)
        while math.prod(map(len, _axes(lower, upper, pitch))) > max(most, FEWEST):
            pitch *= 2
    x, y = _axes(lower, upper, pitch)
    values = predict(np.stack((*np.meshgrid(x, y), np.full((len(y), len(x)), height)), -1))
    values, *deviations = (np.ascontiguousarray(np.moveaxis(part, -1, 0)) for part in values)
    return RadioMap(
        values, x, y, height, names, scene.task.quantity, scene.task.unit, frequency, *deviations
    )


def _axes(lower: ndarray, upper: ndarray, pitch: float) -> list[ndarray]:
    """Multiples of a pitch along x and along y, over a rectangle and as far as the next one beyond
    it.
    """
    return [
        pitch * np.arange(np.floor(a / pitch), np.floor(b / pitch) + 2)
        for a, b in zip(lower, upper, strict=True)
    ]
