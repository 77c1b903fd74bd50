"""Complex channels of the built-in room, at a wideband receiver with an antenna array."""

from collections.abc import Sequence

from gaigs.data import Links
from gaigs.data.bands import hold_out_band
from gaigs.data.simulation import simulate_channels
from gaigs.data.synthetic import default_room
from gaigs.registry import register


@register("data", "synthetic_csi", task="csi", split="official")
def furnished_room_csi(
    transmitters: int = 500,
    frequency: float = 6.4896e9,
    bandwidth: float = 499.2e6,
    subcarriers: int = 26,
    order: int = 2,
    seed: int = 0,
    phase: str = "known",
    band_train: Sequence[float] | None = None,
    band_test: Sequence[float] | None = None,
    receivers: int | None = None,
) -> Links:
    """Channels of transmitters at random places in the default room, at its 4 x 4 array.

    ``synthetic`` describes places, array and other options.
    ``gaigs.data.simulation.simulate_channels`` describes unit and time dependence. The official
    split tests on the last fifth of the places.

    Args:
        bandwidth: Difference of the highest and the lowest subcarrier, centred on the carrier [Hz].
        subcarriers: Number of subcarriers, evenly spaced over the band; a single one is the
            carrier.
        phase: See ``gaigs.core.task.csi.Csi``. Links get random phases unless it is ``known``.
        band_train, band_test: Subcarriers to train and to test on, as for
            ``gaigs.data.bands.hold_out_band`` [Hz].
        receivers: Number of arrays on the walls, as for ``synthetic``; None: one array in a corner.

    Raises:
        ValueError: An option is out of range.
    """
    links = simulate_channels(
        default_room(order, receivers),
        transmitters,
        frequency,
        bandwidth,
        subcarriers,
        seed,
        phase,
    )
    return hold_out_band(links, band_train, band_test)
