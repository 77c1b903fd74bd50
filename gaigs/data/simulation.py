"""Data sets of simulated rooms, from the responses of any simulator."""

import itertools
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Complex, Float, Int
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.core.antenna import Array, Receiver
from gaigs.core.geometry import Grid, Pose
from gaigs.core.propagation import bartlett, min_max
from gaigs.core.query import Query, check_carrier
from gaigs.core.task.csi import Csi
from gaigs.core.task.rssi import Rssi
from gaigs.core.task.spectrum import Spectrum
from gaigs.data import Links, Parts, kept_links
from gaigs.registry import check_type

PLACES_AT_A_TIME = 64
"""Transmitters simulated at a time: the waves of their paths take 100 times the labels' memory."""


@dataclass(frozen=True)
class SimulatedRoom:
    """A room with its receivers, and the responses of their antennas."""

    poses: tuple[Pose, ...]  # positions and orientations of the receivers with an array
    gateways: tuple[Receiver, ...]  # receivers with a single antenna
    edges: Float[Tensor, "k 2 3"]  # line segments to draw in figures [m]
    # From a count and a seed, random places of transmitters (count, 3) [m].
    place: Callable[[int, int], Tensor]
    # From a bandwidth, frequencies that sample the band, relative to its middle [Hz].
    frequency_offsets: Callable[[float], Tensor]
    # From places (n, 3), a receiver, a frequency and offsets (f,), the response of each element to
    # unit-power transmitters, ``PLACES_AT_A_TIME`` of them at a time (part, elements, f).
    respond: Callable[[Tensor, Receiver, float, Tensor], Iterable[Tensor]]


def simulate_spectra(
    room: SimulatedRoom,
    spectrum: str,
    transmitters: int,
    frequency: float | Sequence[float],
    bandwidth: float,
    seed: int,
) -> Links:
    """Spectra of transmitters at random places, by the options of ``synthetic.furnished_room``."""
    carriers = _to_carriers(frequency)
    offsets = spectrum_offsets(spectrum, room.frequency_offsets, bandwidth)
    places = room.place(transmitters, seed)
    receivers = patch_arrays(room.poses, max(carriers))
    grid = Grid.degrees()
    labels = []
    for receiver, carrier in itertools.product(receivers, carriers):
        responses = room.respond(places, receiver, carrier, offsets)
        labels.append(to_spectra(responses, grid, receiver.array, carrier))
    # Links are sorted by place, then by receiver, then by carrier.
    rows = torch.arange(transmitters).repeat_interleave(len(labels))
    numbers = torch.arange(len(receivers)).repeat_interleave(len(carriers))
    links = Links(
        query=Query(
            places[rows],
            numbers.repeat(transmitters),
            torch.tensor(carriers).float().repeat(transmitters * len(receivers)),
        ),
        receivers=receivers,
        labels=torch.stack(labels, 1).flatten(0, 1),  # (places * links, rows, columns)
        task=Spectrum(grid.elevations, grid.azimuths),
        rows=rows,
        official=partial(last_fifth, transmitters, rows),
        bandwidth=bandwidth if spectrum == "band" else 0.0,
        edges=room.edges,
    )
    return without_silent(links, transmitters, ~links.labels.isnan().flatten(1).any(1))


def _to_carriers(frequency: float | Sequence[float]) -> list[Any]:
    """The carriers of an option, one or several [Hz]."""
    carriers: list[Any] = list(frequency) if isinstance(frequency, list | tuple) else [frequency]
    for carrier in carriers:
        check_type("frequency", carrier, float)
        check_carrier("frequency", carrier)
    if not carriers or len(set(carriers)) < len(carriers):
        raise ValueError(
            f"frequency must be a carrier or several different ones [Hz], got {frequency}"
        )
    return carriers


