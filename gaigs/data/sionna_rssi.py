"""Received signal strength in the ray tracer's rooms, as Bluetooth gateways on their walls report it."""

from gaigs.data import Links
from gaigs.data.simulation import simulate_readings
from gaigs.data.sionna import find_room
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

    Places are those of ``sionna``. A gateway's antenna is isotropic, so it has no orientation: its axes are the
    world's. The official split tests on the last fifth of the places.

    Args:
        room: ``l_shape``, ``slanted`` or ``furnished``.
        transmitters: Number of places.
        noise: Standard deviation of the Gaussian error of each reading [dB].
        sensitivity: Readings below it are not heard, and left out [dBm].
        seed: Seed of places and noise.

    Raises:
        ImportError: Sionna RT is not installed.
        RuntimeError: There is no libLLVM that it can use.
        ValueError: An option is out of range, or a gateway hears nothing.
    """
    return simulate_readings(find_room(room), transmitters, noise, sensitivity, seed)
