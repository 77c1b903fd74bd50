"""What a receiver would report of a transmitter anywhere on a floor."""

import math
import time
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gaigs.geometry import ExtrapolationWarning
from gaigs.io.files import atomic_write
from gaigs.registry import check_type

PITCH = 0.1
"""Distance between the points of a map [m], unless the room is large."""

BATCH = 128
"""Points predicted at a time."""

POINTS = 128
"""About how many points the longer side of a map has at most, unless a pitch is asked for."""

SECONDS = 60.0
"""About how long a map takes at most, unless a pitch is asked for."""

MOST = 10**8
"""Points that a map has whatever pitch is asked for: more fill the memory."""

FEWEST = 200
"""Points that a map has however slow the model is."""


@dataclass(frozen=True)
class RadioMap:
    """What is predicted of transmitters on a horizontal plane: one real number, e.g. their RSSI.

    Attributes:
        values: One map a receiver (receivers, rows, columns) [unit]; rows along y, columns along x.
        x: One a column, world frame [m].
        y: One a row, world frame [m].
        height: Of the transmitters, world frame [m].
        receivers: Names.
        quantity: What a value is.
        unit: Of a value; empty for a ratio.
        frequency: Of the carrier [Hz]; None where it is unknown.
    """

    values: Float[ndarray, "receivers rows columns"]
    x: Float[ndarray, "columns"]
    y: Float[ndarray, "rows"]
    height: float
    receivers: tuple[str, ...]
    quantity: str = "RSSI"
    unit: str = "dBm"
    frequency: float | None = None

    def save(self, path: str | Path) -> None:
        """Writes ``.npz`` with ``values_<unit>``, ``x``, ``y``, ``height``, ``receivers``, ``quantity`` and ``unit``.

        ``values_<unit>`` has the unit in lower case, e.g. ``values_dbm``; it is ``values`` where the unit is not of
        plain letters alone. ``frequency`` [Hz] is there where it is known.

        Raises:
            OSError: It cannot be written, e.g. as the disk is full; what was there before stands.
        """
        arrays = {_key(self.unit): self.values, "x": self.x, "y": self.y, "height": self.height}
        arrays |= {"receivers": self.receivers, "quantity": self.quantity, "unit": self.unit}
        if self.frequency is not None:
            arrays["frequency"] = self.frequency
        with (
            atomic_write(path) as part,
            open(part, "wb") as file,
        ):  # given a name, numpy would append .npz where it is missing
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: str | Path) -> "RadioMap":
        """The inverse of ``save``; takes files of RSSI that say neither quantity nor unit too.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It holds something else, or is damaged.
        """
        try:
            with np.load(path) as file:
                words = {name: str(file[name]) for name in ("quantity", "unit") if name in file.files}
                values = file[_key(words.get("unit", cls.unit))]
                frequency = float(file["frequency"]) if "frequency" in file.files else None
                place = file["x"], file["y"], float(file["height"])
                return cls(values, *place, tuple(file["receivers"].tolist()), **words, frequency=frequency)
        except FileNotFoundError:
            raise
        except Exception as error:  # whatever numpy meets in another file
            raise ValueError(
                f"{path} must be a file of RadioMap.save, and is damaged or another one ({error}); make the map anew"
            ) from error


def _key(unit: str) -> str:
    return f"values_{unit.lower()}" if unit.isascii() and unit.isalpha() else "values"


