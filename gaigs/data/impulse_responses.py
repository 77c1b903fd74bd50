"""Channels from impulse responses: the gains and delays of paths."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Complex, Float
from scipy.constants import speed_of_light

from gaigs.core.query import check_carrier
from gaigs.data.parts import check_parts

PART = 256
"""Links summed at a time, since the waves of all paths take many times the memory of their sums."""


def to_channels(
    gains: Complex[np.ndarray, "n e p"],
    delays: Float[np.ndarray, "n d p"],
    offsets: Float[np.ndarray, " s"],
) -> Complex[np.ndarray, "n e s"]:
    """Channels sum_p g_p exp(-j 2 pi f t_p), complex64, from gains at the carrier that include its
    phase.

    Args:
        gains: Baseband-equivalent gain of each path at each element; 0 for no path.
        delays: Of each path, for all elements or for each [s].
        offsets: Subcarriers relative to the carrier [Hz].

    Example:
        >>> from gaigs.data.impulse_responses import to_channels
        >>> gains, delays = np.array([[[1.0, 0.5j]]]), np.array([[[0.0, 1e-7]]])  # a second path 30 m longer
        >>> to_channels(gains, delays, np.array([0.0, 2.5e6])).round(3)
        array([[[1. +0.5j, 1.5+0.j ]]], dtype=complex64)
    """
    found = np.zeros((*gains.shape[:2], len(offsets)), np.complex64)
    for first in range(0, len(gains), PART):
        part = slice(first, first + PART)
        waves = np.exp(-2j * np.pi * delays[part, ..., None].astype(float) * offsets)
        found[part] = (gains[part, :, None] @ waves)[:, :, 0]
    return found


def lacks_carrier(
    fields: Complex[np.ndarray, " k"],
    delays: Float[np.ndarray, " k"],
    frequency: float,
    otherwise: bool = False,
) -> bool:
    """True if gains of lines of sight are without the phase of their delay at the carrier: all
    phases are alike.

    Ray tracers may give gains so. Fewer than ten lines of sight leave it to ``otherwise``.
    """
    if len(fields) < 10:
        return otherwise
    units = fields / np.abs(fields)
    alike, included = (
        abs(units.mean()),
        abs((units * np.exp(2j * np.pi * frequency * delays)).mean()),
    )
    return bool(alike > max(0.9, included))


def from_sionna(
    arrays: Mapping[str, np.ndarray], needs_delays: bool
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Arrays of ``gaigs.data.csi_npz`` from impulse responses as ``sionna.rt.Paths.cir`` gives
    them, and remarks.

    Gains without the phase of the delay at the carrier, as of ``sionna.rt.Paths.a``, get it. Lines
    of sight show it: first paths whose delay is the distance over the speed of light. The end with
    fewer places, the receivers in a tie, becomes the fixed one; a channel is the same both ways.

    Args:
        arrays: ``a`` (k, e, n, m, p, 1) and ``tau`` (k, n, p) or (k, e, n, m, p), of k receivers
            ``rx`` with e antennas and n transmitters ``tx`` with m; ``carrier`` [Hz];
            ``frequencies``, absolute or relative to it [Hz].
        needs_delays: True if delays must count from the transmission.

    Raises:
        ValueError: Shapes do not fit, or a delay is none.
    """
    for name, array in arrays.items():
        if name != "a" and array.dtype.kind not in "iuf":
            raise ValueError(f"{name}: expected real numbers, got {array.dtype}")
    if arrays["carrier"].size != 1:
        raise ValueError(
            f"carrier: expected one number [Hz], got an array of {arrays['carrier'].shape}"
        )
    a, tau, tx, rx, subcarriers = (arrays[name] for name in ("a", "tau", "tx", "rx", "frequencies"))
    carrier = float(arrays["carrier"].item())
    check_carrier("carrier", carrier)
    if a.dtype.kind == "f" and a.ndim == 7 and len(a) == 2:
        a = a[0] + 1j * a[1]
    if a.dtype.kind != "c" or a.ndim != 6 or a.shape[5] != 1:
        raise ValueError(
            f"a: expected complex numbers of (rx, rx_ant, tx, tx_ant, paths, 1), got {a.dtype} of {a.shape}; save a, "
            "tau = paths.cir(normalize_delays=False, out_type='numpy')"
        )
    a = a[..., 0]
    check_parts("a", a[a != 0])
    tau = tau[:, None, :, None] if tau.ndim == 3 else tau
    shared = (a.shape[0], 1, a.shape[2], 1, a.shape[4])  # the delays of a synthetic array
    if (
        tx.shape != (a.shape[2], 3)
        or rx.shape != (a.shape[0], 3)
        or tau.shape not in (a.shape, shared)
    ):
        expected = (
            f"tx {(a.shape[2], 3)}, rx {(a.shape[0], 3)} and tau {a.shape} or without antennas"
        )
        raise ValueError(
            f"a of {a.shape}: expected {expected}, got {tx.shape}, {rx.shape} and {arrays['tau'].shape}"
        )
    exists = a != 0
    delays = np.where(exists, tau, 0)
    if not ((delays >= 0) & (delays < 1e-3)).all():
        raise ValueError("tau: expected a delay of 0 to 1 ms in seconds where a is not 0")
    if (
        needs_delays
        and exists.any()
        and not np.where(exists, tau, np.inf).min(-1)[exists.any(-1)].any()
    ):
        raise ValueError(
            "tau: expected delays from the transmission on, got 0 for the first path of every link; save those of "
            "paths.cir(normalize_delays=False), or set data.phase=per_link_and_delay"
        )
    if len(tx) < len(rx):
        a, delays, tx, rx = a.transpose(2, 3, 0, 1, 4), delays.transpose(2, 3, 0, 1, 4), rx, tx
    if a.shape[3] != 1:
        raise ValueError(
            f"a: expected one antenna at each place of the moving end, got {a.shape[3]}"
        )
    # Links run over the transmitters, and over the receivers of each.
    gains, delays = (
        part[:, :, :, 0].transpose(2, 0, 1, 3).reshape(-1, *part[0, :, 0, 0].shape)
        for part in (a, delays)
    )
    is_relative = (np.abs(subcarriers) < carrier / 2).all()
    frequencies = subcarriers + (carrier if is_relative else 0.0)
    distances = np.linalg.norm(tx[:, None] - rx, axis=2).reshape(-1)  # (links,)
    near = np.zeros(1, int)  # the element next to the receiver's position
    if "elements" in arrays and arrays["elements"].ndim == 2:
        near = np.linalg.norm(arrays["elements"], axis=1).argmin(keepdims=True)
    own, times = gains[:, near[0]], delays[:, min(near[0], delays.shape[1] - 1)]  # (links, p)
    first = np.where(own != 0, times, np.inf).argmin(1, keepdims=True)
    own, times = (np.take_along_axis(part, first, 1)[:, 0] for part in (own, times))
    is_direct = (own != 0) & (np.abs(times * speed_of_light - distances) < 0.1 + 1e-3 * distances)
    remarks = []
    if lacks_carrier(own[is_direct], times[is_direct], carrier):
        gains = gains * np.exp(-2j * np.pi * carrier * delays.astype(float))
        remarks.append("phases of a lack the carrier's over the delay, and get it")
    return {
        "tx": tx.repeat(len(rx), 0),
        "rx": rx,
        "rx_index": np.tile(np.arange(len(rx)), len(tx)),
        "frequencies": frequencies,
        "h": to_channels(gains.astype(complex), delays, frequencies - carrier),
        **{name: arrays[name] for name in ("elements",) if name in arrays},
    }, remarks
