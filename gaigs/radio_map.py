"""What a receiver would hear from everywhere on a floor."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from numpy import ndarray

if TYPE_CHECKING:  # torch is heavy, and not needed to read a map
    from gaigs.model import Model

PITCH = 0.1
"""Distance between the points of a map [m], unless the room is large."""

BATCH = 128
"""Points predicted at a time."""

POINTS = 128
"""About how many points the longer side of a map has at most, unless a pitch is asked for."""


@dataclass(frozen=True)
class RadioMap:
    """Predicted RSSI of transmitters on a horizontal plane.

    Attributes:
        values: One map a receiver (receivers, rows, columns) [dBm]; rows along y, columns along x.
        x: One a column, world frame [m].
        y: One a row, world frame [m].
        height: Of the transmitters, world frame [m].
        receivers: Names.
    """

    values: Float[ndarray, "receivers rows columns"]
    x: Float[ndarray, "columns"]
    y: Float[ndarray, "rows"]
    height: float
    receivers: tuple[str, ...]

    def save(self, path: str | Path) -> None:
        """Writes ``.npz`` with the arrays ``values_dbm``, ``x``, ``y``, ``height`` and ``receivers``."""
        with open(path, "wb") as file:  # given a name, numpy would append .npz where it is missing
            np.savez_compressed(
                file, values_dbm=self.values, x=self.x, y=self.y, height=self.height, receivers=self.receivers
            )

    @classmethod
    def load(cls, path: str | Path) -> "RadioMap":
        """The inverse of ``save``.

        Raises:
            FileNotFoundError: There is no such file.
        """
        with np.load(path) as file:
            receivers = tuple(file["receivers"].tolist())
            return cls(file["values_dbm"], file["x"], file["y"], float(file["height"]), receivers)


def radio_map(
    model: "Model",
    pitch: float | None = None,
    height: float | None = None,
    margin: float = 0.5,
    receivers: Sequence[str] | str | None = None,
) -> RadioMap:
    """Predicts RSSI on a plane over the box that holds the training transmitters and all receivers, widened.

    Args:
        model: Of a scene whose labels are RSSI, fitted or loaded.
        pitch: Distance between neighbouring points [m]; the points are its multiples, so maps of one pitch share them.
            None takes ``PITCH``, or as much more as keeps the longer side at about ``POINTS`` points.
        height: Of the transmitters, world frame [m]; None is half-way between the lowest and the highest of training.
        margin: By which the box is widened on each side [m].
        receivers: Names, or one name; None is all of them.

    Raises:
        ValueError: The model predicts spectra, an option is out of range, or there is no such receiver.
    """
    scene = model.scene
    if scene.grid is not None:
        raise ValueError("a radio map takes a model of RSSI, got one of spectra; use model.predict for its spectra")
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
    if pitch is None:
        pitch = max(PITCH, float((upper - lower).max()) / POINTS)
    x, y = (pitch * np.arange(np.floor(a / pitch), np.floor(b / pitch) + 2) for a, b in zip(lower, upper, strict=True))
    points = np.stack((*np.meshgrid(x, y), np.full((len(y), len(x)), height)), -1)[..., None, :]
    points = np.broadcast_to(points, (len(y), len(x), len(names), 3)).astype(np.float32)
    # All receivers of a point in one batch, so that what a transmitter there excites is computed once.
    index = np.broadcast_to([known.index(name) for name in names], points.shape[:-1]).copy()
    values = model.predict(points, index, batch_size=BATCH * len(names)).cpu().numpy()
    return RadioMap(np.ascontiguousarray(np.moveaxis(values, -1, 0)), x, y, height, names)
