"""Polygons of GeoJSON files in metres of the world frame."""

import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from gaigs.core.geometry import Frame
from gaigs.core.roofs import Building
from gaigs.data.maps import check_metres, find_pyproj
from gaigs.io.tables import find_file

Rings = list[Float[ndarray, "_ d"]]
"""Outline of a polygon and its holes, as positions."""


def read_polygons(file: Path, frame: Frame | None, mend: str) -> list[tuple[Rings, dict]]:
    """The polygons of a file, with corners (k, 3) in the world frame [m] and their properties.

    Missing heights are NaN.

    Args:
        frame: Place of the world frame on a map. Positions in the file are then longitude and
            latitude, or easting and northing. None: they are metres of the world frame.
        mend: Advice in errors, such as "draw buildings".

    Source: RFC 7946.
    """
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
        polygons = [*_features(content, {})]
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"cannot read {file} as GeoJSON: {type(error).__name__}: {error}"
        ) from error
    if not polygons:
        raise ValueError(f"{file} has no polygon\n{mend} as Polygon or MultiPolygon")
    in_metres = []
    for rings, properties in polygons:
        in_metres.append(([_in_metres(file, ring, frame, mend) for ring in rings], properties))
    return in_metres


def read_buildings(
    file: str | Path, frame: Frame | None, height: float | None = None
) -> list[Building]:
    """Buildings of a file: each polygon with its properties ``height`` and ``ground`` [m].

    Args:
        height: Height of buildings without this property [m].
    """
    file = find_file(file, "buildings", "buildings")
    buildings = []
    lacking = 0  # number of buildings without a height
    for rings, properties in read_polygons(file, frame, "draw buildings"):
        above = _number(properties.get("height"), height)
        lacking += above is None
        ground = _number(properties.get("ground"), math.nan)
        outlines = [ring[:, :2] for ring in rings]
        buildings.append(Building(outlines, above or 0.0, ground))
    if lacking:
        raise ValueError(
            f"{file}: {lacking} of {len(buildings)} polygons have no number as property 'height' "
            "[m]\nadd it, or give the height of buildings without one, option height"
        )
    return buildings


def _number(value: object, missing: float | None) -> float | None:
    """A finite number, also as text, such as '12.5' or '12 m'; otherwise ``missing``."""
    try:
        number = float(str(value).removesuffix("m"))
    except ValueError:
        return missing
    return number if np.isfinite(number) else missing


def _features(content: Any, properties: dict) -> Iterator[tuple[Rings, dict]]:
    """The polygons within a GeoJSON object, at any depth, with the properties of their features."""
    match content["type"]:
        case "FeatureCollection":
            parts = content["features"]
        case "GeometryCollection":
            parts = content["geometries"]
        case "Feature":
            parts = [content["geometry"]] if content["geometry"] else []
            properties = content.get("properties") or {}
        case "MultiPolygon":
            parts = [{"type": "Polygon", "coordinates": rings} for rings in content["coordinates"]]
        case "Polygon":
            rings = [np.array(ring, dtype=float) for ring in content["coordinates"]]
            yield rings, properties
            return
        case _:  # points and lines have no area
            return
    for part in parts:
        yield from _features(part, properties)


def _in_metres(
    file: Path, ring: Float[ndarray, "k d"], frame: Frame | None, mend: str
) -> Float[ndarray, "k 3"]:
    """Positions in the world frame [m]; a missing height is NaN.

    With a frame, positions in the range of longitudes and latitudes are degrees; others are easting
    and northing.
    """
    if ring.ndim != 2 or ring.shape[1] not in (2, 3) or not np.isfinite(ring).all():
        raise ValueError(f"{file}: a position must be two or three finite numbers")
    x, y = ring[:, 0], ring[:, 1]
    height = ring[:, 2] if ring.shape[1] == 3 else np.full(len(ring), np.nan)
    if frame is None:
        check_metres(str(file), ring, f"the data have no place on a map: {mend} in metres")
        return np.stack((x, y, height), 1)
    if np.abs(x).max() <= 180 and np.abs(y).max() <= 90:
        transformer = find_pyproj().Transformer.from_crs(4326, frame.epsg, always_xy=True)
        x, y = transformer.transform(x, y)
    return np.stack((x - frame.x, y - frame.y, height), 1)
