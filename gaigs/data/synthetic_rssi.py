"""Received signal strength in the built-in room, as Bluetooth gateways on its walls report it."""

import math
from functools import partial

import torch

from gaigs.data import Links
from gaigs.data.nerf2_rssi import gateway
from gaigs.data.synthetic import ROOM, edges, last_fifth, place
from gaigs.data.synthetic.image_source import frequency_offsets, respond, rss_dbm
from gaigs.query import Query
from gaigs.registry import register
from gaigs.task.rssi import Rssi

FREQUENCY, BANDWIDTH = 2.441e9, 78e6
"""Middle and width of the band that Bluetooth's advertising channels span, 2.402 to 2.480 GHz [Hz]."""

GATEWAYS = {
    "west": (0.1, 2.6, 2.4),
    "south": (1.7, 0.1, 1.2),  # the partition stands between it and most of the room
    "east": (6.9, 1.4, 1.6),
    "north": (2.4, 4.9, 2.0),
}
"""Positions by the wall that the gateway hangs on, world frame [m]."""


@register("data", "synthetic_rssi")
def furnished_room_rssi(
    transmitters: int = 600,
    noise: float = 2.0,
    sensitivity: float = -95.0,
    order: int = 2,
    seed: int = 0,
) -> Links:
    """Signal strength of transmitters of 0 dBm at random places in the default room, at four gateways.

    Every antenna is isotropic, so a gateway has no orientation: its axes are the world's. Power is averaged over the
    band before it is told in dB. The links of one place share a row; the official split tests on the last fifth of the
    places.

    Args:
        transmitters: How many places.
        noise: Standard deviation of the Gaussian error of each reading [dB].
        sensitivity: Readings below it are not heard, and left out [dBm].
        order: Largest number of reflections of a path.
        seed: Of the places and the noise.

    Raises:
        ValueError: An option is out of range, or a gateway hears nothing.
    """
    if not 0 <= noise < math.inf:
        raise ValueError(f"noise must be a standard deviation, 0 or more [dB], got {noise}")
    places = place(transmitters, seed)
    offsets = frequency_offsets(ROOM, BANDWIDTH, order)
    receivers = tuple(gateway(name, position) for name, position in GATEWAYS.items())
    readings = torch.stack(
        [rss_dbm(respond(ROOM, places, receiver, FREQUENCY, offsets, order)) for receiver in receivers], 1
    )
    # A seed of its own: from the places' seed come the random numbers that the places are made of.
    generator = torch.Generator().manual_seed(hash((seed, 1)) % 2**63)
    readings += noise * torch.randn(readings.shape, dtype=readings.dtype, generator=generator)
    heard = readings >= sensitivity
    for name, any_heard in zip(GATEWAYS, heard.any(0), strict=True):
        if not any_heard:
            raise ValueError(
                f"sensitivity must let each gateway hear a reading, but {name!r} hears none of {transmitters} at "
                f"{sensitivity:g} dBm; lower it"
            )
    rows, columns = heard.nonzero(as_tuple=True)
    return Links(
        query=Query(places[rows], columns, torch.full((len(rows),), FREQUENCY)),
        receivers=receivers,
        labels=readings[heard].float(),
        task=Rssi(),
        rows=rows,
        official=partial(last_fifth, transmitters, rows),
        bandwidth=BANDWIDTH,
        edges=edges(ROOM),
        remarks=(
            f"{len(rows)} readings of {transmitters} places at {len(GATEWAYS)} gateways; "
            f"{int((~heard).sum())} below {sensitivity:g} dBm were not heard and are left out"
        ),
    )
