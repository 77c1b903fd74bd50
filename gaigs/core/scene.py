"""The scene of a model: receivers, the box of training transmitters, and the task."""

import functools
import logging
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Complex, Float, Int
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from gaigs.core.antenna import Array, Receiver, lacking
from gaigs.core.geometry import Frame, Pose
from gaigs.core.propagation import free_space
from gaigs.core.query import Query
from gaigs.core.task import Task
from gaigs.registry import registry

log = logging.getLogger(__name__)


class FlatAxis(NamedTuple):
    """A world axis on which all transmitters share a coordinate, and all receivers share one.

    A plane across it at the coordinate h reflects paths of the same lengths as a plane at
    transmitters + receivers - h, so labels cannot distinguish the two.
    """

    axis: int  # 0 to 2
    transmitters: float  # their coordinate [m]
    receivers: float  # their coordinate [m]
    is_common: bool  # True if both coordinates are the same

    def __str__(self) -> str:
        name = ("x", "y", "height")[self.axis]
        if self.is_common:
            return f"{name} not seen: all places at {self.transmitters:.2f} m"
        total = self.transmitters + self.receivers
        return (
            f"{name} seen from either side: places at {self.transmitters:.2f} m, receivers at "
            f"{self.receivers:.2f} m; a plane across it at h may stand at {total:.2f} m - h"
        )