def simulate_channels(
    room: SimulatedRoom,
    transmitters: int,
    frequency: float,
    bandwidth: float,
    subcarriers: int,
    seed: int,
    phase: str = "known",
) -> Links:
    """Channels of transmitters at random places; ``gaigs.data.synthetic_csi`` has the options.

    A channel's squared magnitude is the power that an element receives of unit power sent, between
    antennas of unit gain. Its time dependence is exp(+j omega t). There is no noise. Unless
    ``phase`` is known, each link gets random distortions as a receiver without synchronisation has.
    """
    if not 0 < bandwidth < math.inf:
        raise ValueError(f"bandwidth must be positive [Hz], got {bandwidth}")
    if subcarriers < 1:
        raise ValueError(f"subcarriers must be at least 1, got {subcarriers}")
    edge = bandwidth / 2 if subcarriers > 1 else 0.0
    offsets = torch.linspace(-edge, edge, subcarriers, dtype=torch.float64)
    places = room.place(transmitters, seed)
    receivers = patch_arrays(room.poses, frequency)
    task = Csi(len(receivers[0].array), frequency + offsets, phase)
    responses = [room.respond(places, receiver, frequency, offsets) for receiver in receivers]
    channels = [torch.cat([*response]) for response in responses]
    labels = torch.stack(channels, 1).flatten(0, 1)  # (places * receivers, elements, f)
    if phase != "known":
        has_delays = phase == "per_link_and_delay"
        labels = _distort(labels, offsets, bandwidth if has_delays else None, seed)
    # Links are sorted by place, then by receiver.
    rows = torch.arange(transmitters).repeat_interleave(len(receivers))
    numbers = torch.arange(len(receivers)).repeat(transmitters)
    links = Links(
        query=Query(places[rows], numbers, torch.full((len(rows),), float(frequency))),
        receivers=receivers,
        labels=labels.to(torch.complex64),
        task=task,
        rows=rows,
        official=partial(last_fifth, transmitters, rows),
        edges=room.edges,
    )
    return without_silent(links, transmitters, links.labels.flatten(1).any(1))


def _distort(
    labels: Complex[Tensor, "n elements f"],
    offsets: Float[Tensor, " f"],
    bandwidth: float | None,
    seed: int,
) -> Complex[Tensor, "n elements f"]:
    """Channels with a random phase for each link, and optionally a random delay and gain.

    Args:
        offsets: Subcarriers relative to the carrier [Hz].
        bandwidth: Width of the band [Hz]. Delays lie within two over the bandwidth of 0, gains in
            -6 to 6 dB. None: phases only.
        seed: Seed of the data.
    """
    # Random numbers that are independent of the places, which use ``seed`` itself.
    sequence = np.random.SeedSequence((seed % 2**64, 2))
    (state,) = sequence.generate_state(1, np.uint64)
    generator = torch.Generator().manual_seed(int(state) % 2**63)
    draws = 2 * torch.rand(3, len(labels), 1, 1, generator=generator, dtype=torch.float64) - 1
    turns, delays, gains = draws  # uniform in -1..1, (n, 1, 1) each
    angles = math.pi * turns
    if bandwidth is not None:
        # The phase 2 pi f t of a delay t of up to 2 / bandwidth.
        angles = angles + 4 * math.pi / bandwidth * delays * offsets
        labels = 10 ** (0.3 * gains) * labels  # 6 dB are a factor of 10^0.3
    return labels * torch.polar(torch.ones_like(angles), angles)


def without_silent(links: Links, transmitters: int, has_path: Bool[Tensor, " n"]) -> Links:
    """Links with a path; the remarks count the others.

    A ``ValueError`` if fewer than two of the ``transmitters`` places have a path.
    """
    if has_path.all():
        return links
    if len(links.rows[has_path].unique()) < 2:
        raise ValueError(
            f"paths must lead to two of {transmitters} transmitters or more; "
            "move the receiver or heights"
        )
    remarks = f"{int((~has_path).sum())} links without a path are left out"
    return replace(kept_links(links, has_path), remarks=remarks)


