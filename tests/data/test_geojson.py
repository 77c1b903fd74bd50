"""Buildings of GeoJSON files: heights in many spellings, frames, defects."""

import json
import math

import numpy as np
import pytest

from gaigs.core.geometry import Frame
from gaigs.data.geojson import read_buildings

SQUARE = [[0, 0], [10, 0], [10, 10], [0, 10], [0, 0]]


def write(folder, *properties, ring=SQUARE):
    geometry = {"type": "MultiPolygon", "coordinates": [[ring]]}
    features = [{"type": "Feature", "properties": one, "geometry": geometry} for one in properties]
    file = folder / "buildings.geojson"
    file.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return file


def test_heights_above_the_ground(tmp_path):
    file = write(
        tmp_path, {"height": 12}, {"height": "7.5"}, {"height": "9 m", "ground": 100}, None
    )
    buildings = read_buildings(file, None, height=4.0)
    assert [building.height for building in buildings] == [12, 7.5, 9, 4]
    assert buildings[2].ground == 100
    assert math.isnan(buildings[0].ground)


def test_buildings_without_a_height_are_counted(tmp_path):
    file = write(tmp_path, {"height": 12}, {"levels": 3}, {"height": "tall"}, {"height": "nan"})
    with pytest.raises(ValueError, match=r"3 of 4 polygons have no number as property 'height'"):
        read_buildings(file, None)


def test_degrees_take_the_frame_of_the_data(tmp_path):
    ring = [
        [11.580143, 48.140231],
        [11.580343, 48.140237],
        [11.580343, 48.140437],
        [11.580143, 48.140231],
    ]
    file = write(tmp_path, {"height": 12}, ring=ring)
    with pytest.raises(ValueError, match=r"look like degrees\nthe data have no place on a map"):
        read_buildings(file, None)
    pytest.importorskip("pyproj")
    (building,) = read_buildings(file, Frame(32632, 691000.0, 5335000.0))
    assert np.ptp(building.rings[0], axis=0) == pytest.approx([14.9, 23.4], abs=0.5)


def test_no_such_file(tmp_path):
    with pytest.raises(FileNotFoundError, match="must be buildings, and is no file; set buildings"):
        read_buildings(tmp_path / "nothing.geojson", None)