@dataclass(frozen=True)
class Scene:
    """The part of a data set that a checkpoint stores, so that a model loads without the data.

    Attributes:
        receivers: Antenna arrays or gateways.
        lower, upper: Corners of the box of the training transmitters, world frame (3,) [m].
        spacing: Median distance of a training transmitter to the nearest other one [m].
        frequencies: Distinct carriers of the training links, ascending (f,) [Hz]; empty if unknown.
        bandwidth: Band around each carrier over which a label's power is averaged [Hz]. 0: a single
            carrier; None: unknown.
        frame: Place of the world frame on a map; None if unknown.
        places: Number of training places; 0 if unknown.
        floors: Heights of separate floors of training transmitters, the floor with most places
            first (k,) [m]; empty for one floor.
        responses: Response of each receiver's front end, which multiplies channels; None for a
            receiver without a learnt one.
        room: Corners of the box of training transmitters and training receivers (2, 3) [m]; None
            if ``receivers`` are those of the training.
        one_radio: True if the receivers are places of one moving radio, or identical radios. All
            have the same gain, and a model learns from all their links together.

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
    frequencies: Float[Tensor, " f"] = field(
        default_factory=lambda: torch.zeros(0, dtype=torch.float32)
    )
    bandwidth: float | None = None
    frame: Frame | None = None
    floors: Float[Tensor, " k"] = field(default_factory=lambda: torch.zeros(0, dtype=torch.float32))
    places: int = 0
    responses: Complex[Tensor, "receivers e s"] | None = None
    room: Float[Tensor, "2 3"] | None = None
    one_radio: bool = False

    def positions(self, like: Tensor) -> Float[Tensor, "receivers 3"]:
        """Positions of the receivers [m], on the device and in the dtype of ``like``."""
        return self._positions.to(like)

    @functools.cached_property
    def _positions(self) -> Float[Tensor, "receivers 3"]:
        # A cached tensor of inference mode could not be saved for a backward pass.
        with torch.inference_mode(False):
            return torch.stack([receiver.pose.position.clone() for receiver in self.receivers])

    @property
    def radios(self) -> int:
        """Number of different radios among the receivers."""
        return 1 if self.one_radio else len(self.receivers)

    def radio_of(self, receivers: Int[Tensor, " b"]) -> Int[Tensor, " b"]:
        """Number of each receiver's radio; models store what they learn of receivers by radio."""
        return torch.zeros_like(receivers) if self.one_radio else receivers

    def by_radio(self, query: Query) -> Query:
        """The links with the number of the radio in place of the receiver."""
        return replace(query, receivers=self.radio_of(query.receivers))

    @property
    def box(self) -> tuple[Float[Tensor, "3"], Float[Tensor, "3"]]:
        """Lower and upper corner of the box of training transmitters and all receivers [m]."""
        if self.room is not None:
            return self.room[0], self.room[1]
        ends = torch.cat((torch.stack((self.lower, self.upper)), self.positions(self.lower)))
        return ends.amin(0), ends.amax(0)

    @functools.cached_property
    def extent(self) -> float:
        """Diagonal of ``box`` [m]."""
        lower, upper = self.box
        return (upper - lower).norm().item()

    @functools.cached_property
    def flat_axes(self) -> list[FlatAxis]:
        """World axes along which training transmitters and elements vary by under 1 cm each."""
        elements = []
        for receiver in self.receivers:
            pose = receiver.pose.to(self.lower)
            elements.append(pose.world(receiver.array.elements.to(self.lower)))
        transmitters = torch.stack((self.lower, self.upper))
        receivers = torch.cat(elements)
        least = 0.01  # [m]; tripods are set up no better
        axes = []
        for axis in range(3):
            sent = transmitters[:, axis]
            received = receivers[:, axis]
            if sent.max() - sent.min() < least and received.max() - received.min() < least:
                middles = sent.mean().item(), received.mean().item()
                axes.append(FlatAxis(axis, *middles, abs(middles[0] - middles[1]) < least))
        return axes

    @property
    def height(self) -> float:
        """Height of the floor with most training places; of a single floor the middle [m]."""
        if len(self.floors):
            return float(self.floors[0])
        return float((self.lower[2].double() + self.upper[2].double()) / 2)

    @property
    def middle_frequency(self) -> float | None:
        """The middle carrier of the training links [Hz]; None if carriers are unknown."""
        if not len(self.frequencies):
            return None
        return float(self.frequencies[len(self.frequencies) // 2])

    @property
    def middles(self) -> Float[Tensor, " r"]:
        """Mean frequency of the subcarriers in each receiver's band [Hz]."""
        frequencies = self.task.frequencies
        bands = [frequencies[receiver.hears(frequencies)] for receiver in self.receivers]
        return torch.stack([(band if len(band) else frequencies).mean() for band in bands])

    @property
    def has_band(self) -> bool:
        """True if the training links have several carriers."""
        return len(self.frequencies) > 1

    def band_positions(self, query: Query) -> Float[Tensor, " b"]:
        """Logarithms of carriers, scaled from -1 to 1 over the training links' band."""
        if query.frequencies is None:
            raise ValueError(
                f"a frequency must be given, as the data have {len(self.frequencies)} carriers"
            )
        low, high = self.frequencies.double().log()[[0, -1]].tolist()
        positions = (2 * query.frequencies.double().log() - low - high) / (high - low)
        return positions.to(query.transmitters.dtype)

    def at_frequencies(self, frequencies: Float[Tensor, " s"]) -> "Scene":
        """The scene of channels at other subcarriers [Hz], with interpolated responses."""
        responses = self.responses
        if responses is not None:
            known = self.task.frequencies.double().numpy()
            order = np.argsort(known)  # np.interp needs ascending frequencies
            asked = frequencies.double().numpy()
            rows = responses.flatten(0, 1).numpy()[:, order]  # (receivers x e, s)
            interpolated = [np.interp(asked, known[order], row) for row in rows]
            responses = torch.tensor(np.array(interpolated)).to(responses)
            responses = responses.unflatten(0, self.responses.shape[:2])  # (receivers, e, s)
        return replace(self, task=self.task.at_frequencies(frequencies), responses=responses)

    def received(
        self, query: Query, channels: Complex[Tensor, "b e s"]
    ) -> Complex[Tensor, "b e s"]:
        """Channels after the receivers' front ends: multiplied by their responses."""
        if self.responses is None:
            return channels
        return channels * self.responses.to(channels)[query.receivers]

    def equalised(
        self, query: Query, channels: Complex[Tensor, "b e s"]
    ) -> Complex[Tensor, "b e s"]:
        """Measured channels without the receivers' front ends; inverse of ``received``."""
        if self.responses is None:
            return channels
        return channels / self.responses.to(channels)[query.receivers]

    def state(self) -> dict:
        """The scene in plain tensors, lists and strings, for a checkpoint."""
        receivers = []
        for receiver in self.receivers:
            entry = {
                "name": receiver.name,
                "position": receiver.pose.position,
                "rotation": receiver.pose.rotation,
                "elements": receiver.array.elements,
                "pattern": receiver.array.pattern,
            }
            # Only if it is not the default, so that runs from before receivers had bands can go on:
            # their scenes must be equal.
            if receiver.band != Receiver.band:
                entry["band"] = receiver.band
            receivers.append(entry)
        state = {"receivers": receivers, "task": self.task.state()}
        for name in ("lower", "upper", "spacing", "frequencies", "bandwidth", "floors", "places"):
            state[name] = getattr(self, name)
        if self.responses is not None:
            state["responses"] = self.responses
        if self.room is not None:
            state["room"] = self.room
        if self.one_radio:
            state["one_radio"] = True
        state["frame"] = None
        if self.frame is not None:
            state["frame"] = int(self.frame.epsg), float(self.frame.x), float(self.frame.y)
        return state

    @classmethod
    def from_state(cls, state: dict) -> "Scene":
        """The inverse of ``state``."""
        receivers = []
        for entry in state["receivers"]:
            pose = Pose(entry["position"], entry["rotation"])
            array = Array(entry["elements"], entry["pattern"])
            band = tuple(entry.get("band", Receiver.band))
            receivers.append(Receiver(entry["name"], pose, array, band))
        frame = None
        try:
            frame = state.get("frame") and Frame(*state["frame"])
        except ValueError as error:  # a checkpoint from before frames were checked
            log.warning("predictions have no place on a map: %s", error)
        task = registry("task").build(state["task"])
        return cls(**state | {"receivers": tuple(receivers), "task": task, "frame": frame})


def carriers(scene: Scene, query: Query) -> Float[Tensor, " b"]:
    """Frequency of each link [Hz].

    For channels it is the mean of the subcarriers in the receiver's band. For other labels it is
    the query's frequency, or else the only carrier of the training links.
    """
    if scene.task.is_channel:
        return scene.middles.to(query.transmitters)[query.receivers]
    if query.frequencies is not None:
        return query.frequencies
    if len(scene.frequencies) != 1:
        raise ValueError(
            f"each link must have a frequency [Hz], as the data have {len(scene.frequencies)} "
            "carriers"
        )
    return scene.frequencies.to(query.transmitters).expand(len(query))


def check_elements(owner: str, scene: Scene, pads: bool = False) -> Task:
    """The scene's task, which must have channels with as many elements as each receiver's array.

    Args:
        owner: Name of the component in errors.
        scene: The scene.
        pads: True if smaller arrays are allowed, because the component predicts 0 at missing
            elements.

    Raises:
        ValueError: Labels are not channels, or an array has another number of elements.
    """
    task = scene.task
    if not task.is_channel:
        raise ValueError(
            f"{owner} gives complex channels, not labels of task {task.name!r}; take another"
        )
    largest = max(scene.receivers, key=lambda receiver: len(receiver.array))
    for receiver in [largest] if pads else scene.receivers:
        if len(receiver.array) != task.elements:
            array = f"the array of {receiver.name} {len(receiver.array)}"
            raise ValueError(
                f"the labels have {task.elements} elements, and {array}; give the data's elements"
            )
    return task


def check_one_carrier(owner: str, scene: Scene) -> None:
    """Raises a ``ValueError`` if the links have several carriers; ``owner`` names a component."""
    if scene.has_band:
        raise ValueError(
            f"{owner} learns one carrier, and the training links have {len(scene.frequencies)}\n"
            "give the links of one carrier, or take a model of several, such as gaigs"
        )


def direct_waves(
    scene: Scene,
    query: Query,
    frequencies: Float[Tensor, " s"],
    sign: int = -1,
    at_elements: bool = True,
) -> Complex[Tensor, "b e s"]:
    """Fields in free space at the elements of each link's receiver.

    The field is 0 at elements that the receiver's array lacks, and outside the receiver's band.

    Args:
        scene: Scene with the receivers.
        query: The links.
        frequencies: Subcarriers [Hz].
        sign: As for ``free_space``.
        at_elements: False for the field at the middle of the array (e = 1), at all subcarriers.
    """
    # Some metres from the origin float32 would round an element's place by 1e-6 m, at 6 GHz by
    # 1e-4 rad.
    double = torch.zeros((), dtype=torch.float64)
    positions = []
    for receiver in scene.receivers:
        pose = receiver.pose.to(double)
        elements = receiver.array.elements.double().cpu()
        positions.append(pose.world(elements) if at_elements else pose.position[None])
    device = query.transmitters.device
    places = pad_sequence(positions, batch_first=True).to(device)[query.receivers]  # (b, e, 3)
    distances = (query.transmitters.double()[:, None] - places).norm(dim=-1)  # (b, e)
    waves = free_space(distances[..., None], frequencies.to(device), sign)  # (b, e, s)
    if not at_elements:  # one point, which all receivers have
        return waves
    return waves * ~lacking(scene.receivers, query.receivers, places.shape[1], frequencies)


def direct_gains(scene: Scene, query: Query) -> Float[Tensor, " b"]:
    """Field gain of each receiver's elements towards the transmitter, in float64.

    A transmitter in the middle of the array gets the gain along the array's normal.
    """
    gains = torch.ones(len(query), dtype=torch.float64, device=query.transmitters.device)
    for receiver in query.receivers.unique().tolist():
        at_receiver = query.receivers == receiver
        antenna = scene.receivers[receiver]
        points = antenna.pose.to(gains).local(query.transmitters[at_receiver].double())
        lengths = points.norm(dim=-1, keepdim=True)
        normal = points.new_tensor([0.0, 0.0, 1.0])
        directions = torch.where(lengths > 0, points / lengths, normal)
        gains[at_receiver] = antenna.array.gain(directions)
    return gains
