"""Complex channels of the ray tracer's rooms, as a wideband receiver with an antenna array
estimates them.
"""

from collections.abc import Sequence

from gaigs.data import Links
from gaigs.data.bands import hold_out_band
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
    phase: str = "known",
    band_train: Sequence[float] | None = None,
    band_test: Sequence[float] | None = None,
    scene: str | None = None,
    receiver: Sequence[float] | None = None,
    facing: Sequence[float] | None = None,
    heights: Sequence[float] | None = None,
    diffraction: bool = True,
) -> Links:
    """Channels of transmitters at random places in a room, at each element of its 4 x 4 array.

    Rooms, scenes, places, array, diffraction and errors are those of ``sionna``, channels and other
    options those of ``synthetic_csi``.
    """
    receivers = None if receiver is None else [receiver]
    simulated = find_room(room, scene, "receiver", receivers, facing, heights, diffraction)
    links = simulate_channels(
        simulated, transmitters, frequency, bandwidth, subcarriers, seed, phase
    )
    return hold_out_band(links, band_train, band_test)
