"""Ground of GeoTIFF files: systems, missing heights, defects."""

import numpy as np
import pytest
import rasterio
from rasterio import Affine

from gaigs.core.geometry import Frame
from gaigs.core.roofs import plan_grid
from gaigs.data.terrain import read_extent, read_ground

FRAME = Frame(32632, 691000.0, 5335000.0)


def write(file, heights, transform, system=None, **options):
    """A compressed GeoTIFF file."""
    rows, columns = heights.shape
    options |= {"height": rows, "width": columns, "count": 1, "dtype": "float32"}
    with rasterio.open(
        file, "w", driver="GTiff", crs=system, transform=transform, compress="lzw", **options
    ) as raster:
        raster.write(heights.astype(np.float32), 1)
    return file


def plane(columns=40, rows=30, cell=10.0):
    """Heights that rise by 1 m in 10 m to the east, and by 2 m to the north; north is up."""
    x, y = np.meshgrid(np.arange(columns) + 0.5, np.arange(rows)[::-1] + 0.5)
    return 500 + cell * (0.1 * x + 0.2 * y)


def expected(grid, lower=(0.0, 0.0)):
    x = grid.lower[0] - lower[0] + grid.cell * (np.arange(grid.columns) + 0.5)
    y = grid.lower[1] - lower[1] + grid.cell * (np.arange(grid.rows) + 0.5)
    return 500 + 0.1 * x + 0.2 * y[:, None]


def test_heights_of_the_frames_own_system_are_linear_between_pixels(tmp_path):
    transform = Affine(10, 0, FRAME.x - 50, 0, -10, FRAME.y - 20 + 300)
    file = write(tmp_path / "ground.tif", plane(), transform, "EPSG:32632")
    extent = read_extent(file, FRAME)
    assert [*extent.lower, *extent.upper, extent.cell] == pytest.approx([-50, -20, 350, 280, 10])
    grid = plan_grid(np.array([0.0, 0.0]), np.array([200.0, 150.0]), 5.0)
    heights, is_known = read_ground(file, FRAME, grid)
    assert is_known.all()
    np.testing.assert_allclose(heights, expected(grid, (-50, -20)), atol=0.26)  # GDAL's eighths


def test_degrees_are_converted(tmp_path):
    pyproj = pytest.importorskip("pyproj")
    to_map = pyproj.Transformer.from_crs(4326, 32632, always_xy=True)
    step = 1e-4
    longitude, latitude = np.meshgrid(
        11.575 + step * (np.arange(80) + 0.5), 48.145 - step * (np.arange(80) + 0.5)
    )
    x, y = to_map.transform(longitude, latitude)
    heights = 500 + 0.1 * (x - FRAME.x) + 0.2 * (y - FRAME.y)
    transform = Affine(step, 0, 11.575, 0, -step, 48.145)
    file = write(tmp_path / "ground.tif", heights, transform, "EPSG:4326")
    extent = read_extent(file, FRAME)
    assert 7 < extent.cell < 12
    middle = (extent.lower + extent.upper) / 2
    grid = plan_grid(middle - 100, middle + 100, 10.0)
    found, is_known = read_ground(file, FRAME, grid)
    assert is_known.all()
    np.testing.assert_allclose(found, expected(grid), atol=0.5)


def test_missing_heights_are_the_nearest_ones(tmp_path):
    heights = plane()
    heights[:, 20:] = -9999
    transform = Affine(10, 0, 0, 0, -10, 300)
    file = write(tmp_path / "ground.tif", heights, transform, nodata=-9999)
    grid = plan_grid(np.array([0.0, 0.0]), np.array([390.0, 290.0]), 10.0)
    found, is_known = read_ground(file, None, grid)
    assert is_known[5].tolist() == [True] * 20 + [False] * 20
    assert found[5, 39] == found[5, 19]


def test_scale_and_offset_of_the_file_count(tmp_path):
    transform = Affine(10, 0, 0, 0, -10, 300)
    file = write(tmp_path / "ground.tif", 10 * (plane() - 400), transform)
    with rasterio.open(file, "r+") as raster:
        raster.scales, raster.offsets = (0.1,), (400.0,)
    grid = plan_grid(np.array([0.0, 0.0]), np.array([390.0, 290.0]), 10.0)
    heights, _ = read_ground(file, None, grid)
    np.testing.assert_allclose(heights, expected(grid), atol=0.26)


def test_heights_that_are_no_ground_are_named(tmp_path):
    heights = plane()
    heights[:, 20:] = -32768
    transform = Affine(10, 0, 0, 0, -10, 300)
    file = write(tmp_path / "ground.tif", heights, transform)
    grid = plan_grid(np.array([0.0, 0.0]), np.array([390.0, 290.0]), 10.0)
    with pytest.raises(ValueError, match=r"heights from -32768 to .* m are no ground\ndeclare"):
        read_ground(file, None, grid)
    away = plan_grid(np.array([5e3, 5e3]), np.array([6e3, 6e3]), 10.0)
    with pytest.raises(ValueError, match="has no height near the links"):
        read_ground(file, None, away)


def test_defects_are_named(tmp_path):
    text = tmp_path / "ground.tif"
    text.write_text("no raster")
    with pytest.raises(ValueError, match=r"cannot read .*ground.tif as GeoTIFF"):
        read_extent(text, None)
    transform = Affine(1e-4, 0, 11.5, 0, -1e-4, 48.1)
    damaged = tmp_path / "damaged.tif"
    whole = write(tmp_path / "whole.tif", np.random.default_rng(0).random((90, 90)), transform)
    damaged.write_bytes(whole.read_bytes()[:-9000])
    grid = plan_grid(np.array([11.5, 48.091]), np.array([11.509, 48.1]), 1e-4)
    with pytest.raises(ValueError, match=r"cannot place .*damaged.tif on the map"):
        read_ground(damaged, None, grid)
    degrees = write(tmp_path / "degrees.tif", plane(), transform, "EPSG:4326")
    with pytest.raises(ValueError, match="is in degrees, and the data have no place on a map"):
        read_extent(degrees, None)
    with pytest.raises(FileNotFoundError, match="must be terrain, and is no file; set terrain"):
        read_extent(tmp_path / "nothing.tif", None)
