"""Training channels of a search for planes: links of each receiver, waves and materials."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float, Int
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.propagation import NEAREST, slab
from gaigs.core.query import evenly
from gaigs.core.task.csi import Csi
from gaigs.data import Links
from gaigs.planes.frame import RoomFrame
from gaigs.planes.strengths import FreeFit, fit_free
from gaigs.splatting.placement.mirrored.reflections import all_sequences, fold, images, polarised

SLABS = (
    torch.tensor(
        [(1.5, 0.3, 1.0), (4.0, 0.3, 1.0), *((2.0, 0.05, 0.005 * step) for step in range(1, 13))]
    )
    .double()
    .log()
)
"""Slabs that are tried, as natural logarithms of three numbers: the real part of the relative
permittivity minus 1, its negative imaginary part, and the thickness [m]. A thickness of 1 m stands
for a half-space."""


@dataclass(frozen=True)
class ChannelOptions:
    """Options of the search for planes in channels."""

    # Ridge of the least squares of path strengths, over the mean diagonal of the Gram matrix.
    ridge: float = 1e-3
    # Least number of independent values in a channel: elements times the delays that its band
    # resolves in the room. With fewer, free strengths at any planes explain the channel. A room of
    # six planes has 37 paths of up to two reflections.
    fewest_free: int = 37
    certain_share: float = 0.006  # share of the power from which a plane is taken
    # The same share for a plane by which the residual falls by ``certain_fall``. Validation drops
    # false planes later, so a few too many only cost time.
    faint_share: float = 0.003
    # Fall of the mean log of the residual's power by which a faint plane is true: false ones reach
    # 0.3.
    certain_fall: float = 0.5
    # Least fall of the error by a true plane: the mean log of the fraction of power that
    # neighbouring places do not predict. Walls have 0.05 and more, false planes up to 0.02,
    # furniture 0.01 to 0.06.
    price: float = 0.02
    neighbours: int = 8  # number of places whose strengths predict a place
    predicted: int = 250  # largest number of places that are predicted
    # Least share of the residual that a candidate along the room's axes explains.
    added_share: float = 0.05
    # Largest distance of a plane from all transmitters and receivers [diagonals].
    margin: float = 0.3
    # Largest numbers of steps of the periodogram on either side, for offsets and for tilts. A step
    # of the offset is a fraction of the wavelength; a step of the tilt is one over the room's
    # diagonal. At 60 GHz these steps reach 2 cm, and 0.004 rad in a room of 10 m; at 3.5 GHz 0.007
    # rad in a hall of 100 m.
    offset_cells: int = 64
    tilt_cells: int = 40
    # Largest number of waves in ``find_axis_walls``: offsets times places times channel values. It
    # takes some seconds for each plane.
    most_waves: int = 100_000_000
    drawing_error: float = 0.2  # largest error of a wall in a floor plan [m]
    # Share of the residual that the best of thousands of planes explains by chance, times the
    # number of places.
    chance: float = 6.0


class SlabRoom(NamedTuple):
    """Planes in the frame of the room, and their slabs as in ``SLABS``."""

    planes: Float[Tensor, "w 4"]
    slabs: Float[Tensor, "w 3"]

    def with_plane(self, plane: Float[Tensor, "4"], material: Float[Tensor, "3"]) -> "SlabRoom":
        """The room with one more plane, the last."""
        planes = torch.cat((self.planes, plane[None]))
        return SlabRoom(planes, torch.cat((self.slabs, material[None])))

    def replace_plane(
        self, number: int, plane: Float[Tensor, "4"], material: Float[Tensor, "3"]
    ) -> "SlabRoom":
        """The room with plane ``number`` replaced."""
        room = SlabRoom(self.planes.clone(), self.slabs.clone())
        room.planes[number] = plane
        room.slabs[number] = material
        return room


def half_spaces(planes: Float[Tensor, "w 4"]) -> SlabRoom:
    """A room whose planes are faces of half-spaces, with the second material of ``SLABS``."""
    return SlabRoom(planes, SLABS[1].repeat(len(planes), 1))


class SlabMaterials(NamedTuple):
    """Complex relative permittivities, and thicknesses [m]."""

    permittivities: Complex[Tensor, "*w"]
    thicknesses: Float[Tensor, "*w"]


def materials_of(slabs: Float[Tensor, "*w 3"]) -> SlabMaterials:
    """Permittivities and thicknesses of slabs, in the form of ``SLABS``."""
    real, imaginary, thicknesses = slabs.exp().unbind(-1)
    return SlabMaterials(torch.complex(1 + real, -imaginary), thicknesses)


@dataclass(frozen=True)
class ReceiverChannels:
    """The training channels of one receiver, at a part of its elements and subcarriers.

    Shapes: b links, e elements, s subcarriers, k = e s channel values, n paths.
    """

    places: Float[Tensor, "b 3"]  # transmitters [m]
    channels: Complex[Tensor, "b e s"]  # with phases as of exp(-j 2 pi f t)
    position: Float[Tensor, "3"]  # middle of the array [m]
    elements: Float[Tensor, "e 3"]  # world frame [m]
    frequencies: Float[Tensor, " s"]  # [Hz]

    @classmethod
    def of(
        cls, links: Links, number: int, sign: int, elements: int = 16, subcarriers: int = 32
    ) -> "ReceiverChannels":
        """Channels of receiver ``number`` with nonzero power, with phases as of exp(-j 2 pi f t).

        Args:
            links: Links, of which the training links are used.
            number: Number of the receiver.
            sign: -1 if phases of the labels fall with the delay, as exp(-j 2 pi f delay), else 1.
            elements, subcarriers: Largest numbers, evenly spread over the array and the band.
        """
        receiver = links.receivers[number]
        query = links.query
        task: Csi = links.task
        train = links.split.train
        rows = train[query.receivers[train] == number]
        chosen = evenly(torch.arange(len(receiver.array)), elements)
        in_band = receiver.hears(task.frequencies).nonzero()[:, 0]
        carriers = evenly(in_band, subcarriers)
        channels = links.labels[rows][:, chosen][:, :, carriers].to(torch.complex128)  # (b, e, s)
        is_received = channels.abs().amax((1, 2)) > 0
        pose = receiver.pose.to(torch.zeros((), dtype=torch.float64))
        return cls(
            query.transmitters[rows][is_received].double(),
            (channels.conj() if sign > 0 else channels)[is_received],
            pose.position,
            pose.world(receiver.array.elements[chosen].double()),
            task.frequencies[carriers],
        )

    @property
    def wavelength(self) -> float:
        """Wavelength at the mean frequency [m]."""
        return speed_of_light / float(self.frequencies.mean())

    def about(self, middle: Float[Tensor, "3"]) -> "ReceiverChannels":
        """The same channels, with all positions relative to the point ``middle`` [m]."""
        points = {name: getattr(self, name) - middle for name in ("places", "position", "elements")}
        return replace(self, **points)

    def at(self, places: object, subcarriers: object = slice(None)) -> "ReceiverChannels":
        """The channels at places and subcarriers, both chosen by an index, a mask or a slice."""
        return replace(
            self,
            places=self.places[places],
            channels=self.channels[places][:, :, subcarriers],
            frequencies=self.frequencies[subcarriers],
        )

    def single(self) -> "ReceiverChannels":
        """The same channels in single precision, for gradient descent."""
        return replace(
            self,
            places=self.places.float(),
            channels=self.channels.to(torch.complex64),
            position=self.position.float(),
            elements=self.elements.float(),
            frequencies=self.frequencies.float(),
        )

    def of_unique_places(self) -> "ReceiverChannels":
        """The first link with power of each place, since links of one place predict each other."""
        received = self.at(self.channels.abs().amax((1, 2)) > 0)
        _, place_of_link = received.places.unique(dim=0, return_inverse=True)
        first_rows: dict[int, int] = {}  # by place
        for row, place in enumerate(place_of_link.tolist()):
            first_rows.setdefault(place, row)
        return received.at(torch.tensor(sorted(first_rows.values()), dtype=torch.long))

    @cached_property
    def flat(self) -> Complex[Tensor, "b k"]:
        """Channels with elements and subcarriers in one dimension."""
        return self.channels.flatten(1)

    @property
    def few_subcarriers(self) -> slice:
        """Every fifth subcarrier, or a smaller step that keeps at least 64 values in a channel."""
        return slice(None, None, min(5, max(1, self.flat.shape[1] // 64)))

    def images(
        self, planes: Float[Tensor, "w 4"], sequences: Int[Tensor, "n order"]
    ) -> Float[Tensor, "b n 3"]:
        """Images of the transmitters after reflections at each sequence of planes [m]."""
        return images(self.places, sequences, planes[:, :3], planes[:, 3])[-1]

    def waves(self, points: Float[Tensor, "b n 3"]) -> Complex[Tensor, "b n k"]:
        """Waves of unit sources at points: exp(-j 2 pi f L / c) / L at each element."""
        ways = points[..., None, :] - self.elements  # (b, n, e, 3)
        lengths = ways.norm(dim=-1).clamp_min(NEAREST)[..., None]  # (b, n, e, 1)
        turns = lengths * (self.frequencies / speed_of_light)  # (b, n, e, s)
        # Whole turns have no effect, and large angles have rounded sines.
        turns = turns - turns.detach().round()
        waves = torch.polar((1 / lengths).expand_as(turns), -2 * math.pi * turns)
        return waves.flatten(-2)

    def reflected(
        self,
        room: SlabRoom,
        sequences: Int[Tensor, "n order"],
        at: Float[Tensor, " s"] | None = None,
    ) -> Complex[Tensor, "b n k"]:
        """Waves of all paths, times their reflection coefficients.

        The wave is 0 for a path that does not exist, since it misses one of its planes.

        Args:
            room: Planes and slabs.
            sequences: Numbers of the planes of each path.
            at: Frequencies of the reflection coefficients [Hz], by default of all subcarriers. A
                single one saves time for half-spaces, whose reflection is equal at all frequencies.
        """
        at = self.frequencies if at is None else at
        planes = room.planes.to(self.places)
        normals, offsets = planes[:, :3], planes[:, 3]
        points = images(self.places, sequences, normals, offsets)
        receivers = self.position.expand(len(self.places), 3)
        folded = fold(points, receivers, sequences, normals, offsets)
        permittivities, thicknesses = materials_of(room.slabs.to(self.places))
        depths = thicknesses[:, None] * at / speed_of_light  # (w, s) [wavelengths]
        te, tm = slab(
            permittivities[folded.planes, None],
            folded.cosines[..., None].clamp(1e-3, 1),
            depths[folded.planes],
        )
        coefficients = polarised(folded.normals[:, None], te, tm)  # of each reflection
        exists = folded.exists[..., None].to(self.channels.dtype).expand(-1, -1, len(at))
        gains = folded.reflected(exists, coefficients)  # (b, n, s)
        waves = self.waves(points[-1]).unflatten(-1, (len(self.elements), -1))  # (b, n, e, s)
        return (waves * gains[:, :, None]).flatten(-2)


class ChannelSample(NamedTuple):
    """Channels of each receiver at a part of its places and subcarriers, with reference phases."""

    receivers: list[ReceiverChannels]
    phases: list[Complex[Tensor, " c"]]  # see ``ChannelData.reference_phases``

    def every(self, step: int) -> "ChannelSample":
        """The sample at every ``step``-th place."""
        receivers = [receiver.at(slice(None, None, step)) for receiver in self.receivers]
        phases = [phase if len(phase) == 1 else phase[::step] for phase in self.phases]
        return ChannelSample(receivers, phases)


class ChannelData:
    """All training channels of a search, in the frame of the room.

    Args:
        links: Links of task ``csi``, of which the training links are used.
        sign: -1 if phases of the channels fall with the delay, as exp(-j 2 pi f delay), else 1.
        has_common_phase: True if all channels share one unknown phase.
        order: Largest number of reflections of a path. More than 2 count as 2: longer paths hardly
            locate a plane.
        options: Options of the search.
    """

    def __init__(
        self, links: Links, sign: int, has_common_phase: bool, order: int, options: ChannelOptions
    ):
        self.has_common_phase = has_common_phase
        self.order = min(order, 2)
        self.options = options
        received = []
        self.numbers: list[int] = []  # indices of the receivers in ``links``
        for number in links.query.receivers[links.split.train].unique().tolist():
            receiver = ReceiverChannels.of(links, number, sign)
            if len(receiver.places):
                received.append(receiver)
                self.numbers.append(number)
        ends = []
        for receiver in received:
            ends += [receiver.places, receiver.position[None]]
        self.frame = RoomFrame(torch.cat(ends))
        self.receivers = [receiver.about(self.frame.middle) for receiver in received]
        self.wavelength = min(receiver.wavelength for receiver in self.receivers)
        widest = 1.0  # band [Hz]; not 0, for channels of one subcarrier
        for receiver in self.receivers:
            widest = max(widest, float(receiver.frequencies.max() - receiver.frequencies.min()))
        # Error of a plane that a delay profile shows [m]: where paths are close, peaks are off by a
        # part of the resolution c / band.
        self.reach = max(0.07, speed_of_light / 8 / widest)

    def sequences(self, planes: Float[Tensor, "w 4"]) -> Int[Tensor, "n order"]:
        """Sequences of planes of all paths."""
        return all_sequences(len(planes), self.order)

    def draw(
        self, count: int, subcarriers: int | None = None, fewest: int = 4
    ) -> list[ReceiverChannels]:
        """All receivers with about ``count`` random places in total, at least ``fewest`` each."""
        each = max(fewest, count // len(self.receivers))
        parts = []
        for receiver in self.receivers:
            places = self._draw_rows(len(receiver.places), each)
            carriers = self._draw_rows(len(receiver.frequencies), subcarriers)
            parts.append(receiver.at(places, carriers))
        return parts

    def _draw_rows(self, size: int, most: int | None) -> Int[Tensor, " k"]:
        """At most ``most`` random numbers below ``size`` without repetition, ascending."""
        return torch.randperm(size, generator=self.frame.generator)[:most].sort().values

    def sample(self, planes: Float[Tensor, "w 4"]) -> ChannelSample:
        """Channels at about a hundred places and ``few_subcarriers``, in single precision.

        Their reference phases are ``reference_phases`` with ``planes``.
        """
        receivers = []
        phases = []
        references = self.reference_phases(planes, self.receivers)
        for receiver, phase in zip(self.receivers, references, strict=True):
            step = max(1, len(receiver.places) * len(self.receivers) // 100)
            thinned = receiver.at(slice(None, None, step), receiver.few_subcarriers)
            receivers.append(thinned.single())
            phases.append(phase if len(phase) == 1 else phase[::step])
        return ChannelSample(receivers, phases)

    def fit_free(
        self, receiver: ReceiverChannels, planes: Float[Tensor, "w 4"], ridge: float | None = None
    ) -> FreeFit:
        """Complex strengths of all paths at ``planes``, by ``strengths.fit_free`` at each place."""
        waves = receiver.waves(receiver.images(planes, self.sequences(planes)))
        return fit_free(waves, receiver.flat, self.options.ridge if ridge is None else ridge)

    def reference_phases(
        self, planes: Float[Tensor, "w 4"], receivers: list[ReceiverChannels]
    ) -> list[Complex[Tensor, " c"]]:
        """Phase of the direct paths to each receiver, as complex numbers of magnitude 1.

        With a common phase a receiver has one number (1,), otherwise one for each place (b,).
        """
        phases = []
        for receiver in receivers:
            if not self.has_common_phase:
                # One place alone does not separate the direct path from paths of similar length. A
                # larger ridge gives them the same phase.
                phases.append(self.fit_free(receiver, planes, 1e-2).strengths[:, 0].sgn())
                continue
            # About a hundred places of all receivers suffice, but at least sixteen of each.
            count = len(receiver.places)
            step = max(1, min(count // 16, count * len(receivers) // 100))
            thinned = receiver.at(slice(None, None, step))
            # Path 0 is the direct one.
            direct = self.fit_free(thinned, planes, 1e-4).strengths[:, 0]
            # Phases of blocked direct paths are wrong: the stronger half decides.
            is_strong = direct.abs() >= direct.abs().median()
            phases.append((direct.sgn() * is_strong).sum()[None].sgn())
        return phases
