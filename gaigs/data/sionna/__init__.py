"""Rooms that are no boxes, simulated by the independent ray tracer Sionna RT."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.data import Links
from gaigs.data.readings import gateway
from gaigs.data.simulation import PART, SimulatedRoom, draw_places, simulate_spectra
from gaigs.data.sionna.cache import find_paths
from gaigs.data.sionna.meshes import MeshRoom, edges
from gaigs.data.sionna.rooms import ROOMS
from gaigs.data.sionna.tracing import frequency_offsets, respond
from gaigs.registry import register

HEIGHTS = 0.3, 2.0
"""Lowest and highest height of transmitters [m]."""


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
        transmitters: Number of places.
        frequency: One carrier or several [Hz]. The elements are half a wavelength of the highest apart.
        bandwidth: Width of the band around each carrier [Hz].
        seed: Seed of the places.

    Raises:
        ImportError: Sionna RT is not installed.
        RuntimeError: There is no libLLVM that it can use.
        TypeError: A frequency is no number.
        ValueError: An option is out of range.

    Source: the defaults for frequency and bandwidth are those of channel 5 of IEEE 802.15.4 (ultra-wideband).
    """
    return simulate_spectra(find_room(room), spectrum, transmitters, frequency, bandwidth, seed)


def find_room(name: str) -> SimulatedRoom:
    """The traced room of a name.

    Raises:
        ValueError: There is no such room.
    """
    if name not in ROOMS:
        raise ValueError(f"room must be one of {', '.join(ROOMS)}, got {name!r}")
    room = ROOMS[name]

    def trace(places, receiver, frequency, offsets):
        paths = find_paths(room, receiver.pose.position, places, frequency)
        return respond(paths, receiver, frequency, offsets).split(PART)

    return SimulatedRoom(
        pose=room.pose(),
        gateways=tuple(gateway(*each) for each in room.gateways),
        edges=edges(room.meshes()),
        place=lambda count, seed: place(room, count, seed),
        frequency_offsets=lambda bandwidth: frequency_offsets(room.meshes(), bandwidth),
        respond=trace,
    )


def place(room: MeshRoom, count: int, seed: int) -> Float[Tensor, "count 3"]:
    """Random places in a room [m], uniform over the part at the transmitters' heights that is free of furniture.

    Raises:
        ValueError: There are fewer than 2.
    """
    corners = torch.tensor([*room.floor, *room.ceiling])
    lower = torch.cat((corners.amin(0), torch.tensor(HEIGHTS[:1])))
    upper = torch.cat((corners.amax(0), torch.tensor(HEIGHTS[1:])))
    return draw_places(lower, upper, room.is_free, count, seed)
