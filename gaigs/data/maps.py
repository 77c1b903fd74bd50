"""Coordinates of maps in metres of UTM; other systems take pyproj."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gaigs.geometry import is_utm


def find_pyproj() -> Any:
    """The module, for coordinate systems; an ``ImportError`` if it is not installed."""
    try:
        import pyproj
    except ImportError:
        raise ImportError("coordinate systems need pyproj: pip install 'gaigs[maps]'") from None
    return pyproj


def to_utm(points: Float[ndarray, "n 2"], epsg: int) -> tuple[Float[ndarray, "n 2"], int]:
    """Eastings and northings [m] in the UTM zone of the first point, and its EPSG code.

    Points of UTM stay as they are. Degrees are longitude before latitude.

    Raises:
        ImportError: pyproj is needed and not installed.
        ValueError: There is no such system, or a point is outside of it.

    Example:
        >>> from gaigs.data.maps import to_utm
        >>> to_utm(np.array([[9.0, 48.0]]), 4326)[1]
        32632
    """
    if is_utm(epsg):
        return points, epsg
    pyproj = find_pyproj()
    try:
        x, y = points[0].tolist()
        lon, lat = pyproj.Transformer.from_crs(epsg, 4326, always_xy=True).transform(x, y, errcheck=True)
        utm = (32700 if lat < 0 else 32600) + int((lon + 180) % 360 // 6) + 1
        east, north = points.T
        moved = pyproj.Transformer.from_crs(epsg, utm, always_xy=True).transform(east, north, errcheck=True)
    except pyproj.exceptions.ProjError as error:
        cause = " ".join(str(error).split())
        raise ValueError(f"data.epsg={epsg} does not suit the coordinates: {cause}") from None
    return np.stack(moved, 1), utm
