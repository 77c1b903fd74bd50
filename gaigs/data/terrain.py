"""Heights of the ground in GeoTIFF files, on a grid in the world frame."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy.ndimage import distance_transform_edt

from gaigs.core.geometry import Frame
from gaigs.core.roofs import SiteGrid
from gaigs.io.tables import find_file


class Extent(NamedTuple):
    """The area that a file covers in the world frame."""

    lower: Float[ndarray, "2"]  # corners, x and y [m]
    upper: Float[ndarray, "2"]
    cell: float  # distance of its heights [m]


def read_extent(file: str | Path, frame: Frame | None) -> Extent:
    """The area that a terrain file covers, in the world frame [m].

    File and frame are as for ``read_ground``.
    """
    rasterio = find_rasterio()
    with _open(rasterio, file) as raster:
        source, target, origin = _systems(raster, frame)
        with _named(rasterio, file):
            transform, columns, rows = rasterio.warp.calculate_default_transform(
                source, target, raster.width, raster.height, *raster.bounds
            )
    cell = transform.a  # pixel size; (c, f) is the upper left corner
    upper = np.array([transform.c + columns * cell, transform.f]) - origin
    lower = upper - cell * np.array([columns, rows])
    return Extent(lower, upper, cell)


def read_ground(
    file: str | Path, frame: Frame | None, grid: SiteGrid
) -> tuple[Float[ndarray, "rows columns"], Bool[ndarray, "rows columns"]]:
    """Heights of the ground at the middles of a grid's cells [m].

    The second result is true for cells whose height the file has. Heights are the file's first band
    with its scale and offset, linear between pixels. A cell without a height gets the nearest one.

    Args:
        frame: Place of the world frame on a map. Coordinates of the file are converted to the
            frame's system; a file without a system has the frame's. None: coordinates of the file
            are metres of the world frame.
        grid: Cells, in the world frame.

    Raises:
        FileNotFoundError: The file does not exist.
        ImportError: rasterio is not installed.
        ValueError: The file is no raster, has no place on a map, is in degrees while the data have
            no frame, or has no heights of ground in the grid: all missing, or below -1 km or above
            10 km.
    """
    rasterio = find_rasterio()
    heights = np.full((grid.rows, grid.columns), np.nan, dtype=np.float32)
    with _open(rasterio, file) as raster:
        source, target, origin = _systems(raster, frame)
        x, y = origin + grid.lower
        with _named(rasterio, file):
            rasterio.warp.reproject(
                rasterio.band(raster, 1),
                heights,
                src_crs=source,
                dst_crs=target,
                dst_transform=rasterio.Affine(grid.cell, 0, x, 0, grid.cell, y),
                dst_nodata=np.nan,
                resampling=rasterio.warp.Resampling.bilinear,
            )
        heights = np.float32(raster.scales[0]) * heights + np.float32(raster.offsets[0])
    is_known = np.isfinite(heights)
    if not is_known.any():
        raise ValueError(f"{file} has no height near the links\ngive terrain of the site")
    if heights[is_known].min() < -1e3 or heights[is_known].max() > 1e4:
        raise ValueError(
            f"{file}: heights from {np.nanmin(heights):.0f} to {np.nanmax(heights):.0f} m are no "
            "ground\ndeclare the value of missing heights, such as: gdal_edit.py -a_nodata -9999"
        )
    # Row and column of the nearest known cell.
    nearest = distance_transform_edt(~is_known, return_distances=False, return_indices=True)
    return heights[tuple(nearest)], is_known


@contextmanager
def _named(rasterio: ModuleType, file: str | Path) -> Iterator[None]:
    """Makes an error of GDAL a ``ValueError`` that names the file."""
    try:
        yield
    except (rasterio.errors.RasterioError, rasterio.errors.CRSError) as error:
        raise ValueError(f"cannot place {file} on the map of the data: {error}") from error


def find_rasterio() -> Any:
    """The module rasterio; if missing, an ``ImportError`` with the command to install it."""
    try:
        import rasterio.warp
    except ImportError:
        raise ImportError("terrain needs rasterio: pip install 'gaigs[terrain]'") from None
    return rasterio


def _open(rasterio: ModuleType, file: str | Path) -> Any:
    """An open file; a ``ValueError`` if it is no raster."""
    file = find_file(file, "terrain", "terrain")
    try:
        raster = rasterio.open(file)
    except rasterio.errors.RasterioIOError as error:
        raise ValueError(f"cannot read {file} as GeoTIFF: {error}") from error
    if raster.transform.is_identity:
        raster.close()
        raise ValueError(f"{file} has no place: write its corner and pixel size, or a .tfw file")
    return raster


def _systems(raster: Any, frame: Frame | None) -> tuple[Any, Any, Float[ndarray, "2"]]:
    """Coordinate systems of a file and of the world frame, and the world's origin in the latter."""
    if frame is not None:
        target = f"EPSG:{frame.epsg}"
        return raster.crs or target, target, np.array([frame.x, frame.y])
    if raster.crs is not None and raster.crs.is_geographic:
        raise ValueError(
            f"{raster.name} is in degrees, and the data have no place on a map\n"
            "give data.epsg of the links, or terrain in metres of the data"
        )
    source = raster.crs or "EPSG:3857"  # any one, since nothing is converted
    return source, source, np.zeros(2)
