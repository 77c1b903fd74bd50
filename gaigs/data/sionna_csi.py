"""Complex channels of the ray tracer's rooms, as a wideband receiver with an antenna array estimates them."""

from gaigs.data import Links
from gaigs.data.simulation import simulate_channels
from gaigs.data.sionna import find_room
from gaigs.registry import register


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

    Places, paths and array are those of ``sionna``; unit and time dependence are those of
    ``gaigs.data.simulation.simulate_channels``. The official split tests on the last fifth of the places.

    Args:
        room: ``l_shape``, ``slanted`` or ``furnished``.
        transmitters: Number of places.
        frequency: Carrier [Hz].
        bandwidth: From the lowest subcarrier to the highest, about the carrier [Hz].
        subcarriers: Number of subcarriers, evenly over the band; a single one is the carrier.
        seed: Seed of the places.

    Raises:
        ImportError: Sionna RT is not installed.
        RuntimeError: There is no libLLVM that it can use.
        ValueError: An option is out of range.
    """
    return simulate_channels(find_room(room), transmitters, frequency, bandwidth, subcarriers, seed)
