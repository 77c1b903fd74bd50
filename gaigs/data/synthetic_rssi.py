"""Received signal strength in the built-in room, as Bluetooth gateways on its walls report it."""

import math
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from gaigs.data import Links
from gaigs.data.nerf2_rssi import gateway
from gaigs.data.synthetic import ROOM, edges, last_fifth, place
from gaigs.data.synthetic.image_source import frequency_offsets, respond, rss_dbm
from gaigs.query import Query
from gaigs.registry import register
from gaigs.scene import Receiver
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
    check_noise(noise)
    places = place(transmitters, seed)
    offsets = frequency_offsets(ROOM, BANDWIDTH, order)
    receivers = tuple(gateway(name, position) for name, position in GATEWAYS.items())
    strengths = torch.stack(
        [rss_dbm(respond(ROOM, places, receiver, FREQUENCY, offsets, order)) for receiver in receivers], 1
    )
    return as_readings(places, receivers, strengths, noise, sensitivity, seed, edges(ROOM))


def check_noise(noise: float) -> None:
    """Raises a ``ValueError`` unless it is a standard deviation [dB]."""
    if not 0 <= noise < math.inf:
        raise ValueError(f"noise must be a standard deviation, 0 or more [dB], got {noise}")


def as_readings(
    places: Float[Tensor, "n 3"],
    receivers: tuple[Receiver, ...],
    strengths: Float[Tensor, "n r"],
    noise: float,
    sensitivity: float,
    seed: int,
    edges: Float[Tensor, "k 2 3"],
) -> Links:
    """Links of simulated strengths, as Bluetooth gateways report them; the official split tests on the last fifth.

    Args:
        places: Of the transmitters [m].
        receivers: The gateways.
        strengths: Of each transmitter at each gateway, float64 [dBm].
        noise: Standard deviation of the Gaussian error of each reading [dB].
        sensitivity: Readings below it are not heard, and left out [dBm].
        seed: Of the noise.
        edges: Of the room, for figures [m].

    Raises:
        ValueError: A gateway hears nothing.
    """
    # A seed of its own: from the places' seed come the random numbers that the places are made of.
    generator = torch.Generator().manual_seed(hash((seed, 1)) % 2**63)
    readings = strengths + noise * torch.randn(strengths.shape, dtype=strengths.dtype, generator=generator)
    heard = readings >= sensitivity
    for receiver, any_heard in zip(receivers, heard.any(0), strict=True):
        if not any_heard:
            raise ValueError(
                f"sensitivity must let each gateway hear a reading, but {receiver.name!r} hears none of {len(places)} "
                f"at {sensitivity:g} dBm; lower it"
            )
    rows, columns = heard.nonzero(as_tuple=True)
    return Links(
        query=Query(places[rows], columns, torch.full((len(rows),), FREQUENCY)),
        receivers=receivers,
        labels=readings[heard].float(),
        task=Rssi(),
        rows=rows,
        official=partial(last_fifth, len(places), rows),
        bandwidth=BANDWIDTH,
        edges=edges,
        remarks=(
            f"{len(rows)} readings of {len(places)} places at {len(receivers)} gateways; "
            f"{int((~heard).sum())} below {sensitivity:g} dBm were not heard and are left out"
        ),
    )
