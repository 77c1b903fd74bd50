"""Complex channels of the built-in room, as a wideband receiver with an antenna array estimates them."""

from gaigs.data import Links
from gaigs.data.simulation import simulate_channels
from gaigs.data.synthetic import default_room
from gaigs.registry import register


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

    Places, array and other options are those of ``synthetic``; unit and time dependence are those of
    ``gaigs.data.simulation.simulate_channels``. The official split tests on the last fifth of the places.

    Args:
        bandwidth: From the lowest subcarrier to the highest, about the carrier [Hz].
        subcarriers: Evenly over the band; a single one is the carrier.

    Raises:
        ValueError: An option is out of range.
    """
    return simulate_channels(default_room(order), transmitters, frequency, bandwidth, subcarriers, seed)
