"""The scene of a model: receivers with their arrays, the box of the training transmitters, the task."""

import functools
from dataclasses import dataclass, field

import torch
from jaxtyping import Complex, Float
from torch import Tensor

from gaigs.antenna import Array, Receiver
from gaigs.geometry import Pose
from gaigs.propagation import free_space
from gaigs.query import Query
from gaigs.registry import registry
from gaigs.task import Task


@dataclass(frozen=True)
class Scene:
    """The part of a data set that a checkpoint stores, so that a model loads without the data.

    Attributes:
        receivers: Antenna arrays or gateways.
        lower, upper: Corners of the box of the training transmitters, world frame (3,) [m].
        spacing: Median distance of a training transmitter to the nearest other one [m].
        task: Task of the labels.
        frequencies: Distinct carriers of the training links, ascending (f,) [Hz]; empty if unknown.
        bandwidth: Band around each carrier over which a label's power is averaged, 0 for a carrier alone [Hz]; None if
            unknown.

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
    frequencies: Float[Tensor, " f"] = field(default_factory=lambda: torch.zeros(0))
    bandwidth: float | None = None

    def positions(self, like: Tensor) -> Float[Tensor, "receivers 3"]:
        """Positions of the receivers [m], on the device and in the dtype of ``like``."""
        return torch.stack([receiver.pose.position for receiver in self.receivers]).to(like)

    @functools.cached_property
    def extent(self) -> float:
        """Diagonal of the box that holds the training transmitters and all receivers [m]."""
        ends = torch.cat((torch.stack((self.lower, self.upper)), self.positions(self.lower)))
        return (ends.amax(0) - ends.amin(0)).norm().item()

    @property
    def has_band(self) -> bool:
        """True if the training links have several carriers."""
        return len(self.frequencies) > 1

    def band_positions(self, query: Query) -> Float[Tensor, " b"]:
        """Positions of carriers in the training links' band, by the logarithm: -1 at the lowest, 1 at the highest.

        Raises:
            ValueError: The query has no frequency.
        """
        if query.frequencies is None:
            low, high = self.frequencies[0].item(), self.frequencies[-1].item()
            raise ValueError(
                f"a frequency must be given: the data have {len(self.frequencies)} carriers, {low:.6g} to {high:.6g} Hz"
            )
        low, high = self.frequencies.double().log()[[0, -1]].tolist()
        return ((2 * query.frequencies.double().log() - low - high) / (high - low)).to(query.transmitters.dtype)

    def state(self) -> dict:
        """The scene in plain tensors, lists and strings, for a checkpoint."""
        return {
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
        """The inverse of ``state``.

        Raises:
            ValueError: The task is not installed.
        """
        receivers = tuple(
            Receiver(r["name"], Pose(r["position"], r["rotation"]), Array(r["elements"], r["pattern"]))
            for r in state["receivers"]
        )
        box = state["lower"], state["upper"], state["spacing"]
        return cls(receivers, *box, registry("task").build(state["task"]), state["frequencies"], state["bandwidth"])


def carriers(scene: Scene, query: Query) -> Float[Tensor, " b"]:
    """The frequency of each link [Hz]: the query's, else the data's only one; for channels the middle of their band.

    Raises:
        ValueError: The query has no frequency, and the data have none or several.
    """
    if scene.task.dtype.is_complex:
        return scene.task.frequencies.mean().to(query.transmitters).expand(len(query))
    if query.frequencies is not None:
        return query.frequencies
    if len(scene.frequencies) != 1:
        raise ValueError(
            f"each link must have a frequency [Hz], as the data have {len(scene.frequencies)}; give the query its "
            "frequencies, or the data theirs"
        )
    return scene.frequencies.to(query.transmitters).expand(len(query))


def check_elements(what: str, scene: Scene) -> None:
    """Checks that labels are channels, with as many elements as each receiver's array.

    Args:
        what: The component that takes nothing else, as errors name it.
        scene: Task and receivers.

    Raises:
        ValueError: Labels are not channels, or an array has another number of elements.
    """
    task = scene.task
    if not task.dtype.is_complex or len(task.shape) != 2:
        raise ValueError(f"{what} gives complex channels, and labels of task {task.name!r} are none; take another")
    for receiver in scene.receivers:
        if len(receiver.array) != task.shape[0]:
            raise ValueError(
                f"the labels have {task.shape[0]} elements, and the array of {receiver.name} {len(receiver.array)}; "
                "give the data's elements"
            )


def direct_waves(
    scene: Scene, query: Query, frequencies: Float[Tensor, " s"], sign: int = -1, at_elements: bool = True
) -> Complex[Tensor, "b e s"]:
    """Free space from each transmitter to the elements of its receiver, or to its middle alone (e = 1).

    Args:
        scene: Its receivers' arrays have the same number of elements.
        query: The links.
        frequencies: [Hz].
        sign: Sign of the phases, as for ``free_space``.
        at_elements: True for each element, False for the middle of the array.
    """
    # In float64: some metres from the origin float32 would round an element's place by 1e-6 m, at 6 GHz 1e-4 rad.
    places = []
    for receiver in scene.receivers:
        pose, elements = receiver.pose.to(torch.zeros((), dtype=torch.float64)), receiver.array.elements.double().cpu()
        places.append(pose.world(elements) if at_elements else pose.position[None])
    places = torch.stack(places).to(query.transmitters.device)[query.receivers]
    distances = (query.transmitters.double()[:, None] - places).norm(dim=-1)
    return free_space(distances[..., None], frequencies.to(distances.device), sign)


def direct_gains(scene: Scene, query: Query) -> Float[Tensor, " b"]:
    """Field gain of each receiver's elements towards the transmitter, from the middle of the array; float64.

    A transmitter in the very middle has no direction; its gain is that along the array's normal.
    """
    gains = torch.ones(len(query), dtype=torch.float64, device=query.transmitters.device)
    for receiver in query.receivers.unique().tolist():
        own, antenna = query.receivers == receiver, scene.receivers[receiver]
        points = antenna.pose.to(gains).local(query.transmitters[own].double())
        lengths = points.norm(dim=-1, keepdim=True)
        gains[own] = antenna.array.gain(torch.where(lengths > 0, points / lengths, points.new_tensor([0.0, 0.0, 1.0])))
    return gains