def simulate_readings(
    room: SimulatedRoom, transmitters: int, noise: float, sensitivity: float, seed: int
) -> Links:
    """Signal strength of transmitters of 0 dBm at random places.

    ``gaigs.data.synthetic_rssi`` describes the options. Power is averaged over the band of
    Bluetooth's advertising channels. The links of one place share a row.
    """
    if not 0 <= noise < math.inf:
        raise ValueError(f"noise must be a standard deviation, 0 or more [dB], got {noise}")
    places = room.place(transmitters, seed)
    # Bluetooth's advertising channels span 2.402 to 2.480 GHz.
    frequency = 2.441e9
    bandwidth = 78e6
    offsets = room.frequency_offsets(bandwidth)
    strengths = []
    for gateway in room.gateways:
        responses = room.respond(places, gateway, frequency, offsets)
        strengths.append(torch.cat([*map(rss_dbm, responses)]))
    exact = torch.stack(strengths, 1)  # (places, gateways)
    # The places use ``seed`` itself.
    generator = torch.Generator().manual_seed(hash((seed, 1)) % 2**63)
    errors = torch.randn(exact.shape, dtype=exact.dtype, generator=generator)
    readings = exact + noise * errors
    is_received = readings >= sensitivity
    for gateway, is_any in zip(room.gateways, is_received.any(0), strict=True):
        if not is_any:
            got = f"{gateway.name!r} hears none of {len(places)} at {sensitivity:g} dBm"
            raise ValueError(
                f"sensitivity must let each gateway hear a reading, but {got}; lower it"
            )
    rows, columns = is_received.nonzero(as_tuple=True)
    return Links(
        query=Query(places[rows], columns, torch.full((len(rows),), frequency)),
        receivers=room.gateways,
        labels=readings[is_received].float(),
        task=Rssi(),
        rows=rows,
        official=partial(last_fifth, transmitters, rows),
        bandwidth=bandwidth,
        edges=room.edges,
        remarks=(
            f"{len(rows)} readings of {len(places)} places at {len(room.gateways)} gateways; "
            f"{int((~is_received).sum())} below {sensitivity:g} dBm "
            "were not heard and are left out"
        ),
    )


def spectrum_offsets(
    spectrum: str, sample: Callable[[float], Tensor], bandwidth: float
) -> Float[Tensor, " f"]:
    """Frequencies over which a spectrum's power is averaged, relative to the carrier [Hz].

    ``sample`` gives the frequencies of a band; the spectrum ``carrier`` has the carrier alone.
    """
    if spectrum not in ("band", "carrier"):
        raise ValueError(f"spectrum must be 'band' or 'carrier', got {spectrum!r}")
    return sample(bandwidth) if spectrum == "band" else torch.zeros(1)


def patch_arrays(poses: Sequence[Pose], frequency: float) -> tuple[Receiver, ...]:
    """Receivers with 4 x 4 patches half a wavelength apart, as for the NeRF² spectra."""
    check_carrier("frequency", frequency)
    array = Array.planar(4, 4, speed_of_light / frequency / 2, "cosine")
    return tuple(Receiver(f"gateway{number}", pose, array) for number, pose in enumerate(poses, 1))


def last_fifth(transmitters: int, rows: Int[Tensor, " n"]) -> Parts:
    """Official training and test links: the last fifth of the transmitter places is for the test.

    ``rows`` has the number of each link's place.
    """
    training = transmitters - max(1, round(transmitters / 5))
    return (rows < training).nonzero()[:, 0], (rows >= training).nonzero()[:, 0]


def wall_poses(
    outline: Callable[[float], Float[Tensor, "w 2"]],
    is_free: Callable[[Float[Tensor, "k 3"]], Bool[Tensor, " k"]],
    count: int,
) -> tuple[Pose, ...]:
    """Poses along the walls, 0.1 m off them and outside furniture, that face the room's middle.

    They are evenly spaced along the walls. Heights are spread evenly over 1.2 to 2.6 m, in steps of
    the golden ratio modulo 1, so that neighbours differ.

    Args:
        outline: From a height, the corners of the walls there, counterclockwise (float64) [m].
        is_free: True for points outside furniture.
    """
    if count < 1:
        raise ValueError(f"receivers must be at least 1, got {count}")
    poses = []
    for number in range(count):
        share = (number + 0.5) / count  # of the way around the room
        height = 1.2 + 1.4 * (0.618034 * number % 1)
        walls = outline(height)
        corners = _inset(walls, 0.1)
        sides = (corners.roll(-1, 0) - corners).norm(dim=1)  # lengths [m]
        ends = sides.cumsum(0)  # length of the way from the first corner to the end of each side
        while True:  # furniture moves a receiver along its wall
            along = share % 1 * ends[-1]
            side = int(torch.searchsorted(ends, along))
            along_side = 1 - (ends[side] - along) / sides[side]  # share of the side
            place = torch.lerp(corners[side], corners[(side + 1) % len(corners)], along_side)
            position = torch.cat((place, place.new_tensor([height])))
            if is_free(position[None]).all():
                break
            share += 0.005
        middle = torch.cat((_centroid(walls), torch.ones(1, dtype=torch.float64)))
        # The array looks along its z axis, the normal; its x axis is horizontal.
        normal = torch.nn.functional.normalize(middle - position, dim=0)
        across = torch.linalg.cross(normal.new_tensor([0.0, 0.0, 1.0]), normal)
        across = torch.nn.functional.normalize(across, dim=0)
        axes = torch.stack((across, torch.linalg.cross(normal, across), normal), 1)  # (3, 3)
        poses.append(Pose(position.float(), axes.float()))
    return tuple(poses)


