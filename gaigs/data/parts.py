"""Real and imaginary parts of channels: how they are joined, and what else two parts may be."""

import math

import numpy as np
from numpy import ndarray


def join(arrays: list[ndarray], axis: str | None) -> ndarray:
    """Channels from two real arrays, or from one with both parts along its ``first`` or ``last``
    axis.

    Without an ``axis`` a single array stays as it is: real numbers may be amplitudes of two
    antennas.

    Raises:
        ValueError: Parts are not real, have different shapes, or are not along an axis of 2.

    Example:
        >>> from gaigs.data.parts import join
        >>> join([np.array([[3.0, 4.0], [0.0, 1.0]])], "last")
        array([3.+4.j, 0.+1.j])
    """
    shapes = {part.shape for part in arrays}
    got = " and ".join(f"{part.dtype} {part.shape}" for part in arrays)
    is_real = all(part.dtype.kind in "iuf" for part in arrays)
    if len(arrays) == 2:
        if not is_real or len(shapes) > 1:
            raise ValueError(
                f"data.arrays: real and imaginary part of h must be real and of one shape, got {got}"
            )
        return arrays[0] + 1j * arrays[1]
    (array,) = arrays
    if axis is None:
        return array
    if not is_real or array.ndim < 2 or array.shape[0 if axis == "first" else -1] != 2:
        raise ValueError(
            f"data.parts={axis} is for real numbers with 2 along the {axis} axis, got {got}"
        )
    real, imaginary = np.moveaxis(array, 0 if axis == "first" else -1, 0)
    return real + 1j * imaginary


def check_parts(name: str, channels: ndarray) -> None:
    """Raises a ``ValueError`` if complex numbers, 100 or more, have amplitude and phase in place of
    their parts.

    One part then is positive or below -20, as in dB, and the other fills a turn in radians or
    degrees evenly.
    """
    if channels.size < 100:
        return
    parts = {"real": channels.real, "imaginary": channels.imag}
    for first, second in (("real", "imaginary"), ("imaginary", "real")):
        low, high = parts[second].min(), parts[second].max()
        is_db = parts[first].max() < -20
        for turn, phase in ((2 * math.pi, "p"), (360.0, "np.deg2rad(p)")):
            start = 0 if low >= 0 else -turn / 2
            inner, outer = 0.05 * turn, 1e-6 * turn
            fills = (
                start - outer <= low < start + inner
                and start + turn - inner < high <= start + turn + outer
            )
            # The deviation of even angles; sines of a phase near 0 have 1.2 of it.
            is_even = abs(parts[second].std() / (turn / math.sqrt(12)) - 1) < 0.12
            if fills and is_even and (is_db or parts[first].min() >= 0):
                kind, amplitude = ("below -20", "10 ** (a / 20)") if is_db else ("0 or more", "a")
                raise ValueError(
                    f"{name}: {first} parts are {kind} everywhere, {second} ones within {low:.4g} .. {high:.4g}, as "
                    f"amplitude a and phase p\ngive {amplitude} * np.exp(1j * {phase})"
                )
