"""Received signal strength in the ray tracer's rooms, as Bluetooth gateways on their walls report
it.
"""

from collections.abc import Sequence

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
    scene: str | None = None,
    receivers: Sequence[Sequence[float]] | None = None,
    heights: Sequence[float] | None = None,
    diffraction: bool = True,
) -> Links:
    """Signal strength of transmitters of 0 dBm at random places in a room, at four gateways.

    Rooms, scenes, places, diffraction and errors are those of ``sionna``, readings and other
    options those of ``synthetic_rssi``.

    Args:
        receivers: Positions of the gateways in the scene [m].
    """
    simulated = find_room(room, scene, "receivers", receivers, None, heights, diffraction)
    return simulate_readings(simulated, transmitters, noise, sensitivity, seed)
