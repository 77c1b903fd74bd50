"""Real and imaginary parts of channels, and detection of amplitudes and phases."""

import math

import numpy as np
from numpy import ndarray


def join(arrays: list[ndarray], axis: str | None) -> ndarray:
    """Channels from two real arrays, or from one array with both parts along an axis.

    Args:
        axis: ``first`` or ``last`` axis, with both parts. Without it a single real array is
            unchanged: its numbers may be amplitudes of two antennas.

    Raises:
        ValueError: Parts are not real, have different shapes, or are not along an axis of 2.

    Example:
        >>> from gaigs.data.parts import join
        >>> join([np.array([[3.0, 4.0], [0.0, 1.0]])], "last")
        array([3.+4.j, 0.+1.j])
    """
    got = " and ".join(f"{part.dtype} {part.shape}" for part in arrays)
    is_real = all(part.dtype.kind in "iuf" for part in arrays)
    if len(arrays) == 2:
        real, imaginary = arrays
        if not is_real or real.shape != imaginary.shape:
            raise ValueError(
                "data.arrays: real and imaginary part of h must be real and of one shape, "
                f"got {got}"
            )
        return real + 1j * imaginary
    (array,) = arrays
    if axis is None:
        return array
    number = 0 if axis == "first" else -1
    if not is_real or array.ndim < 2 or array.shape[number] != 2:
        raise ValueError(
            f"data.parts={axis} is for real numbers with 2 along the {axis} axis, got {got}"
        )
    real, imaginary = np.moveaxis(array, number, 0)
    return real + 1j * imaginary


def check_parts(name: str, channels: ndarray) -> None:
    """Raises a ``ValueError`` if 100 or more complex numbers are amplitudes and phases.

    Amplitudes are all positive, or below -20 as in dB. Phases cover a full turn evenly, in radians
    or degrees.
    """
    if channels.size < 100:
        return
    parts = {"real": channels.real, "imaginary": channels.imag}
    for amplitudes, phases in (("real", "imaginary"), ("imaginary", "real")):
        is_db = parts[amplitudes].max() < -20
        if not is_db and parts[amplitudes].min() < 0:  # these numbers are no amplitudes
            continue
        for turn, angle in ((2 * math.pi, "p"), (360.0, "np.deg2rad(p)")):
            if not _fills_turn(parts[phases], turn):
                continue
            kind = "below -20" if is_db else "0 or more"
            amplitude = "10 ** (a / 20)" if is_db else "a"
            span = f"{parts[phases].min():.4g} .. {parts[phases].max():.4g}"
            raise ValueError(
                f"{name}: {amplitudes} parts are {kind} everywhere, {phases} ones within {span}, "
                f"as amplitude a and phase p\ngive {amplitude} * np.exp(1j * {angle})"
            )


def _fills_turn(angles: ndarray, turn: float) -> bool:
    """True if numbers are evenly spread over a full turn, from 0 or from minus half a turn.

    Args:
        turn: Full turn, in the unit of the angles.
    """
    low = angles.min()
    high = angles.max()
    start = 0 if low >= 0 else -turn / 2
    # Tolerances of the ends, towards the inside and the outside of the turn.
    inner = 0.05 * turn
    outer = 1e-6 * turn
    if not start - outer <= low < start + inner:
        return False
    if not start + turn - inner < high <= start + turn + outer:
        return False
    # Evenly spread angles have a standard deviation of turn / sqrt(12). Sines of a phase, from a
    # channel's imaginary part, have 1.2 times as much.
    return bool(abs(angles.std() / (turn / math.sqrt(12)) - 1) < 0.12)
