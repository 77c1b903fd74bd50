"""Spectra, channels and signal strengths of traced rooms."""

from collections.abc import Sequence

from gaigs.data import Links
from gaigs.data.bands import hold_out_band
from gaigs.data.simulation import simulate_channels, simulate_readings, simulate_spectra

from .simulation import find_room


def traced_room(
    room: str = "furnished",
    spectrum: str = "band",
    transmitters: int = 300,
    frequency: float | Sequence[float] = 6.4896e9,
    bandwidth: float = 499.2e6,
    seed: int = 0,
    scene: str | None = None,
    receiver: Sequence[float] | None = None,
    facing: Sequence[float] | None = None,
    heights: Sequence[float] | None = None,
    diffraction: bool = True,
    receivers: int | Sequence[Sequence[float]] | None = None,
) -> Links:
    """Spectra of transmitters at random places in a room.

    The official split tests on the last fifth of the places. Paths are traced the first time, which
    takes a minute, and stored. The other options are those of ``synthetic``.

    Args:
        room: ``l_shape``, ``slanted`` or ``furnished``.
        scene: File of one's own surfaces, as ``sionna.rt.load_scene`` loads it (Mitsuba XML); None
            for the room.
        receiver: Position of a single array in the scene [m].
        facing: Point in the scene that arrays face [m]; None for the middle of all surfaces.
        heights: Lowest and highest z of transmitters in the scene [m]; None for 0.3 to 2 m above
            the lowest surface.
        diffraction: False if edges bend no waves, the default of Sionna RT itself.
        receivers: Number of arrays along the room's walls, as of ``synthetic``, or their positions
            in the scene [m]; None: one in a corner, or ``receiver``.

    Raises:
        FileNotFoundError: There is no such scene.
        ImportError: Sionna RT is not installed.
        RuntimeError: There is no libLLVM that it can use.
        ValueError: An option is out of range, or the scene cannot be loaded.
    """
    positions = _receivers(receiver, receivers)
    simulated = find_room(room, scene, *positions, facing, heights, diffraction)
    return simulate_spectra(simulated, spectrum, transmitters, frequency, bandwidth, seed)


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
    receivers: int | Sequence[Sequence[float]] | None = None,
) -> Links:
    """Channels of transmitters at random places in a room, at each element of its 4 x 4 array.

    A wideband receiver estimates them.

    Args:
        room, transmitters, scene, receiver, facing, heights, diffraction, receivers: See
            ``sionna``, which raises the same errors.
        frequency, bandwidth, subcarriers, seed, phase, band_train, band_test: See
            ``synthetic_csi``.
    """
    positions = _receivers(receiver, receivers)
    simulated = find_room(room, scene, *positions, facing, heights, diffraction)
    links = simulate_channels(
        simulated, transmitters, frequency, bandwidth, subcarriers, seed, phase
    )
    return hold_out_band(links, band_train, band_test)


def traced_room_rssi(
    room: str = "furnished",
    transmitters: int = 300,
    noise: float = 2.0,
    sensitivity: float = -95.0,
    seed: int = 0,
    scene: str | None = None,
    receivers: int | Sequence[Sequence[float]] | None = None,
    heights: Sequence[float] | None = None,
    diffraction: bool = True,
) -> Links:
    """Signal strength of transmitters of 0 dBm at random places in a room, at four gateways.

    Bluetooth gateways on the walls report it.

    Args:
        room, transmitters, scene, heights, diffraction: See ``sionna``, which raises the same
            errors.
        noise, sensitivity, seed: See ``synthetic_rssi``.
        receivers: Number of gateways along the room's walls, as of ``synthetic``, or their
            positions in the scene [m]; None: the room's four.
    """
    simulated = find_room(room, scene, "receivers", receivers, None, heights, diffraction)
    return simulate_readings(simulated, transmitters, noise, sensitivity, seed)


def _receivers(
    receiver: Sequence[float] | None, receivers: int | Sequence[Sequence[float]] | None
) -> tuple[str, int | Sequence[Sequence[float]] | None]:
    """Name and value of the option that has the receivers."""
    if receiver is None:
        return "receivers", receivers
    if receivers is not None:
        raise ValueError("give data.receiver or data.receivers, got both")
    return "receiver", [receiver]