def _inset(corners: Float[Tensor, "w 2"], gap: float) -> Float[Tensor, "w 2"]:
    """Corners of a counterclockwise polygon whose sides have moved inwards by a gap [m]."""
    sides = torch.nn.functional.normalize(corners.roll(-1, 0) - corners, dim=1)
    # Inward unit normals of the sides after and before each corner.
    after = torch.stack((-sides[:, 1], sides[:, 0]), 1)
    before = after.roll(1, 0)
    # A corner moves by a vector v with v'after = v'before = gap.
    return corners + gap * (before + after) / (1 + (before * after).sum(1, keepdim=True))


def _centroid(corners: Float[Tensor, "w 2"]) -> Float[Tensor, "2"]:
    """Centroid of a polygon's area [m], by the shoelace formula."""
    after = corners.roll(-1, 0)
    areas = corners[:, 0] * after[:, 1] - corners[:, 1] * after[:, 0]  # twice those of triangles
    return areas @ (corners + after) / (3 * areas.sum())


def draw_places(
    lower: Float[Tensor, "3"],
    upper: Float[Tensor, "3"],
    is_free: Callable[[Float[Tensor, "k 3"]], Bool[Tensor, " k"]],
    count: int,
    seed: int,
) -> Float[Tensor, "count 3"]:
    """Random places [m], two or more, uniform over the part of a box where ``is_free`` is true."""
    if count < 2:
        raise ValueError(
            f"transmitters must be at least 2, one to train and one to test on, got {count}"
        )
    generator = torch.Generator().manual_seed(seed)
    places = torch.zeros(0, 3)
    for tried in itertools.count(count, count):
        tries = lower + (upper - lower) * torch.rand(count, 3, generator=generator)
        places = torch.cat((places, tries[is_free(tries)]))
        if len(places) >= count:
            break
        if tried == 1000 * count and not len(places):
            raise ValueError(
                f"transmitters must have free space to stand in, got none at {tried} places tried"
            )
    return places[:count]


def sample_band(bandwidth: float, longest: float) -> Float[Tensor, " f"]:
    """Frequencies of a band relative to its middle [Hz], for paths of up to ``longest`` [m].

    They are dense enough that the interference of two paths is not aliased.
    """
    if not 0 < bandwidth < math.inf:
        raise ValueError(
            f"bandwidth must be positive [Hz], got {bandwidth}; "
            "one frequency is the spectrum 'carrier'"
        )
    # Two paths beat with a period of the speed of light over their difference in length.
    count = math.ceil(bandwidth * longest / speed_of_light) + 1
    return torch.linspace(-bandwidth / 2, bandwidth / 2, count, dtype=torch.float64)


def to_spectra(
    responses: Iterable[Complex[Tensor, "part elements f"]],
    grid: Grid,
    array: Array,
    frequency: float,
) -> Float[Tensor, "n rows columns"]:
    """Spectra of an array's responses at a carrier [Hz], float32 in [0, 1]."""
    amplitudes = (bartlett(part, grid, array, frequency) for part in responses)
    return torch.cat([min_max(part).float() for part in amplitudes])


def rss_dbm(responses: Complex[Tensor, "b elements f"]) -> Float[Tensor, " b"]:
    """Received level for a transmitter of 0 dBm, a mean over elements and frequencies [dBm]."""
    return 10 * torch.log10(responses.abs().square().mean((1, 2)))
