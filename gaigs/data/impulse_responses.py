"""Channels from impulse responses: the gains and delays of paths."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Complex, Float
from numpy import ndarray
from scipy.constants import speed_of_light

from gaigs.core.query import check_carrier
from gaigs.data.parts import check_parts


def to_channels(
    gains: Complex[np.ndarray, "n e p"],
    delays: Float[np.ndarray, "n d p"],
    offsets: Float[np.ndarray, " s"],
) -> Complex[np.ndarray, "n e s"]:
    """Channels sum_p g_p exp(-j 2 pi f t_p) of paths p, complex64.

    Args:
        gains: Gain g of each path at each element, with its phase at the carrier; 0 for a missing
            path.
        delays: Delay t of each path [s], common to all elements (d = 1) or for each element
            (d = e).
        offsets: Subcarriers f relative to the carrier [Hz].

    Example:
        >>> from gaigs.data.impulse_responses import to_channels
        >>> gains = np.array([[[1.0, 0.5j]]])
        >>> delays = np.array([[[0.0, 1e-7]]])  # the second path is 30 m longer
        >>> to_channels(gains, delays, np.array([0.0, 2.5e6])).round(3)
        array([[[1. +0.5j, 1.5+0.j ]]], dtype=complex64)
    """
    # Some links at a time: the waves of all paths take many times the memory of their sums.
    links = 256
    channels = np.zeros((*gains.shape[:2], len(offsets)), np.complex64)
    for first in range(0, len(gains), links):
        part = slice(first, first + links)
        turns = delays[part, ..., None].astype(float) * offsets
        waves = np.exp(-2j * np.pi * turns)  # (k, d, p, s)
        sums = gains[part, :, None] @ waves  # (k, e, 1, s)
        channels[part] = sums[:, :, 0]
    return channels


def lacks_carrier(
    fields: Complex[np.ndarray, " k"],
    delays: Float[np.ndarray, " k"],
    frequency: float,
    otherwise: bool = False,
) -> bool:
    """True if the gains of direct paths lack the phase of their delay at the carrier.

    Gains of some ray tracers lack this phase, and the phases of all direct paths are then similar.

    Args:
        fields: Complex gain of the direct path of each link.
        delays: Delay of these paths [s].
        frequency: Carrier [Hz].
        otherwise: Result for fewer than ten direct paths.
    """
    if len(fields) < 10:
        return otherwise
    units = fields / np.abs(fields)
    # Magnitude of the mean phasor is 1 for equal phases. If gains have the carrier's phase, phases
    # are equal after it is removed; otherwise they are equal as given.
    as_given = abs(units.mean())
    without_carrier = abs((units * np.exp(2j * np.pi * frequency * delays)).mean())
    return bool(as_given > max(0.9, without_carrier))


class Responses(NamedTuple):
    """Impulse responses of p paths from n transmitters to k receivers.

    A transmitter has m antennas, a receiver has e.
    """

    gains: Complex[ndarray, "k e n m p"]  # complex gain of each path
    delays: ndarray  # (k, e, n, m, p), or (k, 1, n, 1, p) if common to all antennas [s]
    tx: ndarray  # places of the transmitters (n, 3) [m]
    rx: ndarray  # places of the receivers (k, 3) [m]


def from_sionna(
    arrays: Mapping[str, np.ndarray], needs_delays: bool
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Arrays of ``gaigs.data.csi_npz`` from impulse responses of Sionna RT, and remarks.

    ``sionna.rt.Paths.cir`` gives these responses. Gains of ``sionna.rt.Paths.a`` lack the phase of
    the delay at the carrier, which is then added. ``lacks_carrier`` recognises such gains by the
    links in line of sight: their first delay is the distance over the speed of light. By
    reciprocity the end with fewer places becomes the fixed end; in a tie the receivers.

    Args:
        arrays: ``a`` (k, e, n, m, p, 1) and ``tau`` (k, n, p) or (k, e, n, m, p), for k receivers
            ``rx`` with e antennas each and n transmitters ``tx`` with m antennas each; ``carrier``
            [Hz]; ``frequencies``, absolute or relative to the carrier [Hz].
        needs_delays: True if delays must count from the transmission.
    """
    carrier = _read_carrier(arrays)
    responses = _with_fixed_end(_without_missing_delays(_to_responses(arrays), needs_delays))
    tx = responses.tx
    rx = responses.rx
    # Links are sorted by transmitter, then by receiver.
    gains = _by_links(responses.gains)  # (links, e, p)
    delays = _by_links(responses.delays)
    subcarriers = arrays["frequencies"]
    is_relative = (np.abs(subcarriers) < carrier / 2).all()
    frequencies = subcarriers + (carrier if is_relative else 0.0)
    distances = np.linalg.norm(tx[:, None] - rx, axis=2).reshape(-1)  # (links,)

    # Distances are from the receiver's position. The element nearest to it represents the array.
    central = 0
    if "elements" in arrays and arrays["elements"].ndim == 2:
        central = int(np.linalg.norm(arrays["elements"], axis=1).argmin())
    fields = gains[:, central]  # (links, p)
    times = delays[:, min(central, delays.shape[1] - 1)]  # common delays have one element
    # The first path of each link.
    first = np.where(fields != 0, times, np.inf).argmin(1, keepdims=True)  # (links, 1)
    fields = np.take_along_axis(fields, first, 1)[:, 0]
    times = np.take_along_axis(times, first, 1)[:, 0]
    excess = np.abs(times * speed_of_light - distances)  # length beyond the distance [m]
    is_direct = (fields != 0) & (excess < 0.1 + 1e-3 * distances)
    remarks = []
    if lacks_carrier(fields[is_direct], times[is_direct], carrier):
        gains = gains * np.exp(-2j * np.pi * carrier * delays.astype(float))
        remarks.append("phases of a lack the carrier's over the delay, and get it")
    channels = {
        "tx": tx.repeat(len(rx), 0),
        "rx": rx,
        "rx_index": np.tile(np.arange(len(rx)), len(tx)),
        "frequencies": frequencies,
        "h": to_channels(gains.astype(complex), delays, frequencies - carrier),
    }
    if "elements" in arrays:
        channels["elements"] = arrays["elements"]
    return channels, remarks


