"""What a model must know of a data set to be built: receivers with their arrays, the box of places, the task."""

import functools
import math
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from gaigs.geometry import Pose
from gaigs.query import Query
from gaigs.registry import registry
from gaigs.task import Task

VERSION = 1
"""Of the format of ``Scene.state``. Version 0, which had no number, is read too: see ``Scene.from_state``."""

PATTERNS = ("isotropic", "cosine")
"""Field patterns of an element: alike in all directions, or the cosine of the angle off the array's normal and 0 behind
it, as of a patch."""


def differences(places: Float[Tensor, "e 3"]) -> tuple[Float[Tensor, "l 3"], Int[Tensor, "pairs"]]:
    """The different vectors from one place to another, to nine decimals, and which of them each pair of places has."""
    apart = (places[:, None] - places).flatten(0, 1).round(decimals=9)
    return torch.unique(apart, dim=0, return_inverse=True)


@dataclass(frozen=True)
class Array:
    """A receiver's antenna: one element or several, fed apart.

    Attributes:
        elements: Positions in the array's own frame (e, 3) [m].
        pattern: Field pattern of each element, one of ``PATTERNS``.

    Raises:
        ValueError: There is no such pattern, or the elements are not (e, 3).

    Example:
        >>> len(gaigs.Array.planar(4, 4, pitch=0.16)), len(gaigs.Array.single())
        (16, 1)
    """

    elements: Float[Tensor, "e 3"]
    pattern: str = "isotropic"

    def __post_init__(self) -> None:
        if self.pattern not in PATTERNS:
            raise ValueError(f"an array's pattern must be one of {', '.join(PATTERNS)}, got {self.pattern!r}")
        if self.elements.ndim != 2 or self.elements.shape[1] != 3 or not len(self.elements):
            raise ValueError(f"an array's elements must be (e, 3) positions [m], got {tuple(self.elements.shape)}")

    @classmethod
    def single(cls) -> "Array":
        """One isotropic antenna."""
        return cls(torch.zeros(1, 3))

    @classmethod
    def planar(cls, rows: int, columns: int, pitch: float, pattern: str = "isotropic") -> "Array":
        """Elements in the array's x-y plane about its middle, column by column: y runs fastest.

        Args:
            rows: Elements along y.
            columns: Elements along x.
            pitch: Between neighbouring elements [m].
            pattern: One of ``PATTERNS``.

        Raises:
            ValueError: There is no element, or the pitch is not positive and finite.
        """
        if rows < 1 or columns < 1 or not 0 < pitch < math.inf:
            raise ValueError(
                f"an array must have at least 1 x 1 elements at a positive pitch, got {rows} x {columns} at {pitch} m"
            )
        steps = lambda count: (torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * pitch
        x, y = torch.meshgrid(steps(columns), steps(rows), indexing="ij")
        return cls(torch.stack((x, y, 0 * x), -1).flatten(0, 1), pattern)

    def __len__(self) -> int:
        return len(self.elements)

    @functools.cached_property
    def lags(self) -> tuple[Float[Tensor, "l 3"], Int[Tensor, "pairs"], Float[Tensor, "l"]]:
        """The different vectors from one element to another [m], which of them each pair of elements has, and how many
        pairs have each; float64.

        What powers alone say of a field, its covariance, an array hears by these only: 49 for a 4 x 4 array.
        """
        # Kept beyond this call: made in inference mode they could not be saved for a later backward pass.
        with torch.inference_mode(False):
            steps, pairs = differences(self.elements.clone().double())
            return steps, pairs, torch.bincount(pairs).double()

    def gain(self, directions: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Field gain of an element towards unit vectors in the array's frame."""
        if self.pattern == "cosine":
            return directions[..., 2].clamp(min=0)
        return torch.ones_like(directions[..., 2])


@dataclass(frozen=True)
class Receiver:
    """An antenna array or gateway.

    Attributes:
        name: In files and tables.
        pose: Position [m] and orientation in the room.
        array: Its elements; one isotropic antenna by default.

    Example:
        >>> pose = gaigs.Pose.from_xyzw([1.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0])
        >>> len(gaigs.Receiver("door", pose, gaigs.Array.planar(4, 4, pitch=0.16)).array)
        16
    """

    name: str
    pose: Pose
    array: Array = field(default_factory=Array.single)


@dataclass(frozen=True)
class Scene:
    """What a checkpoint stores of a data set, so that a model loads without the data.

    Attributes:
        receivers: Who hears.
        lower, upper: Corners of the box that holds the training transmitters, world frame (3,) [m].
        spacing: Median distance from a training transmitter to the next one elsewhere [m].
        task: What the labels are.
        frequencies: The training links' different carriers, ascending (f,) [Hz]; empty where they are unknown.
        bandwidth: Of the band around each carrier that a label's power is averaged over, 0 for a carrier alone [Hz];
            None where it is unknown.

    Example:
        >>> scene = gaigs.links("synthetic_rssi", transmitters=50).scene
        >>> [receiver.name for receiver in scene.receivers], scene.task.name
        (['west', 'south', 'east', 'north'], 'rssi')
    """

    receivers: tuple[Receiver, ...]
    lower: Float[Tensor, "3"]
    upper: Float[Tensor, "3"]
    spacing: float
    task: Task
    frequencies: Float[Tensor, "f"] = field(default_factory=lambda: torch.zeros(0))
    bandwidth: float | None = None

    def positions(self, like: Tensor) -> Float[Tensor, "receivers 3"]:
        """Where the receivers stand [m], on the device and in the dtype of ``like``."""
        return torch.stack([receiver.pose.position for receiver in self.receivers]).to(like)

    @functools.cached_property
    def extent(self) -> float:
        """Diagonal of the box that holds the training transmitters and all receivers [m]."""
        ends = torch.cat((torch.stack((self.lower, self.upper)), self.positions(self.lower)))
        return (ends.amax(0) - ends.amin(0)).norm().item()

    @property
    def has_band(self) -> bool:
        """Whether the training links have several carriers, so that the frequency tells something."""
        return len(self.frequencies) > 1

    def band_positions(self, query: Query) -> Float[Tensor, "b"]:
        """Where in the training links' band each carrier lies, by its logarithm: -1 at the lowest, 1 at the highest.

        Raises:
            ValueError: The query says no frequency.
        """
        if query.frequencies is None:
            low, high = self.frequencies[0].item(), self.frequencies[-1].item()
            raise ValueError(
                f"the data have {len(self.frequencies)} carriers, {low:.6g} to {high:.6g} Hz, so a frequency must be "
                "given"
            )
        low, high = self.frequencies.double().log()[[0, -1]].tolist()
        return ((2 * query.frequencies.double().log() - low - high) / (high - low)).to(query.transmitters.dtype)

    def state(self) -> dict:
        """The scene in plain tensors, lists and strings, for a checkpoint."""
        return {
            "version": VERSION,
            "receivers": [
                {
                    "name": receiver.name,
                    "position": receiver.pose.position,
                    "rotation": receiver.pose.rotation,
                    "elements": receiver.array.elements,
                    "pattern": receiver.array.pattern,
                }
                for receiver in self.receivers
            ],
            "lower": self.lower,
            "upper": self.upper,
            "spacing": self.spacing,
            "task": self.task.state(),
            "frequencies": self.frequencies,
            "bandwidth": self.bandwidth,
        }

    @classmethod
    def from_state(cls, state: dict) -> "Scene":
        """The inverse of ``state``; takes the states of earlier versions too.

        Raises:
            ValueError: The state is of a later version, or its task is not installed here.
        """
        version = state.get("version", 0)
        if version > VERSION:
            raise ValueError(f"a scene must be of version {VERSION} or earlier, got {version}; update gaigs")
        if version == 0:
            state = _from_version_0(state)
        receivers = tuple(
            Receiver(r["name"], Pose(r["position"], r["rotation"]), Array(r["elements"], r["pattern"]))
            for r in state["receivers"]
        )
        box = state["lower"], state["upper"], state["spacing"]
        return cls(receivers, *box, registry("task").build(state["task"]), state["frequencies"], state.get("bandwidth"))


def _from_version_0(state: dict) -> dict:
    """Receivers were [name, position, rotation]; the labels were spectra where there was a grid, else RSSI."""
    single = Array.single()
    receivers = [
        {"name": name, "position": position, "rotation": rotation}
        | {"elements": single.elements, "pattern": single.pattern}
        for name, position, rotation in state["receivers"]
    ]
    task = {"name": "rssi"}
    if state["grid"] is not None:
        elevations, azimuths = state["grid"]
        task = {"name": "spectrum", "elevations": elevations, "azimuths": azimuths}
        task["normalisation"] = state["normalisation"]
    return state | {"receivers": receivers, "task": task, "frequencies": torch.zeros(0)}
