"""Rooms that are no boxes, simulated by the independent ray tracer Sionna RT."""

from collections.abc import Sequence
from functools import partial

import torch
from jaxtyping import Float
from scipy.constants import speed_of_light
from torch import Tensor

from gaigs.data import Links
from gaigs.data.nerf2_spectrum import NORMALISATION
from gaigs.data.sionna.cache import find_paths
from gaigs.data.sionna.meshes import HEIGHTS, Room, edges
from gaigs.data.sionna.rooms import ROOMS
from gaigs.data.sionna.tracing import frequency_offsets, respond
from gaigs.data.synthetic import SIDE, last_fifth
from gaigs.directions import Grid
from gaigs.propagation import bartlett, min_max
from gaigs.query import Query, check_carrier
from gaigs.registry import check_type, register
from gaigs.scene import Array, Receiver
from gaigs.task.spectrum import Spectrum


@register("data", "sionna")
def traced_room(
    room: str = "furnished",
    spectrum: str = "band",
    transmitters: int = 300,
    frequency: float | Sequence[float] = 6.4896e9,
    bandwidth: float = 499.2e6,
    seed: int = 0,
) -> Links:
    """Spectra of transmitters at random places in a room; the official split tests on the last fifth of them.

    Paths are traced the first time, which takes a minute, and kept on disk. Each place sends at each carrier, and these
    links share a row.

    Args:
        room: ``l_shape``, ``slanted`` or ``furnished``.
        spectrum: ``band`` or ``carrier``: power averaged over the band, or one frequency.
        transmitters: How many places.
        frequency: Of the carrier, or of several [Hz]. The array is that of the highest.
        bandwidth: Of the band around each carrier [Hz].
        seed: Of the transmitters' places.

    Raises:
        ImportError: Sionna RT is not installed.
        RuntimeError: There is no libLLVM that it can use.
        TypeError: A frequency is no number.
        ValueError: An option is out of range.

    Source: the defaults for frequency and bandwidth are those of channel 5 of IEEE 802.15.4 (ultra-wideband).
    """
    carriers = list(frequency) if isinstance(frequency, list | tuple) else [frequency]
    for carrier in carriers:
        check_type("frequency", carrier, float)
        check_carrier("frequency", carrier)
    if not carriers or len(set(carriers)) < len(carriers):
        raise ValueError(f"frequency must be a carrier or several different ones [Hz], got {frequency}")
    if spectrum not in ("band", "carrier"):
        raise ValueError(f"spectrum must be 'band' or 'carrier', got {spectrum!r}")
    walls = find_room(room)
    places = place(walls, transmitters, seed)
    receiver = patch_array(walls, max(carriers))
    offsets = frequency_offsets(walls.meshes(), bandwidth) if spectrum == "band" else torch.zeros(1)
    grid = Grid.degrees()
    labels = []
    for carrier in carriers:
        paths = find_paths(walls, receiver.pose.position, places, carrier)
        responses = respond(paths, receiver, carrier, offsets)
        # In parts, because the float64 spectra of all transmitters would need several times the memory of the labels.
        spectra = [min_max(bartlett(part, grid, receiver.array, carrier)).float() for part in responses.split(64)]
        labels.append(torch.cat(spectra))
    rows = torch.arange(transmitters).repeat_interleave(len(carriers))
    return Links(
        query=Query(places[rows], torch.zeros_like(rows), torch.tensor(carriers).float().repeat(transmitters)),
        receivers=(receiver,),
        labels=torch.stack(labels, 1).flatten(0, 1),
        task=Spectrum(grid.elevations, grid.azimuths, NORMALISATION),
        rows=rows,
        official=partial(last_fifth, transmitters, rows),
        bandwidth=bandwidth if spectrum == "band" else 0.0,
        edges=edges(walls.meshes()),
    )


def find_room(name: str) -> Room:
    """The room of that name.

    Raises:
        ValueError: There is none.
    """
    if name not in ROOMS:
        raise ValueError(f"room must be one of {', '.join(ROOMS)}, got {name!r}")
    return ROOMS[name]


def patch_array(room: Room, frequency: float) -> Receiver:
    """A room's receiver: a square array of patches, half a wavelength of the frequency [Hz] apart.

    Raises:
        ValueError: The frequency is out of range.
    """
    check_carrier("frequency", frequency)
    return Receiver("gateway1", room.pose(), Array.planar(SIDE, SIDE, speed_of_light / frequency / 2, "cosine"))


def place(room: Room, count: int, seed: int) -> Float[Tensor, "count 3"]:
    """Random places in a room [m], uniform over what is free of walls and furniture at the transmitters' heights.

    Raises:
        ValueError: There are fewer than 2.
    """
    if count < 2:
        raise ValueError(f"transmitters must be at least 2, one to train and one to test on, got {count}")
    corners = torch.tensor([*room.floor, *room.ceiling])
    lower = torch.cat((corners.amin(0), torch.tensor(HEIGHTS[:1])))
    upper = torch.cat((corners.amax(0), torch.tensor(HEIGHTS[1:])))
    generator = torch.Generator().manual_seed(seed)
    places = torch.zeros(0, 3)
    while len(places) < count:
        tries = lower + (upper - lower) * torch.rand(count, 3, generator=generator)
        places = torch.cat((places, tries[room.is_free(tries)]))
    return places[:count]
