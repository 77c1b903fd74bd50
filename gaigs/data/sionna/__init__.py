"""Rooms of any shape, simulated by the independent ray tracer Sionna RT."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.antenna import Receiver
from gaigs.data import Links
from gaigs.data.readings import gateway
from gaigs.data.simulation import PART, SimulatedRoom, draw_places, simulate_spectra
from gaigs.data.sionna.cache import find_paths
from gaigs.data.sionna.meshes import MeshRoom, edges
from gaigs.data.sionna.rooms import ROOMS
from gaigs.data.sionna.tracing import frequency_offsets, respond
from gaigs.registry import register

HEIGHTS = 0.3, 2.0
"""Smallest and largest height of transmitters [m]."""


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

    Paths are traced the first time, which takes a minute, and stored. The other options are those of ``synthetic``.

    Args:
        room: ``l_shape``, ``slanted`` or ``furnished``.

    Raises:
        ImportError: Sionna RT is not installed.
        RuntimeError: There is no libLLVM that it can use.
        ValueError: An option is out of range.
    """
    return simulate_spectra(find_room(room), spectrum, transmitters, frequency, bandwidth, seed)


def find_room(name: str) -> SimulatedRoom:
    """The traced room of a name; a ``ValueError`` for an unknown one."""
    if name not in ROOMS:
        raise ValueError(f"room must be one of {', '.join(ROOMS)}, got {name!r}")
    room = ROOMS[name]

    def trace(places: Tensor, receiver: Receiver, frequency: float, offsets: Tensor) -> Sequence[Tensor]:
        paths = find_paths(room, receiver.pose.position, places, frequency)
        return respond(paths, receiver, frequency, offsets).split(PART)

    return SimulatedRoom(
        pose=room.pose(),
        gateways=tuple(gateway(name, position) for name, position in room.gateways.items()),
        edges=edges(room.meshes()),
        place=lambda count, seed: place(room, count, seed),
        frequency_offsets=lambda bandwidth: frequency_offsets(room.meshes(), bandwidth),
        respond=trace,
    )


def place(room: MeshRoom, count: int, seed: int) -> Float[Tensor, "count 3"]:
    """Random places in a room [m], uniform over the free part at the transmitters' heights."""
    corners = torch.tensor([*room.floor, *room.ceiling])
    lower = torch.cat((corners.amin(0), torch.tensor(HEIGHTS[:1])))
    upper = torch.cat((corners.amax(0), torch.tensor(HEIGHTS[1:])))
    return draw_places(lower, upper, room.is_free, count, seed)
