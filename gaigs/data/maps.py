"""Coordinates of maps in metres of UTM; other systems need pyproj."""

from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gaigs.core.geometry import is_utm


def find_pyproj() -> Any:
    """The module pyproj; if missing, an ``ImportError`` with the command to install it."""
    try:
        import pyproj
    except ImportError:
        raise ImportError("coordinate systems need pyproj: pip install 'gaigs[maps]'") from None
    return pyproj


def metres_of(epsg: int) -> float | None:
    """Length of a system's unit of coordinates [m]; None for degrees.

    Raises:
        ImportError: pyproj is needed and not installed.
        ValueError: The system does not exist.

    Example:
        >>> from gaigs.data.maps import metres_of
        >>> round(metres_of(2263), 6)  # New York, in feet of the US survey
        0.304801
    """
    if is_utm(epsg):
        return 1.0
    pyproj = find_pyproj()
    try:
        system = pyproj.CRS.from_epsg(epsg)
    except pyproj.exceptions.ProjError as error:
        cause = " ".join(str(error).split())
        raise ValueError(f"data.epsg={epsg} is no coordinate system: {cause}") from None
    return None if system.is_geographic else system.axis_info[0].unit_conversion_factor


def are_degrees(points: Float[ndarray, "n d"]) -> bool:
    """True if x and y, read as metres, are probably longitude and latitude, in either order.

    Degrees span less than 0.3 and less than a hundredth of their distance from the origin, and have
    five decimals or more. Coordinates of a measured grid in metres rarely have so many decimals.
    """
    if len(points) < 2:
        return False
    x, y = np.abs(points[:, :2]).max(0)
    span = np.ptp(points[:, :2], axis=0).max()
    # One coordinate is within 180 degrees and the other within 90, in either order.
    is_on_earth = max(x, y) <= 180 and min(x, y) <= 90
    is_small = 0 < span < min(0.3, max(x, y) / 100)
    beyond_four = np.abs(points[:, :2] - points[:, :2].round(4))  # the fifth decimal and further
    return bool(is_on_earth and is_small and (beyond_four > 1e-5).mean() > 0.3)


def check_metres(
    where: str,
    points: Float[ndarray, "n d"],
    mend: str = "convert them, as gaigs.data.maps.to_utm(points, 4326) does, longitude first",
) -> None:
    """Raises a ``ValueError`` if coordinates are degrees; ``mend`` is its advice."""
    if are_degrees(points):
        x, y = points[0, :2].tolist()
        raise ValueError(
            f"{where}: expected metres, got such as ({x:.7g}, {y:.7g}), which look like "
            f"degrees\n{mend}"
        )


def to_utm(points: Float[ndarray, "n 2"], epsg: int) -> tuple[Float[ndarray, "n 2"], int]:
    """Eastings and northings [m] in the UTM zone of the first point, and its EPSG code.

    Points in UTM are unchanged. In degrees, longitude comes first.

    Raises:
        ImportError: pyproj is needed and not installed.
        ValueError: The system does not exist, or a point is outside the system.

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
        lon, lat = pyproj.Transformer.from_crs(epsg, 4326, always_xy=True).transform(
            x, y, errcheck=True
        )
        # Zones are 6 degrees wide from -180; codes are 32601.. in the north, 32701.. in the south.
        utm = (32700 if lat < 0 else 32600) + int((lon + 180) % 360 // 6) + 1
        east, north = points.T
        moved = pyproj.Transformer.from_crs(epsg, utm, always_xy=True).transform(
            east, north, errcheck=True
        )
    except pyproj.exceptions.ProjError as error:
        cause = " ".join(str(error).split())
        raise ValueError(f"data.epsg={epsg} does not suit the coordinates: {cause}") from None
    return np.stack(moved, 1), utm
