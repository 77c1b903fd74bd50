"""Complex channels of the built-in room, as a wideband receiver with an antenna array estimates them."""

import math
from functools import partial

import torch

from gaigs.data import Links
from gaigs.data.synthetic import ROOM, edges, last_fifth, patch_array, place
from gaigs.data.synthetic.image_source import respond
from gaigs.query import Query
from gaigs.registry import register
from gaigs.task.csi import Csi


@register("data", "synthetic_csi")
def furnished_room_csi(
    transmitters: int = 500,
    frequency: float = 6.4896e9,
    bandwidth: float = 499.2e6,
    subcarriers: int = 26,
    order: int = 2,
    seed: int = 0,
) -> Links:
    """Channels of transmitters at random places in the default room, at each element of its 4 x 4 array.

    Places, array and band are those of ``synthetic``. A channel is in Friis' unit: its magnitude is the square root of
    the power that an element receives of a unit power sent, between antennas of unit gain. Its time dependence is
    exp(+j omega t). There is no noise. The official split tests on the last fifth of the places.

    Args:
        transmitters: How many.
        frequency: Of the carrier [Hz].
        bandwidth: From the lowest subcarrier to the highest, about the carrier [Hz].
        subcarriers: How many, evenly over the band; a single one is the carrier.
        order: Largest number of reflections of a path.
        seed: Of the transmitters' places.

    Raises:
        ValueError: An option is out of range.
    """
    if not 0 < bandwidth < math.inf:
        raise ValueError(f"bandwidth must be positive [Hz], got {bandwidth}")
    if subcarriers < 1:
        raise ValueError(f"subcarriers must be at least 1, got {subcarriers}")
    offsets = torch.zeros(1, dtype=torch.float64)
    if subcarriers > 1:
        offsets = torch.linspace(-bandwidth / 2, bandwidth / 2, subcarriers, dtype=torch.float64)
    places = place(transmitters, seed)
    receiver = patch_array(frequency)
    # In parts, because the waves of all paths, elements and subcarriers at once would need a hundred times the memory.
    channels = [respond(ROOM, part, receiver, frequency, offsets, order) for part in places.split(64)]
    rows = torch.arange(transmitters)
    return Links(
        query=Query(places, torch.zeros_like(rows), torch.full((transmitters,), float(frequency))),
        receivers=(receiver,),
        labels=torch.cat(channels).to(torch.complex64),
        task=Csi(len(receiver.array), frequency + offsets),
        rows=rows,
        official=partial(last_fifth, transmitters, rows),
        edges=edges(ROOM),
    )
