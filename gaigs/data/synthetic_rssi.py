"""Received signal strength in the built-in room, as Bluetooth gateways on its walls report it."""

from gaigs.data import Links
from gaigs.data.simulation import simulate_readings
from gaigs.data.synthetic import default_room
from gaigs.registry import register


@register("data", "synthetic_rssi", task="rssi", split="official")
def furnished_room_rssi(
    transmitters: int = 600,
    noise: float = 2.0,
    sensitivity: float = -95.0,
    order: int = 2,
    seed: int = 0,
    receivers: int | None = None,
) -> Links:
    """Signal strength of transmitters of 0 dBm at random places in the default room.

    There are four gateways with isotropic antennas. Links of one place share a row. The official
    split tests on the last fifth of the places.

    Args:
        noise: Standard deviation of the Gaussian error of each reading [dB].
        sensitivity: Readings below this level [dBm] are not received, and left out.
        receivers: Number of gateways along the walls, as for ``synthetic``; None: the four
            gateways.

    Raises:
        ValueError: An option is out of range, or a gateway receives nothing.
    """
    room = default_room(order, receivers)
    return simulate_readings(room, transmitters, noise, sensitivity, seed)
