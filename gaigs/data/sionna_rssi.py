"""Received signal strength in the ray tracer's rooms, as Bluetooth gateways on their walls report it."""

import torch

from gaigs.data import Links
from gaigs.data.nerf2_rssi import gateway
from gaigs.data.sionna import find_room, place
from gaigs.data.sionna.cache import find_paths
from gaigs.data.sionna.meshes import edges
from gaigs.data.sionna.tracing import frequency_offsets, respond
from gaigs.data.synthetic.image_source import rss_dbm
from gaigs.data.synthetic_rssi import BANDWIDTH, FREQUENCY, as_readings, check_noise
from gaigs.registry import register


@register("data", "sionna_rssi")
def traced_room_rssi(
    room: str = "furnished",
    transmitters: int = 300,
    noise: float = 2.0,
    sensitivity: float = -95.0,
    seed: int = 0,
) -> Links:
    """Signal strength of transmitters of 0 dBm at random places in a room, at four gateways.

    Places are those of ``sionna``, band, noise and what is heard those of ``synthetic_rssi``. A gateway's antenna is
    alike in all directions, so it has no orientation: its axes are the world's. The official split tests on the last
    fifth of the places.

    Args:
        room: ``l_shape``, ``slanted`` or ``furnished``.
        transmitters: How many places.
        noise: Standard deviation of the Gaussian error of each reading [dB].
        sensitivity: Readings below it are not heard, and left out [dBm].
        seed: Of the places and the noise.

    Raises:
        ImportError: Sionna RT is not installed.
        RuntimeError: There is no libLLVM that it can use.
        ValueError: An option is out of range, or a gateway hears nothing.
    """
    check_noise(noise)
    walls = find_room(room)
    places = place(walls, transmitters, seed)
    offsets = frequency_offsets(walls.meshes(), BANDWIDTH)
    receivers = tuple(gateway(name, position) for name, position in walls.gateways)
    strengths = []
    for receiver in receivers:
        paths = find_paths(walls, receiver.pose.position, places, FREQUENCY)
        strengths.append(rss_dbm(respond(paths, receiver, FREQUENCY, offsets)))
    strengths = torch.stack(strengths, 1)
    return as_readings(places, receivers, strengths, noise, sensitivity, seed, edges(walls.meshes()))