def radio_map(
    model,
    pitch: float | None = None,
    height: float | None = None,
    margin: float = 0.5,
    receivers: Sequence[str] | str | None = None,
    frequency: float | None = None,
) -> RadioMap:
    """Predicts on a plane over the box that holds the training transmitters and all receivers, widened.

    Args:
        model: A ``gaigs.model.Model`` of a task whose label is one real number, e.g. RSSI; fitted or loaded.
        pitch: Distance between neighbouring points [m]; the points are its multiples, so maps of one pitch share them.
            None takes ``PITCH``, or as much more as keeps the longer side at about ``POINTS`` points; doubled until a
            slow model takes about ``SECONDS`` at most.
        height: Of the transmitters, world frame [m]; None is half-way between the lowest and the highest of training.
        margin: By which the box is widened on each side [m].
        receivers: Names, or one name; None is all of them.
        frequency: Of the carrier [Hz]; None is that of the training links, of several the middle one.

    Warns:
        ExtrapolationWarning: The frequency is outside the training links' band.

    Raises:
        TypeError: The model is none, or an option is not of its type.
        ValueError: The model predicts something else, an option is out of range, or there is no such receiver.

    Example:
        >>> model = gaigs.train("path_loss", gaigs.links("synthetic_rssi", transmitters=50))
        >>> floor = gaigs.radio_map(model, pitch=0.5, height=1.2)
        >>> floor.values.shape == (len(floor.receivers), len(floor.y), len(floor.x)), floor.unit
        (True, 'dBm')
    """
    if not hasattr(model, "scene"):
        raise TypeError(f"model must be one that gaigs.load gives, got {model!r:.200}; load the checkpoint first")
    # Arrays without an axis are numbers, too.
    pitch, height, margin = (v.item() if getattr(v, "ndim", None) == 0 else v for v in (pitch, height, margin))
    for name, value, kind in (
        ("pitch", pitch, float | None),
        ("height", height, float | None),
        ("margin", margin, float),
    ):
        if not isinstance(value, float):  # whose range is looked at below
            check_type(name, value, kind)
    if isinstance(receivers, Iterable) and not isinstance(receivers, str):
        receivers = list(receivers)
    check_type("receivers", receivers, Sequence[str] | str | None)
    scene = model.scene
    if scene.task.shape != () or scene.task.dtype.is_complex:
        raise ValueError(
            f"a radio map takes a model of one real number a link, got one of task {scene.task.name!r}, whose labels "
            f"are {tuple(scene.task.shape)} of {scene.task.dtype}; use model.predict"
        )
    known = [receiver.name for receiver in scene.receivers]
    names = tuple(known if receivers is None else [receivers] if isinstance(receivers, str) else receivers)
    if unknown := [name for name in names if name not in known]:
        raise ValueError(f"receivers must be among {', '.join(known)}, got {', '.join(map(repr, unknown))}")
    lower, upper = scene.lower.double().numpy(), scene.upper.double().numpy()
    height = float(lower[2] + upper[2]) / 2 if height is None else float(height)
    if not names or not np.isfinite(height) or not 0 <= margin < np.inf or not (pitch is None or 0 < pitch < np.inf):
        raise ValueError(
            "a radio map takes a pitch above 0, a margin of at least 0, a finite height and at least one receiver, got "
            f"pitch {pitch}, margin {margin}, height {height} and receivers {list(names)}"
        )
    corners = np.stack((lower, upper, *(receiver.pose.position.numpy() for receiver in scene.receivers)))[:, :2]
    lower, upper = corners.min(0) - margin, corners.max(0) + margin
    # All receivers of a point in one batch, so that what a transmitter there excites is computed once.
    heard = np.array([known.index(name) for name in names])
    if frequency is None and len(scene.frequencies):
        frequency = float(scene.frequencies[len(scene.frequencies) // 2])

    def predict(points: ndarray) -> ndarray:
        shape = (*points.shape[:-1], len(names))
        links = np.broadcast_to(points[..., None, :], (*shape, 3)).astype(np.float32)
        index = np.broadcast_to(heard, shape).copy()
        with warnings.catch_warnings():
            # The margin is asked for.
            warnings.filterwarnings("ignore", r"\d+ of \d+ positions are up to", ExtrapolationWarning)
            return model.predict(links, index, frequency=frequency, batch_size=BATCH * len(names)).cpu().numpy()

    if pitch is None:
        pitch = max(PITCH, float((upper - lower).max()) / POINTS)
        some = np.column_stack((np.linspace(lower, upper, BATCH), np.full(BATCH, height)))
        with warnings.catch_warnings(action="ignore", category=ExtrapolationWarning):  # the whole map says it again
            predict(some[:1])  # what is compiled or loaded at the first prediction is no part of its time
            start = time.perf_counter()
            predict(some)
        most = BATCH * SECONDS / (time.perf_counter() - start)  # points
        while math.prod(map(len, _axes(lower, upper, pitch))) > max(most, FEWEST):
            pitch *= 2
    if math.prod(((upper - lower) / pitch).tolist()) > MOST:
        raise ValueError(f"a radio map takes a pitch of at most {MOST:.0e} points, got {pitch} m; take a larger one")
    x, y = _axes(lower, upper, pitch)
    values = predict(np.stack((*np.meshgrid(x, y), np.full((len(y), len(x)), height)), -1))
    values = np.ascontiguousarray(np.moveaxis(values, -1, 0))
    return RadioMap(values, x, y, height, names, scene.task.quantity, scene.task.unit, frequency)


def _axes(lower: ndarray, upper: ndarray, pitch: float) -> list[ndarray]:
    """Multiples of a pitch along x and along y, over a rectangle and as far as the next one beyond it."""
    return [pitch * np.arange(np.floor(a / pitch), np.floor(b / pitch) + 2) for a, b in zip(lower, upper, strict=True)]
