"""Links of ``Paths`` and ``RadioMap`` objects of Sionna RT."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from scipy.constants import speed_of_light

from gaigs.data import Links, divide
from gaigs.data.arrays import from_arrays, split_configuration
from gaigs.data.csi_npz import to_links


def is_traced(source: object) -> bool:
    """True for ``sionna.rt.Paths`` and ``sionna.rt.RadioMap``."""
    return _has(source, "cir", "sources", "targets") or _has(source, "rss", "cell_centers")


def _has(source: object, *names: str) -> bool:
    """True if the class of an object has all attributes.

    The object itself would compute an attribute when asked.
    """
    return all(hasattr(type(source), name) for name in names)


def from_sionna_rt(
    source: Any,
    frequencies: Any = None,
    frequency: Any = None,
    receivers: Any = None,
    elements: Any = None,
    phase: str = "known",
    split: str | Mapping | None = None,
    **options: Any,
) -> Links:
    """Links of ``sionna.rt.Paths`` or ``sionna.rt.RadioMap``, with their split.

    The end with fewer places becomes the receivers, since channels are equal in both directions.
    ``Paths`` become channels at ``frequencies``. Without these they become levels, sums of the
    paths' powers for a transmitter of 0 dBm. A ``RadioMap`` becomes levels of its cells [dBm],
    without cells that no path reaches.

    Args:
        source: The object.
        frequencies: Subcarriers, absolute or relative to the carrier (s,) [Hz]. None: levels.
        frequency: Carrier [Hz]; None: the carrier that the object stores, if any.
        receivers: Positions of a radio map's transmitters (k, 3) [m], or by name. None: the
            positions that the object stores.
        elements: Offsets of the receiver array's elements along the world's axes (e, 3) [m]. None:
            offsets from the object; with ``synthetic_array`` devices count as not rotated. Offsets
            are unknown if several antennas share an element.
        phase: See ``gaigs.core.task.csi.Csi``.
        split: Name of a registered split, whose options are in ``options``; None: ``random``.

    Raises:
        ValueError: A path has no carrier or no delay, or an option does not apply to the object.
    """
    config = split_configuration("objects of Sionna RT", from_sionna_rt, split, options)
    if frequency is None:
        frequency = getattr(source, "_frequency", None)
    carrier = None if frequency is None else float(np.ravel(np.array(frequency))[0])
    if not _has(source, "cir"):
        if frequencies is not None:
            raise ValueError(
                "a radio map has levels and no channels; leave frequencies out, or give Paths"
            )
        return _of_map(source, receivers, carrier, config)
    if receivers is not None:
        raise ValueError("paths know the places of both ends; leave receivers out")
    if carrier is None:
        raise ValueError("paths of this Sionna RT keep no carrier; set frequency=scene.frequency")
    rx = _places(source.targets, source.num_rx)  # (k, antennas, 3)
    tx = _places(source.sources, source.num_tx)  # (n, antennas, 3)
    # (k, e, n, m, p, 1): fields with the carrier's phase, which ``Paths.a`` lacks.
    gains, delays = source.cir(normalize_delays=False, out_type="numpy")
    if frequencies is None:
        powers = np.square(np.abs(gains[..., 0])).sum(-1)  # (k, e, n, m)
        levels = _decibels(powers.mean((1, 3)))  # mean over antennas (k, n)
        ends = {"transmitters": rx.mean(1), "receivers": tx.mean(1)}
        if len(rx) <= len(tx):
            ends = {"transmitters": tx.mean(1), "receivers": rx.mean(1)}
            levels = levels.T
        return from_arrays("rssi", labels=levels, frequency=carrier, split=config, **ends)
    arrays = {
        "a": gains,
        "tau": delays,
        "rx": rx.mean(1),
        "tx": tx.mean(1),
        "carrier": np.array([carrier]),
        "frequencies": np.ravel(np.array(frequencies, float)),
    }
    offsets = _elements(source, rx, tx, carrier) if elements is None else np.array(elements, float)
    count = gains.shape[1 if len(rx) <= len(tx) else 3]  # antennas at the fixed end
    # With two polarisations several antennas share an element.
    is_known = elements is not None or count == offsets.shape[1] > 1
    if is_known:
        arrays["elements"] = offsets
    links = divide(to_links(Path("paths"), arrays, [], phase), config)
    if not is_known or elements is not None or not source.synthetic_array:
        return links
    remark = "elements lie as in a device without an orientation (elements)"
    return replace(links, remarks=f"{links.remarks}; {remark}")


def _elements(
    source: Any, rx: Float[ndarray, "k e 3"], tx: Float[ndarray, "n m 3"], carrier: float
) -> Float[ndarray, "r a 3"]:
    """Offsets of the antennas from their device [m], at the end of the links with fewer devices.

    Without a synthetic array, paths are traced to each antenna, and ``rx`` and ``tx`` are the
    antennas' places. Otherwise all devices have the antennas of the scene's array.
    """
    fixed, array = (rx, source.rx_array) if len(rx) <= len(tx) else (tx, source.tx_array)
    if not source.synthetic_array:
        return fixed - fixed.mean(1, keepdims=True)
    return _places(array.positions(speed_of_light / carrier), 1).repeat(len(fixed), 0)


def _of_map(source: Any, receivers: Any, carrier: float | None, config: Mapping) -> Links:
    """Links of the cells of a radio map, at a carrier [Hz], with a split's configuration."""
    levels = _decibels(1e3 * np.array(source.rss))  # (k, ...) [dBm]
    levels = levels.reshape(len(levels), -1).T  # (cells, k)
    if receivers is None:
        if not hasattr(source, "_tx_positions"):
            raise ValueError(
                "a radio map of this Sionna RT keeps no places of transmitters; set receivers, "
                "positions (k, 3) [m]"
            )
        positions = _places(source._tx_positions, levels.shape[1])[:, 0]  # (k, 3)
        names = map(str, getattr(source, "_tx_names", range(len(positions))))
        receivers = dict(zip(names, positions.tolist(), strict=True))
    cells = np.array(source.cell_centers, float).reshape(-1, 3)
    return from_arrays(
        "rssi",
        transmitters=cells,
        labels=levels,
        receivers=receivers,
        frequency=carrier,
        split=config,
    )


def _places(points: Any, count: int) -> Float[ndarray, "k e 3"]:
    """Positions of the e antennas at ``count`` places, from (3, count * e) of Sionna RT."""
    positions = np.array(points, float).reshape(3, -1).T  # (count * e, 3)
    return positions.reshape(count, -1, 3)


def _decibels(powers: Float[ndarray, "*shape"]) -> Float[ndarray, "*shape"]:
    """Powers in decibels; NaN for a power of 0."""
    with np.errstate(divide="ignore"):  # the logarithm of 0 is replaced below
        levels = 10 * np.log10(powers)
    return np.where(powers > 0, levels, np.nan)