def _read_carrier(arrays: Mapping[str, np.ndarray]) -> float:
    """The carrier [Hz]; a ``ValueError`` if it, or another array that must be real, is not real."""
    for name, array in arrays.items():
        if name != "a" and array.dtype.kind not in "iuf":
            raise ValueError(f"{name}: expected real numbers, got {array.dtype}")
    carrier = arrays["carrier"]
    if carrier.size != 1:
        raise ValueError(f"carrier: expected one number [Hz], got an array of {carrier.shape}")
    check_carrier("carrier", float(carrier.item()))
    return float(carrier.item())


def _to_responses(arrays: Mapping[str, np.ndarray]) -> Responses:
    """Impulse responses of the arrays that ``from_sionna`` describes.

    Real and imaginary part may also be along a first axis of 2. A ``ValueError`` for other shapes.
    """
    a, tau, tx, rx = (arrays[name] for name in ("a", "tau", "tx", "rx"))
    if a.dtype.kind == "f" and a.ndim == 7 and len(a) == 2:
        a = a[0] + 1j * a[1]
    if a.dtype.kind != "c" or a.ndim != 6 or a.shape[5] != 1:
        raise ValueError(
            "a: expected complex numbers of (rx, rx_ant, tx, tx_ant, paths, 1), "
            f"got {a.dtype} of {a.shape}; save a, "
            "tau = paths.cir(normalize_delays=False, out_type='numpy')"
        )
    a = a[..., 0]  # (k, e, n, m, p)
    check_parts("a", a[a != 0])
    delays = tau[:, None, :, None] if tau.ndim == 3 else tau
    shared = (a.shape[0], 1, a.shape[2], 1, a.shape[4])  # delays common to all antennas
    fits = tx.shape == (a.shape[2], 3) and rx.shape == (a.shape[0], 3)
    if not fits or delays.shape not in (a.shape, shared):
        expected = f"tx {(a.shape[2], 3)}, rx {(a.shape[0], 3)}"
        raise ValueError(
            f"a of {a.shape}: expected {expected} and tau {a.shape} or without antennas, "
            f"got {tx.shape}, {rx.shape} and {tau.shape}"
        )
    return Responses(a, delays, tx, rx)


def _without_missing_delays(responses: Responses, needs_delays: bool) -> Responses:
    """Responses with delays of 0 for missing paths, whose gain is 0.

    Raises:
        ValueError: A delay is out of range, or ``needs_delays`` is true and delays count from the
            first path in place of the transmission.
    """
    gains = responses.gains
    exists = gains != 0
    delays = np.where(exists, responses.delays, 0)
    if not ((delays >= 0) & (delays < 1e-3)).all():
        raise ValueError("tau: expected a delay of 0 to 1 ms in seconds where a is not 0")
    if needs_delays and exists.any():
        # Delays from the first path are 0 for the first path of every link.
        earliest = np.where(exists, responses.delays, np.inf).min(-1)  # (k, e, n, m)
        if not earliest[exists.any(-1)].any():
            raise ValueError(
                "tau: expected delays from the transmission on, got 0 for the first path of every "
                "link; save those of paths.cir(normalize_delays=False), "
                "or set data.phase=per_link_and_delay"
            )
    return responses._replace(delays=delays)


def _with_fixed_end(responses: Responses) -> Responses:
    """Responses with the end of fewer places as receivers.

    Raises:
        ValueError: The other end has several antennas at a place.
    """
    gains, delays, tx, rx = responses
    if len(tx) < len(rx):
        gains = gains.transpose(2, 3, 0, 1, 4)
        delays = delays.transpose(2, 3, 0, 1, 4)
        responses = Responses(gains, delays, tx=rx, rx=tx)
    antennas = responses.gains.shape[3]
    if antennas != 1:
        raise ValueError(f"a: expected one antenna at each place of the moving end, got {antennas}")
    return responses


def _by_links(array: ndarray) -> ndarray:
    """Values (k, e, n, m, p) as (n x k, e, p), of the first antenna m of each transmitter n."""
    single = array[:, :, :, 0]  # (k, e, n, p)
    by_links = single.transpose(2, 0, 1, 3)  # (n, k, e, p)
    return by_links.reshape(-1, *by_links.shape[2:])
