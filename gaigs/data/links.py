"""Links of a registered data reader, or of data in memory: a data frame, traced paths, arrays."""

import inspect
from collections.abc import Callable, Mapping
from typing import Any

from gaigs import configuration
from gaigs.data import Links, load
from gaigs.data.arrays import from_arrays
from gaigs.data.frames import from_frame
from gaigs.data.sionna_rt import from_sionna_rt, is_traced
from gaigs.io.frames import is_frame
from gaigs.registry import check_type


def links(source: Any = None, /, **options: Any) -> Links:
    """Links of a registered data reader, or of data in memory, with their split.

    Args:
        source: Name of a data reader, e.g. ``"synthetic"``, ``"nerf2_spectrum"``,
            ``"rssi_csv"``; a data frame of levels [dBm], or a mapping of its columns; ``Paths`` or
            a ``RadioMap`` of Sionna RT; None for arrays.
        options: Options of reader and split by their names, and ``split``, the name of a registered
            split. Options for a data frame, such as ``x``, ``y``, ``z`` and ``receivers``:
            ``gaigs.data.frames.from_frame``. For Sionna RT, such as ``frequencies``:
            ``gaigs.data.sionna_rt.from_sionna_rt``. For arrays, such as ``task``, ``transmitters``
            (n, 3) [m], ``receivers`` and ``labels``: ``gaigs.data.arrays.from_arrays``.

    Raises:
        FileNotFoundError: The reader finds no data.
        ImportError: A package for the data frame is not installed.
        TypeError: The source or an option has a wrong type.
        ValueError: A name is unknown, or files, arrays or the split do not fit.

    Example:
        >>> gaigs.links("synthetic_rssi", transmitters=50, split="blocks", edge=2.0).split.name
        'blocks 2 m, test 0.2, validation 0.1, seed 0'
        >>> places = [[1.0, 1.0, 1.0], [2.0, 1.0, 1.0], [1.0, 2.0, 1.0], [2.0, 2.0, 1.0]]
        >>> unheard = float("nan")
        >>> levels = [[-40.0, -52.0], [-45.0, unheard], [-50.0, -41.0], [-55.0, -44.0]]  # [dBm]
        >>> anchors = [[0, 0, 2], [3, 3, 2]]
        >>> len(gaigs.links(task="rssi", transmitters=places, receivers=anchors, labels=levels))
        7
    """
    if source is None:
        needed = ("task", "transmitters", "labels")
        missing = [key for key in needed if key not in options]
        if missing:
            raise ValueError(
                f"links takes a reader's name or a data frame first, or arrays: "
                f"{', '.join(needed)}, receivers; missing: {', '.join(missing)}"
            )
        return _checked(from_arrays, options)(**options)
    if is_traced(source):
        return _checked(from_sionna_rt, options)(source, **options)
    if is_frame(source):
        return _checked(from_frame, options)(source, **options)
    if not isinstance(source, str):
        raise TypeError(
            f"links takes a reader's name or a data frame first, got {type(source).__name__}; "
            "name arrays: task=, transmitters=, receivers= and labels="
        )
    if "test_rows" in options or "train_rows" in options:
        raise ValueError("test_rows and train_rows are for arrays; of a reader choose a split")
    config = configuration.composed([f"data={source}"], options, ("data", "split"))
    return load(config["data"], config["split"])


def _checked(reader: Callable, options: Mapping) -> Callable:
    """The reader itself, after a check of its options; a ``TypeError`` for a wrong type."""
    for key, parameter in inspect.signature(reader).parameters.items():
        if key in options and options[key] is not parameter.default:
            check_type(key, options[key], parameter.annotation)
    return reader
