"""Complex channels of the ray tracer's rooms, as a wideband receiver with an antenna array estimates them."""

import math
from functools import partial

import torch

from gaigs.data import Links
from gaigs.data.sionna import find_room, patch_array, place
from gaigs.data.sionna.cache import find_paths
from gaigs.data.sionna.meshes import edges
from gaigs.data.sionna.tracing import respond
from gaigs.data.synthetic import last_fifth
from gaigs.query import Query
from gaigs.registry import register
from gaigs.task.csi import Csi


@register("data", "sionna_csi")
def traced_room_csi(
    room: str = "furnished",
    transmitters: int = 300,
    frequency: float = 6.4896e9,
    bandwidth: float = 499.2e6,
    subcarriers: int = 26,
    seed: int = 0,
) -> Links:
    """Channels of transmitters at random places in a room, at each element of its 4 x 4 array.

    Places, paths and array are those of ``sionna``, unit and time dependence those of ``synthetic_csi``. The official
    split tests on the last fifth of the places.

    Args:
        room: ``l_shape``, ``slanted`` or ``furnished``.
        transmitters: How many.
        frequency: Of the carrier [Hz].
        bandwidth: From the lowest subcarrier to the highest, about the carrier [Hz].
        subcarriers: How many, evenly over the band; a single one is the carrier.
        seed: Of the transmitters' places.

    Raises:
        ImportError: Sionna RT is not installed.
        RuntimeError: There is no libLLVM that it can use.
        ValueError: An option is out of range.
    """
    if not 0 < bandwidth < math.inf:
        raise ValueError(f"bandwidth must be positive [Hz], got {bandwidth}")
    if subcarriers < 1:
        raise ValueError(f"subcarriers must be at least 1, got {subcarriers}")
    offsets = torch.zeros(1, dtype=torch.float64)
    if subcarriers > 1:
        offsets = torch.linspace(-bandwidth / 2, bandwidth / 2, subcarriers, dtype=torch.float64)
    walls = find_room(room)
    places = place(walls, transmitters, seed)
    receiver = patch_array(walls, frequency)
    paths = find_paths(walls, receiver.pose.position, places, frequency)
    rows = torch.arange(transmitters)
    return Links(
        query=Query(places, torch.zeros_like(rows), torch.full((transmitters,), float(frequency))),
        receivers=(receiver,),
        labels=respond(paths, receiver, frequency, offsets).to(torch.complex64),
        task=Csi(len(receiver.array), frequency + offsets),
        rows=rows,
        official=partial(last_fifth, transmitters, rows),
        edges=edges(walls.meshes()),
    )
